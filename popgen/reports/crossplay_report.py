"""Cross-play figures as JSON, CSV, Markdown and a table for the terminal.

Keys of the JSON object (`to_json`); a figure is `{"mean": x, "standard_error": x}`, null where unknown:

    format, format_version   "popgen-crossplay", 1
    environment              as in the population's manifest: name, params, fingerprint, cooking, horizon, score_name
    method, members          training method; ids in the order of the matrix
    episodes, seed           episodes per ordered pair, seed of the evaluation
    unit                     of every score, such as dishes
    steps                    environment steps by ledger kind: {"evaluation": N}
    sp, xp                   figures: mean self-play over members; mean cross-play over ordered pairs i != j
    matrix                   mean and standard_error, lists of rows: row = seat 0, column = seat 1
    beside                   random and idle: `both` seats, partner in `seat_0`, partner in `seat_1`, all figures
    obstruction              random and idle: is xp below `beside.*.both` by more than two standard errors; pairs: for
                             each ordered pair that is below a member's own play beside such a partner: pair, partner,
                             member, xp and beside
    event_names, event_weights
    pairs                    every pairing: seat_0, seat_1 (a member's number, "random" or "idle"), score, reward and
                             shaped_return (sum over seats) as figures; scores of the episodes; events: mean count per
                             episode, a list per seat in the order of event_names

Standard errors are over episodes; they say nothing of how other members would do.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.table import Table

from popgen.errors import UserError
from popgen.evaluation.crossplay import IDLE, PARTNERS, RANDOM, CrossPlayResult, Estimate, Obstruction, Pairing

CSV_FIELDS = (
    "seat_0",
    "seat_1",
    "pairing",
    "figure",
    "seat",
    "mean",
    "standard_error",
    "episodes",
)
"""Long format: one figure a row. `pairing` is SP, XP, random or idle; `figure` is score, reward, shaped_return or
event:NAME; `seat` is 0 or 1 for events, empty for the team's figures."""


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _figure(estimate: Estimate) -> dict[str, float | None]:
    return {"mean": _number(estimate.mean), "standard_error": _number(estimate.error)}


def to_dict(result: CrossPlayResult) -> dict[str, Any]:
    """The JSON object of the module's docstring."""
    mean, error = result.table(result.labels)
    beside = {
        partner: {
            "both": _figure(result.beside(partner)),
            "seat_0": _figure(result.beside(partner, 0)),
            "seat_1": _figure(result.beside(partner, 1)),
        }
        for partner in PARTNERS
    }
    return {
        "format": "popgen-crossplay",
        "format_version": 1,
        "environment": result.environment.model_dump(mode="json"),
        "method": result.method,
        "members": list(result.members),
        "episodes": result.episodes,
        "seed": result.seed,
        "unit": result.environment.score_name,
        "steps": {"evaluation": result.steps},
        "sp": _figure(result.sp),
        "xp": _figure(result.xp),
        "matrix": {
            "mean": [[_number(cell) for cell in row] for row in mean],
            "standard_error": [[_number(cell) for cell in row] for row in error],
        },
        "beside": beside,
        "obstruction": {**result.obstruction, "pairs": [_obstruction(found) for found in result.obstructions]},
        "event_names": list(result.event_names),
        "event_weights": list(result.event_weights),
        "pairs": [_pair(pairing) for pairing in result.pairings.values()],
    }


def _obstruction(found: Obstruction) -> dict[str, Any]:
    return {
        "pair": list(found.pair),
        "partner": found.partner,
        "member": found.member,
        "xp": _figure(found.xp),
        "beside": _figure(found.beside),
    }


def _pair(pairing: Pairing) -> dict[str, Any]:
    return {
        "seat_0": pairing.seats[0],
        "seat_1": pairing.seats[1],
        "score": _figure(pairing.score),
        "reward": _figure(pairing.reward),
        "shaped_return": _figure(pairing.shaped),
        "scores": [float(score) for score in pairing.scores],
        "events": pairing.events.tolist(),
    }


def to_json(result: CrossPlayResult) -> str:
    """`to_dict` as text."""
    return json.dumps(to_dict(result), indent=2, allow_nan=False) + "\n"


def _sort(pairing: Pairing) -> str:
    for partner in PARTNERS:
        if partner in pairing.seats:
            return partner
    return "SP" if pairing.seats[0] == pairing.seats[1] else "XP"


