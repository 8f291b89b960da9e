"""How dishes go with what a player does: the paper's section 5.4 and Table 3, with sizes, intervals and correction.

A player in a game is a sample. It is high (low) in a behaviour if its rate is at least `threshold` standard deviations
above (below) the mean of all samples; the effect is the mean of the group's dishes less that of all. As in the paper,
means are over everything pooled; or, the default here, rates and dishes are compared within layout and seat, since
layouts differ in how much there is to do and seats in what can be reached.

Platings and onions are parts of a dish, so that counts go with dishes by arithmetic. Shares, a player's part of what
both did, are free of that and stand beside them. Where both players of a game are samples, one of them has the large
share and the other the small one of the same dishes: the group is then called uneven.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from popgen.envs.overcooked.transition_events import EVENTS
from popgen.evaluation.estimates import adjust_by_holm
from popgen.evaluation.played_games import PlayedGame

BEHAVIOURS: Mapping[str, tuple[str, ...]] = {
    "plating": ("take_soup_from_pot",),
    "onion picking": ("take_onion_from_dispenser",),
    "movement": ("walk",),
}
"""The paper's three, and the events whose sum each is."""

LEVEL = 0.05


@dataclass(frozen=True)
class Samples:
    """Players in games.

    Attributes:
        values: (n, B) what each did of each behaviour.
        dishes: (n,) of its team.
        clusters: (n,) int, who answers for it.
        strata: (n,) int, layout and seat.
    """

    values: np.ndarray
    dishes: np.ndarray
    clusters: np.ndarray
    strata: np.ndarray

    def within_strata(self) -> Samples:
        """Values in standard deviations from their stratum's mean, dishes less their stratum's mean."""
        values, dishes = self.values.astype(np.float64).copy(), self.dishes.astype(np.float64).copy()
        for stratum in np.unique(self.strata):
            rows = self.strata == stratum
            spread = values[rows].std(0)
            values[rows] = (values[rows] - values[rows].mean(0)) / np.where(spread > 0, spread, 1.0)
            dishes[rows] -= dishes[rows].mean()
        return replace(self, values=values, dishes=dishes)


@dataclass(frozen=True)
class Effect:
    """Dishes of a group less those of all.

    Attributes:
        behaviour: its name; with "(share)" of the share.
        group: high, low or, of shares, uneven.
        size: samples in the group.
        participants: who answer for them.
        effect: dishes in 400 steps; nan for an empty group.
        low, high: 95 % interval, clustered by participant.
        p: two-sided, before correction.
        p_holm: corrected for all effects of the table.
    """

    behaviour: str
    group: str
    size: int
    participants: int
    effect: float
    low: float
    high: float
    p: float
    p_holm: float = float("nan")

    @property
    def significant(self) -> bool:
        """After correction, at the level of 5 %."""
        return self.p_holm <= LEVEL


def collect_samples(
    games: Sequence[PlayedGame], behaviours: Mapping[str, Sequence[str]] = BEHAVIOURS, *, shares: bool = False
) -> Samples:
    """One sample a player and game; with `shares` of what both players did instead of rates (one half of nothing)."""
    columns = [[EVENTS.index(event) for event in events] for events in behaviours.values()]
    rates = np.stack([np.stack([game.rates[:, own].sum(-1) for own in columns], -1) for game in games])
    if shares:
        both = rates.sum(1, keepdims=True)
        rates = np.where(both > 0, rates / np.where(both > 0, both, 1.0), 0.5)
    names = [name for game in games for name in game.participants]
    strata = [f"{game.layout} {seat}" for game in games for seat in (0, 1)]
    judged = np.array([game.judged for game in games], bool).reshape(-1)
    return Samples(
        rates.reshape(-1, len(columns))[judged],
        np.repeat([game.dish_rate for game in games], 2)[judged],
        np.unique(np.array(names)[judged], return_inverse=True)[1],
        np.unique(np.array(strata)[judged], return_inverse=True)[1],
    )


def measure_effects(samples: Samples, names: Sequence[str], threshold: float) -> list[Effect]:
    """High and low of every behaviour, in order, not yet corrected."""
    effects = []
    for column, name in enumerate(names):
        values = samples.values[:, column]
        distance = threshold * values.std()
        groups = {"high": values - values.mean() >= distance, "low": values.mean() - values >= distance}
        for group, inside in groups.items():
            inside = inside if distance > 0 else np.zeros(len(values), bool)
            effects.append(_measure_effect(samples, inside, name, group))
    return effects


def _measure_effect(samples: Samples, inside: np.ndarray, name: str, group: str) -> Effect:
    """The difference of means, its error linearised and summed within participants, Student's t by their number."""
    from scipy.stats import t

    nothing = float("nan")
    found = len(np.unique(samples.clusters[inside]))
    count = len(np.unique(samples.clusters))
    if found < 2:
        return Effect(name, group, int(inside.sum()), found, nothing, nothing, nothing, nothing)
    dishes = samples.dishes
    own, everyone = dishes[inside].mean(), dishes.mean()
    influence = inside * (dishes - own) / inside.sum() - (dishes - everyone) / len(dishes)
    sums = np.bincount(samples.clusters, influence, minlength=count)
    error = float(np.sqrt(count / (count - 1) * (sums**2).sum()))
    effect = float(own - everyone)
    degrees = found - 1
    margin = float(t.ppf(1.0 - LEVEL / 2.0, degrees)) * error
    p = float(2.0 * t.sf(abs(effect) / error, degrees)) if error > 0 else 1.0
    return Effect(name, group, int(inside.sum()), found, effect, effect - margin, effect + margin, p)


def correct_by_holm(effects: Sequence[Effect]) -> list[Effect]:
    """Holm's step-down correction over all effects that could be measured."""
    measured = [effect for effect in effects if np.isfinite(effect.p)]
    values = iter(adjust_by_holm([effect.p for effect in measured]))
    return [replace(effect, p_holm=next(values)) if np.isfinite(effect.p) else effect for effect in effects]


def tabulate_effects(games: Sequence[PlayedGame], threshold: float, *, pooled: bool = False) -> list[Effect]:
    """Table 3 of these games: rates and shares of the paper's behaviours, corrected together.

    Args:
        games: of any layouts.
        threshold: in standard deviations.
        pooled: over layouts and seats as they are, as the paper does.
    """
    effects: list[Effect] = []
    for shares in (False, True):
        samples = collect_samples(games, shares=shares)
        names = [f"{name} (share)" if shares else name for name in BEHAVIOURS]
        found = measure_effects(samples if pooled else samples.within_strata(), names, threshold)
        if shares and all(all(game.judged) for game in games):
            found = [replace(one, group="uneven") for one in found if one.group == "high"]
        effects += found
    return correct_by_holm(effects)
