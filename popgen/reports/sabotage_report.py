"""The paper's first table with our rows beside its own, as JSON, CSV, Markdown and a table for the terminal.

Keys of the JSON object (`self_sabotage.json`); a figure is `{"mean": x, "standard_error": x}`, null where unknown:

    format, format_version   "popgen-self-sabotage", 1
    environment              its name
    episodes, seed           episodes per ordered pair of members; seed of the evaluation
    steps                    environment steps by ledger kind: {"evaluation": N}
    rows                     one a population: method, name, termination (`plain` or `penalty`: the rule by which an
                             exit is paid in training), training_seed, population (path), training_steps (by kind),
                             members, self_sabotage and ended_early (a fraction per member), average,
                             average_ended_early, sp, xp, scored (sp and xp of the same episodes paid by each rule),
                             landmarks (used, members: the landmark of each one's self-play or null, counts), matrix
                             (mean score, row = seat 0), exits (fraction per ordered pair and seat)
    means                    over the populations of one method and termination: populations, and mean, low and high of
                             average, average_ended_early, sp and xp
    paper                    method -> agents, average, sp and xp of the paper's table
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

from popgen.reports.paper_figures import METHOD_NAMES, SABOTAGE

PLAIN, PENALTY = "plain", "penalty"
TERMINATIONS: dict[str, dict[str, Any]] = {
    PENALTY: {"exit_penalty": "absorbing", "exit_reward": None},
    PLAIN: {"exit_penalty": "none", "exit_reward": None},
}
"""How an exit is paid -> parameters of the environment."""

TITLES = {
    PENALTY: "an exit costs the worst reward for every step that was left",
    PLAIN: "an exit ends the episode and costs nothing",
    "": "as trained",
}
CSV_FIELDS = (
    *("source", "method", "name", "termination", "training_seed", "member", "self_sabotage", "ended_early"),
    *("landmark", "sp", "xp", "sp_plain", "xp_plain", "sp_penalty", "xp_penalty"),
)
"""One row a member, then one with member `average`; `source` is popgen or paper. Scores stand on the average's row."""


def termination_of(params: Mapping[str, Any]) -> str:
    """Which rule an environment's parameters mean; empty where it has no such choice."""
    return next((name for name, rule in TERMINATIONS.items() if params.get("exit_penalty") == rule["exit_penalty"]), "")


def build_report(environment: str, episodes: int, seed: int, steps: int, rows: Sequence[Mapping[str, Any]]) -> dict:
    """The JSON object of the module's docstring, from its rows."""
    return {
        "format": "popgen-self-sabotage",
        "format_version": 1,
        "environment": environment,
        "episodes": episodes,
        "seed": seed,
        "steps": {"evaluation": steps},
        "rows": [dict(row) for row in rows],
        "means": _means(rows),
        "paper": {
            method: {"agents": list(row.agents), "average": row.average, "sp": row.scores.sp, "xp": row.scores.xp}
            for method, row in SABOTAGE.items()
        },
    }


def _means(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["termination"], row["name"], row["method"]), []).append(row)
    found = []
    for (termination, name, method), members in groups.items():
        figures = {"average": [row["average"] for row in members]}
        figures["average_ended_early"] = [row["average_ended_early"] for row in members]
        figures |= {score: [row[score]["mean"] for row in members] for score in ("sp", "xp")}
        found.append(
            {"method": method, "name": name, "termination": termination, "populations": len(members)}
            | {key: _spread(values) for key, values in figures.items()}
        )
    return found


def _spread(values: Sequence[float | None]) -> dict[str, float | None]:
    known = [value for value in values if value is not None]
    if not known:
        return {"mean": None, "low": None, "high": None}
    return {"mean": sum(known) / len(known), "low": min(known), "high": max(known)}


def to_csv(report: Mapping[str, Any]) -> str:
    """The table in long form, with the header CSV_FIELDS."""
    text = io.StringIO()
    writer = csv.DictWriter(text, CSV_FIELDS, lineterminator="\n", restval="")
    writer.writeheader()
    for row in report["rows"]:
        head = {"source": "popgen", **{key: row[key] for key in ("method", "name", "termination", "training_seed")}}
        landmarks = row["landmarks"]["members"] if row["landmarks"] else [None] * len(row["members"])
        for at, member in enumerate(row["members"]):
            own = {"self_sabotage": row["self_sabotage"][at], "ended_early": row["ended_early"][at]}
            writer.writerow(head | own | {"member": member, "landmark": _or_empty(landmarks[at])})
        total = {"member": "average", "self_sabotage": row["average"], "ended_early": row["average_ended_early"]}
        total |= {score: _or_empty(row[score]["mean"]) for score in ("sp", "xp")}
        for rule, figures in row["scored"].items():
            total |= {f"{score}_{rule}": _or_empty(figures[score]["mean"]) for score in ("sp", "xp")}
        writer.writerow(head | total)
    for method, row in report["paper"].items():
        head = {"source": "paper", "method": method, "name": METHOD_NAMES[method]}
        for member, fraction in enumerate(row["agents"], start=1):
            writer.writerow(head | {"member": member, "ended_early": fraction})
        writer.writerow(head | {"member": "average", "ended_early": row["average"], "sp": row["sp"], "xp": row["xp"]})
    return text.getvalue()