def to_csv(result: CrossPlayResult) -> str:
    """Long format, one figure a row, with the header CSV_FIELDS."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(CSV_FIELDS)
    for pairing in result.pairings.values():
        head = (*pairing.seats, _sort(pairing))
        named = (("score", pairing.score), ("reward", pairing.reward), ("shaped_return", pairing.shaped))
        for name, figure in named:
            error = "" if math.isnan(figure.error) else figure.error
            writer.writerow((*head, name, "", figure.mean, error, result.episodes))
        for seat, counts in enumerate(pairing.events):
            for name, count in zip(result.event_names, counts, strict=True):
                writer.writerow((*head, f"event:{name}", seat, float(count), "", result.episodes))
    return text.getvalue()


def figure_text(figure: Mapping[str, float | None], digits: int = 2) -> str:
    """`mean ± standard error` of a figure of the JSON object; `-` for what was not played."""
    mean, error = figure["mean"], figure["standard_error"]
    if mean is None:
        return "-"
    return f"{mean:.{digits}f}" + ("" if error is None else f" ± {error:.{digits}f}")


def shown(estimate: Estimate, digits: int = 2) -> str:
    """`figure_text` of an estimate."""
    return figure_text(_figure(estimate), digits)


def summary(result: CrossPlayResult) -> list[str]:
    """The headline figures, a line of plain text each."""
    return summary_lines(to_dict(result))


def summary_lines(report: Mapping[str, Any]) -> list[str]:
    """The headline figures of the JSON object, a line of plain text each."""
    unit, beside, low = report["unit"], report["beside"], report["obstruction"]
    lines = [f"SP mean {figure_text(report['sp'])} {unit}", f"XP mean {figure_text(report['xp'])} {unit}"]
    for partner in PARTNERS:
        row = beside[partner]
        parts = ", ".join(f"partner in seat {seat} {figure_text(row[f'seat_{seat}'])}" for seat in (0, 1))
        lines.append(f"beside {partner} {figure_text(row['both'])} {unit} ({parts})")
    blocked = [partner for partner in PARTNERS if low[partner]]
    if blocked:
        lines.append(f"obstruction: XP is below play beside {' and '.join(blocked)} partners")
    pairs = sorted({tuple(found["pair"]) for found in low["pairs"]})
    if pairs:
        named = ", ".join(f"{i}-{j}" for i, j in pairs)
        lines.append(f"pairs (seat 0-seat 1) worse than a random or idle partner: {named}")
    lines.append(f"{report['episodes']} episodes per pair, {report['steps']['evaluation']:,} environment steps")
    return lines


def _rows(report: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    members = [str(member) for member in report["members"]]
    labels = (*members, RANDOM, IDLE)
    scores = {(pair["seat_0"], pair["seat_1"]): figure_text(pair["score"]) for pair in report["pairs"]}
    return ["seat 0 \\ seat 1", *labels], [[row, *(scores[row, column] for column in labels)] for row in members]


def to_markdown(result: CrossPlayResult) -> str:
    """A Markdown table of scores and the headline figures."""
    report = to_dict(result)
    head, rows = _rows(report)
    escaped = [head[0].replace("\\", "\\\\"), *head[1:]]
    lines = ["| " + " | ".join(escaped) + " |", "|" + " --- |" * len(head)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    title = f"{report['environment']['name']}: {report['unit']} per episode, mean ± standard error"
    return "\n".join([title, "", *lines, "", *(f"- {line}" for line in summary_lines(report))]) + "\n"


def to_rich(result: CrossPlayResult) -> Table:
    """`matrix_table` of a result."""
    return matrix_table(to_dict(result))


def matrix_table(report: Mapping[str, Any]) -> Table:
    """The matrix of the JSON object as a table for the terminal, self-play in bold."""
    head, rows = _rows(report)
    table = Table(title=f"{report['environment']['name']}: {report['unit']} per episode (± standard error)")
    table.add_column(head[0].replace(" \\ ", "\n\\ "), style="bold")
    for label in head[1:]:
        table.add_column(label, justify="right")
    for number, row in enumerate(rows):
        # The error goes below its mean, so that six members fit into 80 columns.
        narrow = [cell.replace(" ± ", "\n±") for cell in row[1:]]
        cells = [f"[bold]{cell}[/bold]" if k == number else cell for k, cell in enumerate(narrow)]
        table.add_row(row[0], *cells)
    return table


def write_report(result: CrossPlayResult, folder: str | Path) -> dict[str, Path]:
    """Write crossplay.json, .csv, .md, .png and .svg; gives the paths by suffix.

    Raises:
        UserError: the folder cannot be written.
    """
    from popgen.reports.plots import crossplay_heat_map

    folder = Path(folder)
    paths = {suffix: folder / f"crossplay.{suffix}" for suffix in ("json", "csv", "md", "png", "svg")}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        paths["json"].write_text(to_json(result), encoding="utf-8")
        paths["csv"].write_text(to_csv(result), encoding="utf-8")
        paths["md"].write_text(to_markdown(result), encoding="utf-8")
        crossplay_heat_map(result, [paths["png"], paths["svg"]])
    except OSError as error:
        raise UserError(str(folder), f"cannot be written: {error.strerror}", "choose another folder") from error
    return paths
