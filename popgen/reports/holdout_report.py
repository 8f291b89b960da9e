"""A hold-out evaluation as JSON, CSV, Markdown, tables for the terminal and a chart.

Keys of the JSON object (`holdout.json`); null stands for what is unknown:

    format, format_version   "popgen-holdout", 1
    environment              as in a population's manifest
    unit, episodes, seed     of scores; for each pair and seat; of the evaluation
    steps                    {"evaluation": N}
    egos, partners           groups: label, method, taught_by (methods), human, players (source, member, sha256,
                             response: was a best response to it played)
    standings                one for each ego and set of partners: ego, partners, count, mean, sd, se, interval,
                             seat_0, seat_1 (where the ego sat), worst (score, ego, partner, seat), cvar_25,
                             br_prox_iqm, br_prox_unclipped, normalised_return, regret
    controls                 egos: ego, alone, beside random and idle; partners: alone, beside random and idle
                             (mean, sd, se)
    margins                  ego, control, partners, gain (value, low, high)
    reference                best response known to each partner: partner, member, source, seat_0, seat_1, of
                             (`self-play` or `best response`, by seat)
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
from popgen.evaluation.holdout_figures import Standing, describe_all, find_references, measure_margins
from popgen.evaluation.holdout_metrics import describe_spread
from popgen.evaluation.holdout_players import Group
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
        "notes": _write_notes(result),
    }
    return jsonable(report)


def _describe_group(result: HoldoutResult, group: Group) -> dict[str, Any]:
    players = [
        {
            "source": one.source,
            "member": one.member,
            "sha256": one.digest,
            "response": (one.digest or "") in result.casting.responses,
        }
        for one in group.players
    ]
    human = group.label in result.casting.humans
    taught = sorted(group.taught_by)
    return {"label": group.label, "method": group.method, "taught_by": taught, "human": human, "players": players}


def _describe_standing(one: Standing) -> dict[str, Any]:
    return {
        **{"ego": one.ego, "partners": one.partners, "count": one.count},
        **{"mean": one.score.mean, "sd": one.score.sd, "se": one.score.se},
        "interval": {"low": one.interval.low, "high": one.interval.high},
        **{"seat_0": one.seats[0], "seat_1": one.seats[1]},
        "worst": asdict(one.worst),
        "cvar_25": one.cvar,
        "br_prox_iqm": asdict(one.br_prox),
        "br_prox_unclipped": one.br_prox_unclipped,
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
        egos.append({"ego": group.label, "alone": _describe_scores(result.ego_alone[rows]), **beside})
    for group in casting.partners:
        columns = casting.columns([group.label])
        beside = {name: _describe_scores(result.partner_beside[name][columns]) for name in CONTROLS}
        partners.append({"partner": group.label, "alone": _describe_scores(result.partner_alone[columns]), **beside})
    return {"egos": egos, "partners": partners}


def _list_references(result: HoldoutResult) -> Iterator[dict[str, Any]]:
    references, trained = find_references(result), result.responses.mean(-1)
    for n, player in enumerate(result.casting.partner_players):
        of = ["best response" if trained[n, seat] >= references[n, seat] else "self-play" for seat in SEATS]
        seats = {f"seat_{seat}": references[n, seat] for seat in SEATS}
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


def _write_notes(result: HoldoutResult) -> list[str]:
    casting, references = result.casting, find_references(result)
    trained = int(np.isfinite(result.responses).all((1, 2)).sum())
    total = len(casting.partner_players)
    notes = [
        "SD is over episodes, SE = SD / sqrt(episodes); intervals (95 %) are over an ego's seeds, or over partners "
        "where it has one seed. Those over few seeds are too narrow.",
        f"BR-Prox divides by the best response known: a trained one for {trained} of {total} partners, else the "
        "partner with itself; where a trained one scores less than that, the partner with itself.",
    ]
    if useless := int((references <= 0.0).any(1).sum()):
        notes.append(
            f"{useless} of {total} partners scores nothing even so: there the clipped BR-Prox is 1 by definition."
        )
    unknown = [group.label for group in casting.egos if not group.on_record]
    if unknown:
        notes.append(f"What they were trained with is not on record: {', '.join(unknown)}.")
    return notes


def to_csv_text(report: Mapping[str, Any]) -> str:
    """One row for each pair and seat of the ego."""
    known = {(one["partner"], one["source"], one["member"]): one for one in report["reference"]}
    rows = []
    for pair in report["pairs"]:
        best = known[pair["partner"], pair["partner_source"], pair["partner_member"]][f"seat_{pair['seat']}"]
        ratio = pair["mean"] / best if best and best > 0 else None
        figures = {"reference": best, "br_prox": ratio, "br_prox_clipped": 1.0 if ratio is None else min(1.0, ratio)}
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
