"""A hold-out evaluation as JSON, CSV, Markdown, tables for the terminal and a chart.

Keys of the JSON object (`holdout.json`); null stands for what is unknown:

    format, format_version   "popgen-holdout", 1
    environment              as in a population's manifest
    unit, episodes, seed     of scores; for each pair and seat; of the evaluation
    steps                    {"evaluation": N}
    egos, partners           groups: label, method, taught_by (methods), human, met (it taught an ego), players (source,
                             member, sha256,
                             identity, mate: number of the member that it was trained in a pair with or null, response:
                             the best response to it that was played: source, scale, settings, steps; or null)
    standings                one for each ego and set of partners: ego, partners, count, referenced (of these partners,
                             with a reference), mean, sd, se, interval, seat_0, seat_1 (where the ego sat), worst
                             (score, ego, partner, seat), cvar_25, br_prox_iqm, br_prox_unclipped (mean) and
                             br_prox_least (of one partner), null without a partner that has a reference,
                             normalised_return, regret
    controls                 egos: ego, alone, mate, random, idle; partners: partner and the same (mean, sd, se); mate
                             is null where none was trained in a pair
    margins                  ego, control, partners, gain (value, low, high), resampled (for the interval)
    reference                best response known to each partner: partner, member, source, seat_0, seat_1, of
                             (`best response`, `mate` or `self-play`, by seat)
    paper                    holdout, ego, mean, spread: the paper's table of the layout
    pairs                    ego, member, ego_source, partner, partner_member, partner_source (populations' folders or
                             module:Agent: one label may have several), seat (of the ego), mean, sd, se, scores
    notes                    what a reader must know, in sentences
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from popgen.errors import UserError
from popgen.evaluation.holdout import CONTROLS, SEATS, HoldoutResult
from popgen.evaluation.holdout_figures import (
    BEST_RESPONSE,
    MATE,
    Standing,
    describe_all,
    find_references,
    list_references,
    measure_margins,
)
from popgen.evaluation.holdout_metrics import describe_spread
from popgen.evaluation.holdout_players import Group, Response, list_distinct, seat_mates
from popgen.jsonable import jsonable
from popgen.reports.frames import to_csv
from popgen.reports.paper_ego_figures import list_cells

CSV_FIELDS = (
    *("ego", "ego_member", "partner", "partner_member", "seat"),
    *("mean", "sd", "se", "episodes", "reference", "br_prox", "br_prox_clipped", "regret"),
    *("ego_source", "partner_source"),
)
"""Columns of holdout.csv: one row for each pair and seat of the ego."""


def to_dict(result: HoldoutResult, control: str | None = None) -> dict[str, Any]:
    """The JSON object of the module's docstring; margins over the ego `control`, if one is named."""
    report = {
        "format": "popgen-holdout",
        "format_version": 1,
        "environment": result.environment.model_dump(mode="json"),
        "unit": result.environment.score_name,
        "episodes": result.episodes,
        "seed": result.seed,
        "steps": {"evaluation": result.steps},
        "egos": [_describe_group(result, group) for group in result.casting.egos],
        "partners": [_describe_group(result, group) for group in result.casting.partners],
        "standings": [_describe_standing(one) for one in describe_all(result)],
        "controls": _describe_controls(result),
        "margins": [asdict(one) for one in measure_margins(result, control)] if control else [],
        "reference": list(_list_references(result)),
        "paper": [asdict(cell) for cell in list_cells(result.environment.name)],
        "pairs": list(_list_pairs(result)),
        "notes": [*_write_notes(result), *([_MARGINS] if control else [])],
    }
    return jsonable(report)


def _describe_group(result: HoldoutResult, group: Group) -> dict[str, Any]:
    everybody, mates = seat_mates(group.players)
    players = [
        {
            "source": one.source,
            "member": one.member,
            "sha256": one.digest,
            "identity": one.identity,
            "mate": None if mate == place else everybody[mate].member,
            "response": _describe_response(result.casting.responses.get(one.identity or "")),
        }
        for place, (one, mate) in enumerate(zip(group.players, mates, strict=True))
    ]
    apart = {"human": group.label in result.casting.humans, "met": group.label in result.casting.met}
    taught = sorted(group.taught_by)
    return {"label": group.label, "method": group.method, "taught_by": taught, **apart, "players": players}


