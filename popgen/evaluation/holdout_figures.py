"""What a hold-out evaluation says of each ego, beside each kind of partner.

The reference of a partner and seat is the best response known to it, whichever scores most: the partner itself, the
mate of the pair that it was trained in, or the best response that was trained for it. Where none scores anything, there
is no reference, and the partner has no BR-Prox in that seat.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from popgen.errors import UserError
from popgen.evaluation.holdout import SEATS, HoldoutResult
from popgen.evaluation.holdout_metrics import (
    Interval,
    Spread,
    bootstrap_crossed,
    bootstrap_gain,
    describe_spread,
    interquartile_mean,
    list_strata,
    measure_br_proximity,
    measure_cvar,
    measure_regret,
    normalise_returns,
)
from popgen.evaluation.holdout_overlap import has_met
from popgen.evaluation.holdout_players import Group

CVAR_SHARE = 0.25
"""Share of the lowest pair means that the conditional value at risk averages."""

REPETITIONS = 1000
"""Of the bootstrap."""


@dataclass(frozen=True)
class Worst:
    """The lowest mean over episodes of an ego's player beside a partner.

    Attributes:
        score: that mean.
        ego, partner: names of the players.
        seat: of the ego.
    """

    score: float
    ego: str
    partner: str
    seat: int


@dataclass(frozen=True)
class Standing:
    """Figures of one ego beside one set of partners, over its seeds, the partners and both seats.

    Attributes:
        ego, partners: labels; `partners` of a group, or of a set of groups.
        count: partners, copies of one policy counted once.
        referenced: those with a reference in a seat at least, beside whom BR-Prox is measured.
        score: mean, SD over episodes and SE of the mean (SD over the root of all episodes, as in the paper).
        interval: of the mean, over what is resampled; NaN where that is nothing.
        resampled: of `ego's seeds` and `partners`, within their groups, those of which there are several.
        seats: mean by the ego's seat.
        worst: the lowest pair.
        cvar: mean of the lowest quarter of pair means.
        br_prox: inter-quartile mean of BR-Prox (clipped at 1) over seeds, and the partners and seats that have a
            reference, with its interval; NaN without any.
        br_prox_unclipped: mean of the same without the bound.
        br_prox_least: the least of one partner: mean of the same over seeds and seats.
        normalised: mean of score over the best score that anybody reached with the partner; NaN without one above 0.
        regret: mean of what the reference scores more than the ego.
    """

    ego: str
    partners: str
    count: int
    referenced: int
    score: Spread
    interval: Interval
    resampled: tuple[str, ...]
    seats: tuple[float, float]
    worst: Worst
    cvar: float
    br_prox: Interval
    br_prox_unclipped: float
    br_prox_least: float
    normalised: float
    regret: float


@dataclass(frozen=True)
class Margin:
    """How much more an ego scores than a control with the same partners and seats.

    Attributes:
        ego, control, partners: labels.
        gain: with its interval over what is resampled.
        resampled: of `ego's seeds`, `control's seeds` and `partners` those of which there are several.
    """

    ego: str
    control: str
    partners: str
    gain: Interval
    resampled: tuple[str, ...]


@dataclass(frozen=True)
class PartnerSet:
    """Partners whose scores are taken together: a label and their indices among the K."""

    label: str
    columns: tuple[int, ...]


ALL, OWN, CROSS = "all hold-outs", "own method", "other methods"
"""Labels of sets of groups: all but people and teachers; those of the methods that taught the ego; those of others."""


BEST_RESPONSE, MATE, SELF_PLAY = "best response", "mate", "self-play"
"""Kinds of references; of equal ones the first."""


def list_references(result: HoldoutResult) -> dict[str, np.ndarray]:
    """Kind -> (K, 2) mean scores of who may be the best response to each partner, by its seat; NaN where there is none.

    A partner plays with itself in both seats, so that its score is the same in either.
    """
    alone = np.repeat(result.partner_alone.mean(-1)[:, None], len(SEATS), axis=1)
    return {BEST_RESPONSE: result.responses.mean(-1), MATE: result.partner_mates.mean(-1), SELF_PLAY: alone}


def find_references(result: HoldoutResult) -> np.ndarray:
    """(K, 2) mean scores of the best response known to each partner, by the seat of the response."""
    return np.fmax.reduce(list(list_references(result).values()))


def list_sets(result: HoldoutResult, ego: Group) -> list[PartnerSet]:
    """Each group of partners, then all hold-outs, those of the ego's own methods and those of other methods; of those
    that taught some ego only its own teachers."""
    casting = result.casting
    held_out = [group for group in casting.partners if group.label not in casting.humans | casting.met]
    shown = [group for group in casting.partners if group.label not in casting.met or has_met(ego, group)]
    chosen = [(group.label, [group.label]) for group in shown]
    if len(held_out) > 1:
        own = [group.label for group in held_out if group.method in ego.taught_by]
        chosen.append((ALL, [group.label for group in held_out]))
        if ego.taught_by:
            chosen += [(OWN, own), (CROSS, [group.label for group in held_out if group.label not in own])]
    sets = [PartnerSet(label, tuple(casting.columns(labels))) for label, labels in chosen]
    return [one for one in sets if one.columns]


def describe_standing(result: HoldoutResult, ego: Group, chosen: PartnerSet) -> Standing:
    """All figures of an ego beside a set of partners."""
    rows, columns = result.casting.rows(ego.label), list(chosen.columns)
    scores = result.scores[np.ix_(rows, columns)]
    means, references = scores.mean(-1), find_references(result)[columns]
    best = np.fmax(references, result.scores.mean(-1).max(0)[columns])
    unclipped = measure_br_proximity(means, references, clip=False)
    groups = _list_groups(result, columns)
    useful = best > 0.0
    normalised = normalise_returns(means[:, useful], 0.0, best[useful]) if useful.any() else np.array([math.nan])
    return Standing(
        ego=ego.label,
        partners=chosen.label,
        count=len(columns),
        referenced=int((references > 0.0).any(1).sum()),
        score=describe_spread(scores),
        interval=bootstrap_crossed(means, groups, np.mean, repetitions=REPETITIONS),
        resampled=list_resampled({"ego's seeds": len(means)}, groups),
        seats=(float(means[..., 0].mean()), float(means[..., 1].mean())),
        worst=_find_worst_pair(result, rows, columns),
        cvar=measure_cvar(means, CVAR_SHARE),
        br_prox=_bound_proximity(measure_br_proximity(means, references), groups),
        br_prox_unclipped=float(np.nanmean(unclipped)) if np.isfinite(unclipped).any() else math.nan,
        br_prox_least=_find_least_share(unclipped),
        normalised=float(normalised.mean()),
        regret=float(measure_regret(means, references).mean()),
    )


def list_resampled(seeds: Mapping[str, int], groups: Sequence[int]) -> tuple[str, ...]:
    """What an interval is over: seeds by whose they are, and partners of one group, wherever there are several."""
    counts = {**seeds, "partners": max(len(own) for own in list_strata(groups))}
    return tuple(name for name, count in counts.items() if count > 1)


def _list_groups(result: HoldoutResult, columns: Sequence[int]) -> list[int]:
    """Of each of some partners the number of its group."""
    of_all = [number for number, group in enumerate(result.casting.partners) for _ in group.players]
    return [of_all[column] for column in columns]


def _bound_proximity(clipped: np.ndarray, groups: Sequence[int]) -> Interval:
    """Of BR-Prox (runs, K, 2) the inter-quartile mean, over the partners and seats that have one."""
    kept = np.flatnonzero(np.isfinite(clipped).any((0, 2)))
    if not kept.size:
        return Interval(math.nan, math.nan, math.nan)
    own = [groups[int(place)] for place in kept]
    return bootstrap_crossed(
        clipped[:, kept], own, lambda drawn: interquartile_mean(drawn[np.isfinite(drawn)]), repetitions=REPETITIONS
    )


def _find_least_share(ratios: np.ndarray) -> float:
    """Of (runs, K, 2) the least mean of a partner; NaN where nobody has a ratio."""
    known = [np.nanmean(ratios[:, place]) for place in range(ratios.shape[1]) if np.isfinite(ratios[:, place]).any()]
    return float(min(known, default=math.nan))


def _find_worst_pair(result: HoldoutResult, rows: Sequence[int], columns: Sequence[int]) -> Worst:
    means = result.scores[np.ix_(rows, columns)].mean(-1)
    row, column, seat = (int(index) for index in np.unravel_index(int(means.argmin()), means.shape))
    ego = result.casting.ego_players[rows[row]]
    partner = result.casting.partner_players[columns[column]]
    return Worst(float(means.min()), ego.name, partner.name, seat)


def describe_all(result: HoldoutResult) -> list[Standing]:
    """Every ego beside every set of partners."""
    return [describe_standing(result, ego, chosen) for ego in result.casting.egos for chosen in list_sets(result, ego)]


def measure_margins(result: HoldoutResult, control: str) -> list[Margin]:
    """What every other ego scores more than the ego `control`, beside each group of partners and all hold-outs; see
    `bootstrap_gain` for the intervals.

    Raises:
        UserError: there is no ego of that name.
    """
    egos = [group.label for group in result.casting.egos]
    if control not in egos:
        raise UserError("--control", f"there is no ego {control}", f"choose among {', '.join(egos)}")
    base = result.scores[result.casting.rows(control)].mean(-1)
    found = []
    for ego in result.casting.egos:
        if ego.label == control:
            continue
        own = result.scores[result.casting.rows(ego.label)].mean(-1)
        for chosen in list_sets(result, ego):
            if chosen.label not in (OWN, CROSS):
                columns = list(chosen.columns)
                groups = _list_groups(result, columns)
                gain = bootstrap_gain(own[:, columns], base[:, columns], groups, repetitions=REPETITIONS)
                several = list_resampled({"ego's seeds": len(own), "control's seeds": len(base)}, groups)
                found.append(Margin(ego.label, control, chosen.label, gain, several))
    return found