def _or_empty(value: Any) -> Any:
    return "" if value is None else value


def _lines(report: Mapping[str, Any], termination: str) -> tuple[list[str], list[list[str]]]:
    """Header and rows of one termination's table, the paper's rows below ours."""
    ours = [row for row in report["rows"] if row["termination"] == termination]
    size = max((len(row["members"]) for row in ours), default=0)
    size = max(size, max(len(row["agents"]) for row in report["paper"].values()))
    head = ["", *(str(agent) for agent in range(1, size + 1)), "average", "any exit", "SP", "XP", "landmarks"]
    lines = []
    for row in ours:
        agents = [f"{value:.2f}" for value in row["self_sabotage"]] + [""] * (size - len(row["members"]))
        used = f"{len(row['landmarks']['used'])} of {row['landmarks']['of']}" if row["landmarks"] else "-"
        scores = [_score(row["sp"]["mean"]), _xp(row)]
        label = f"{row['name']}, seed {row['training_seed']}"
        average, ended = f"{row['average']:.3f}", f"{row['average_ended_early']:.3f}"
        lines.append([label, *agents, average, ended, *scores, used])
    for method, row in report["paper"].items():
        agents = [f"{value:g}" for value in row["agents"]] + [""] * (size - len(row["agents"]))
        scores = [_score(row["sp"]), _score(row["xp"])]
        lines.append([f"{METHOD_NAMES[method]}, paper", *agents, *[f"{row['average']:g}"] * 2, *scores, "-"])
    return head, lines


def _score(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _xp(row: Mapping[str, Any]) -> str:
    """Cross-play as it was paid in training and, where exits cost nothing, what it is with the penalty."""
    paid = _score(row["xp"]["mean"])
    other = row["scored"].get(PENALTY) if row["termination"] == PLAIN else None
    return paid if other is None else f"{paid} ({_score(other['xp']['mean'])})"


def terminations(report: Mapping[str, Any]) -> list[str]:
    """The rules that the rows were trained by, in order."""
    return list(dict.fromkeys(row["termination"] for row in report["rows"]))


NOTES = (
    "Self-sabotage: fraction of cross-play episodes with earlier agents in which this agent itself left, both "
    "seatings. Any exit: episodes that ended early, whoever left; the paper counts these.",
    "XP in brackets: the same episodes paid with the penalty.",
    "Landmarks: how many of them members use in self-play.",
)


def to_tables(report: Mapping[str, Any]) -> list[Table]:
    """One table for the terminal for each rule of termination."""
    tables = []
    for termination in terminations(report):
        head, lines = _lines(report, termination)
        table = Table(title=f"self-sabotage in {report['environment']}: {TITLES[termination]}")
        table.add_column(head[0], style="bold", no_wrap=True)
        for label in head[1:]:
            table.add_column(label, justify="right")
        for line in lines:
            table.add_row(*line, style="dim" if line[0].endswith("paper") else None)
        tables.append(table)
    return tables


def to_markdown(report: Mapping[str, Any]) -> str:
    """All tables with what their columns mean."""
    parts = []
    for termination in terminations(report):
        head, lines = _lines(report, termination)
        parts += [f"Self-sabotage in {report['environment']}: {TITLES[termination]}.", ""]
        parts += ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
        parts += ["| " + " | ".join(line) + " |" for line in lines] + [""]
    parts += [f"- {note}" for note in NOTES]
    parts += [f"- {line}" for line in summary(report)]
    return "\n".join(parts) + "\n"


def summary(report: Mapping[str, Any]) -> list[str]:
    """Means over populations of the same method, where there are several, and what the evaluation cost."""
    lines = []
    for row in report["means"]:
        if row["populations"] > 1:
            parts = (f"{name} {_range(row[key])}" for name, key in (("average", "average"), ("SP", "sp"), ("XP", "xp")))
            of = f"{row['name']} ({row['termination'] or 'as trained'}), {row['populations']} populations"
            lines.append(f"{of}: {', '.join(parts)}")
    lines.append(f"{report['episodes']} episodes per pair, {report['steps']['evaluation']:,} environment steps")
    return lines


def _range(spread: Mapping[str, float | None]) -> str:
    if spread["mean"] is None:
        return "-"
    return f"{spread['mean']:.3f} ({spread['low']:.3f} to {spread['high']:.3f})"


def to_json(report: Mapping[str, Any]) -> str:
    """The JSON object as text."""
    return json.dumps(report, indent=1, allow_nan=False) + "\n"