def _describe_response(one: Response | None) -> dict[str, Any] | None:
    if one is None:
        return None
    return {"source": one.player.source, "scale": one.scale, "settings": dict(one.settings), "steps": one.steps}


def _describe_standing(one: Standing) -> dict[str, Any]:
    return {
        **{"ego": one.ego, "partners": one.partners, "count": one.count, "referenced": one.referenced},
        **{"mean": one.score.mean, "sd": one.score.sd, "se": one.score.se},
        "interval": {"low": one.interval.low, "high": one.interval.high},
        "resampled": list(one.resampled),
        **{"seat_0": one.seats[0], "seat_1": one.seats[1]},
        "worst": asdict(one.worst),
        "cvar_25": one.cvar,
        "br_prox_iqm": asdict(one.br_prox),
        "br_prox_unclipped": one.br_prox_unclipped,
        "br_prox_least": one.br_prox_least,
        "normalised_return": one.normalised,
        "regret": one.regret,
    }


def _describe_scores(scores: np.ndarray) -> dict[str, float]:
    spread = describe_spread(scores)
    return {"mean": spread.mean, "sd": spread.sd, "se": spread.se}


def _describe_controls(result: HoldoutResult) -> dict[str, Any]:
    casting = result.casting
    egos, partners = [], []
    for group in casting.egos:
        rows = casting.rows(group.label)
        beside = {name: _describe_scores(result.ego_beside[name][rows]) for name in CONTROLS}
        own = {"alone": _describe_scores(result.ego_alone[rows]), "mate": _describe_mates(result.ego_mates[rows])}
        egos.append({"ego": group.label, **own, **beside})
    for group in casting.partners:
        columns = casting.columns([group.label])
        beside = {name: _describe_scores(result.partner_beside[name][columns]) for name in CONTROLS}
        mate = _describe_mates(result.partner_mates[columns])
        own = {"alone": _describe_scores(result.partner_alone[columns]), "mate": mate}
        partners.append({"partner": group.label, **own, **beside})
    return {"egos": egos, "partners": partners}


def _describe_mates(scores: np.ndarray) -> dict[str, float] | None:
    """Of those that have one; None where nobody has."""
    known = scores[np.isfinite(scores)]
    return _describe_scores(known) if known.size else None


def _list_references(result: HoldoutResult) -> Iterator[dict[str, Any]]:
    references, kinds = find_references(result), list_references(result)
    for n, player in enumerate(result.casting.partner_players):
        seats = {f"seat_{seat}": references[n, seat] for seat in SEATS}
        of = [next(kind for kind, known in kinds.items() if known[n, seat] >= references[n, seat]) for seat in SEATS]
        yield {"partner": player.group, "member": player.member, "source": player.source, **seats, "of": of}


def _list_pairs(result: HoldoutResult) -> Iterator[dict[str, Any]]:
    casting = result.casting
    for r, ego in enumerate(casting.ego_players):
        for k, partner in enumerate(casting.partner_players):
            for seat in SEATS:
                names = {"ego": ego.group, "member": ego.member, "ego_source": ego.source, "partner": partner.group}
                scores = result.scores[r, k, seat]
                where = {"partner_member": partner.member, "partner_source": partner.source, "seat": seat}
                yield {**names, **where, **_describe_scores(scores), "scores": scores.tolist()}


_MARGINS = (
    "Intervals (95 %) of margins draw partners anew, and the seeds of the ego and of the control each on their own, "
    "wherever there are several."
)


def _write_notes(result: HoldoutResult) -> list[str]:
    return [
        "SD is over episodes, SE = SD / sqrt(episodes); intervals (95 %) draw partners anew within their population, "
        "and an ego's seeds, wherever there are several. Those over few seeds are too narrow.",
        *_write_reference_notes(result),
        *_write_response_notes(result),
        *_write_origin_notes(result),
    ]


def _write_reference_notes(result: HoldoutResult) -> Iterator[str]:
    """What BR-Prox divides by, of partners that are no copies of others."""
    kept = list_distinct(result.casting.partner_players)
    total, kinds, references = len(kept), list_references(result), find_references(result)[kept] > 0.0
    counts = {kind: int(np.isfinite(kinds[kind][kept]).any(1).sum()) for kind in (BEST_RESPONSE, MATE)}
    yield (
        "BR-Prox divides by the best response known, whichever scores most: a trained one "
        f"({counts[BEST_RESPONSE]} of {total} partners), the mate that it was trained in a pair with ({counts[MATE]}), "
        "or the partner with itself."
    )
    for number, where in ((0, "in either seat"), (1, "in one of the seats")):
        if useless := int((references.sum(1) == number).sum()):
            yield f"{useless} of {total} partners have no reference that scores {where}: left out of BR-Prox there."


def _write_response_notes(result: HoldoutResult) -> Iterator[str]:
    """How the best responses were trained, each way once."""
    casting = result.casting
    used = {one.identity: casting.responses.get(one.identity or "") for one in casting.partner_players}
    counts: dict[str, int] = {}
    for one in used.values():
        if one is not None:
            settings = "".join(f", {name}={value}" for name, value in one.settings.items())
            way = f"scale={one.scale}{settings}: {one.steps:,} steps"
            counts[way] = counts.get(way, 0) + 1
    yield from (f"Best responses ({count}) were trained with {way} each." for way, count in counts.items())


def _write_origin_notes(result: HoldoutResult) -> Iterator[str]:
    """Copies of one policy, and egos of which too little is known."""
    casting = result.casting
    for who, players in (("partners", casting.partner_players), ("players of egos", casting.ego_players)):
        if copies := len(players) - len(list_distinct(players)):
            yield f"{copies} of {len(players)} {who} are copies of others, which count once in a set."
    unknown = [group.label for group in casting.egos if not group.on_record]
    if unknown:
        yield f"What they were trained with is not on record, or not in full: {', '.join(unknown)}."


def to_csv_text(report: Mapping[str, Any]) -> str:
    """One row for each pair and seat of the ego."""
    known = {(one["partner"], one["source"], one["member"]): one for one in report["reference"]}
    rows = []
    for pair in report["pairs"]:
        best = known[pair["partner"], pair["partner_source"], pair["partner_member"]][f"seat_{pair['seat']}"]
        ratio = pair["mean"] / best if best and best > 0 else None
        figures = {"reference": best, "br_prox": ratio, "br_prox_clipped": None if ratio is None else min(1.0, ratio)}
        more = {"ego_member": pair["member"], "episodes": report["episodes"], "regret": best - pair["mean"]}
        rows.append({**pair, **figures, **more})
    return to_csv(rows, CSV_FIELDS)


def write_report(report: Mapping[str, Any], folder: str | Path) -> dict[str, Path]:
    """Write holdout.json, .csv, .md, .png and .svg of `to_dict`'s object; gives the paths by suffix.

    Raises:
        UserError: the folder cannot be written.
    """
    from popgen.reports.charts.holdout_chart import draw_standings
    from popgen.reports.holdout_tables import to_markdown

    folder = Path(folder)
    paths = {suffix: folder / f"holdout.{suffix}" for suffix in ("json", "csv", "md", "png", "svg")}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        paths["json"].write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        paths["csv"].write_text(to_csv_text(report), encoding="utf-8")
        paths["md"].write_text(to_markdown(report), encoding="utf-8")
        draw_standings(report, [paths["png"], paths["svg"]])
    except OSError as error:
        raise UserError(str(folder), f"cannot be written: {error.strerror}", "choose another folder") from error
    return paths
