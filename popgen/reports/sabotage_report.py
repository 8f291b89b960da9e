"""The paper's first table with our rows beside its own, as JSON, CSV, Markdown and a table for the terminal.

Keys of the JSON object (`self_sabotage.json`); a figure is `{"mean": x, "standard_error": x}`, null where unknown:

    format, format_version   "popgen-self-sabotage", 1
    environment              its name
    episodes, seed           episodes per ordered pair of members; seed of the evaluation
    steps                    environment steps by ledger kind: {"evaluation": N}
    rows                     one a population: method, name, termination (`plain` or `penalty`: the rule by which an
                             exit is paid in training), training_seed, population (path), training_steps (by kind),
                             members, self_sabotage and ended_early (a fraction per member), average,
                             average_ended_early, sp, xp, xp_apart (of pairs that do not share a landmark), pairs (all:
                             how many, sharing: those at one landmark), beside (mean score with a random and an idle
                             partner), scored (sp and xp of the same episodes paid by each rule), landmarks (used,
                             members: the landmark of each one's self-play or null, counts), matrix (mean score, row =
                             seat 0), exits (fraction per ordered pair and seat)
    means                    over the populations of one method and termination: populations, and mean, low and high of
                             average, average_ended_early, sp, xp, xp_apart, sharing (pairs at one landmark), random and
                             idle (beside them)
    paper                    method -> agents, average, sp and xp of the paper's table
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pandas as pd

from popgen.evaluation.crossplay import IDLE, PARTNERS, RANDOM
from popgen.reports.frames import UNKNOWN, Sheet, number_text, range_text, spread_of, to_csv
from popgen.reports.method_titles import name_of, title_of
from popgen.reports.paper_figures import SABOTAGE

MEANS = ("sp", "xp", "xp_apart")
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
    "source",
    "method",
    "name",
    "termination",
    "training_seed",
    "member",
    "self_sabotage",
    "ended_early",
    "landmark",
    "sp",
    "xp",
    "sp_plain",
    "xp_plain",
    "sp_penalty",
    "xp_penalty",
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
        "means": _average_populations(rows),
        "paper": {
            name_of(row.method): {"agents": list(row.ended_early), "average": row.average, "sp": row.sp, "xp": row.xp}
            for row in SABOTAGE
        },
    }


def _average_populations(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Of each method and termination."""
    heads = ("method", "name", "termination")
    names = ("average", "average_ended_early", *MEANS, "sharing", *PARTNERS)
    cells = [
        {**row, "sharing": len(row["pairs"]["sharing"])}
        | {name: row[name]["mean"] for name in MEANS}
        | {partner: row["beside"][partner]["mean"] for partner in PARTNERS}
        for row in rows
    ]
    frame = pd.DataFrame(cells, columns=[*heads, *names])
    return [
        dict(zip(heads, key, strict=True))
        | {"populations": len(part)}
        | {name: spread_of(part[name]) for name in names}
        for key, part in frame.groupby([*heads], sort=False)
    ]


def members_csv(report: Mapping[str, Any]) -> str:
    """The table in long form, with the header CSV_FIELDS."""
    return to_csv([*_list_ours(report), *_list_papers(report)], CSV_FIELDS)


def _list_ours(report: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for row in report["rows"]:
        head = {"source": "popgen", **{key: row[key] for key in ("method", "name", "termination", "training_seed")}}
        landmarks = row["landmarks"]["members"] if row["landmarks"] else [None] * len(row["members"])
        columns = (row["members"], row["self_sabotage"], row["ended_early"], landmarks)
        for cells in zip(*columns, strict=True):
            yield head | dict(zip(("member", "self_sabotage", "ended_early", "landmark"), cells, strict=True))
        total = {"member": "average", "self_sabotage": row["average"], "ended_early": row["average_ended_early"]}
        total |= {score: row[score]["mean"] for score in ("sp", "xp")}
        for rule, figures in row["scored"].items():
            total |= {f"{score}_{rule}": figures[score]["mean"] for score in ("sp", "xp")}
        yield head | total


def _list_papers(report: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for method, row in report["paper"].items():
        head = {"source": "paper", "method": method, "name": title_of(method)}
        for member, fraction in enumerate(row["agents"], start=1):
            yield head | {"member": member, "ended_early": fraction}
        yield head | {"member": "average", "ended_early": row["average"], "sp": row["sp"], "xp": row["xp"]}


def to_sheets(report: Mapping[str, Any]) -> list[Sheet]:
    """One table for each rule of termination, the paper's rows below ours."""
    return [_make_sheet(report, rule) for rule in dict.fromkeys(row["termination"] for row in report["rows"])]


def _make_sheet(report: Mapping[str, Any], termination: str) -> Sheet:
    ours = [_our_cells(row) for row in report["rows"] if row["termination"] == termination]
    theirs = [_paper_cells(method, row) for method, row in report["paper"].items()]
    size = max(len(cells["agents"]) for cells in ours + theirs)
    agents = [cells["agents"] + [""] * (size - len(cells["agents"])) for cells in ours + theirs]
    frame = pd.DataFrame(ours + theirs).drop(columns="agents")
    for number in range(size):
        frame.insert(1 + number, str(number + 1), [cells[number] for cells in agents])
    title = f"Self-sabotage in {report['environment']}: {TITLES[termination]}"
    return Sheet(title, frame, dim=frozenset(range(len(ours), len(frame))))


def _our_cells(row: Mapping[str, Any]) -> dict[str, Any]:
    landmarks = row["landmarks"]
    return {
        "": f"{row['name']}, seed {row['training_seed']}",
        "agents": [f"{value:.2f}" for value in row["ended_early"]],
        "any exit": f"{row['average_ended_early']:.3f}",
        "own exit": f"{row['average']:.3f}",
        "SP": number_text(row["sp"]["mean"]),
        "XP": _cross_play_text(row),
        "XP apart": number_text(row["xp_apart"]["mean"]),
        "landmarks": f"{len(landmarks['used'])} of {landmarks['of']}" if landmarks else UNKNOWN,
        "pairs at one": f"{len(row['pairs']['sharing'])} of {row['pairs']['all']}" if landmarks else UNKNOWN,
        "beside random, idle": _beside_text(row),
    }


def _paper_cells(method: str, row: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "": f"{title_of(method)}, paper",
        "agents": [f"{value:g}" for value in row["agents"]],
        "any exit": f"{row['average']:g}",
        "own exit": UNKNOWN,
        "SP": number_text(row["sp"]),
        "XP": number_text(row["xp"]),
        **dict.fromkeys(("XP apart", "landmarks", "pairs at one", "beside random, idle"), UNKNOWN),
    }


def _beside_text(row: Mapping[str, Any]) -> str:
    return ", ".join(number_text(row["beside"][partner]["mean"], 1) for partner in (RANDOM, IDLE))


def _cross_play_text(row: Mapping[str, Any]) -> str:
    """Cross-play as it was paid in training and, where exits cost nothing, what it is with the penalty."""
    paid = number_text(row["xp"]["mean"])
    other = row["scored"].get(PENALTY) if row["termination"] == PLAIN else None
    return paid if other is None else f"{paid} ({number_text(other['xp']['mean'])})"


NOTES = (
    "By agent, and any exit on average: fraction of cross-play episodes with earlier agents that ended early, whoever "
    "left, both seatings; the paper counts these. Own exit: those in which this agent itself left.",
    "XP in brackets: the same episodes paid with the penalty. XP apart: of pairs that do not share a landmark.",
    "Landmarks: how many of them members use in self-play; pairs at one: pairs of members that share one.",
    "Not to leave is no merit of members that play like independent seeds: compare XP with self-play only.",
)


def to_markdown(report: Mapping[str, Any]) -> str:
    """All tables with what their columns mean."""
    parts = [f"{sheet.title}.\n\n{sheet.to_markdown()}\n\n" for sheet in to_sheets(report)]
    return "".join([*parts, *(f"- {line}\n" for line in (*NOTES, *summary(report)))])


SUMMARISED = (
    ("any exit", "average_ended_early"),
    ("own", "average"),
    ("SP", "sp"),
    ("XP", "xp"),
    ("XP apart", "xp_apart"),
    ("pairs at one", "sharing"),
)


def summary(report: Mapping[str, Any]) -> list[str]:
    """Means over populations of the same method, where there are several, and what the evaluation cost."""
    lines = []
    for row in report["means"]:
        if row["populations"] > 1:
            parts = (f"{name} {range_text(row[key], 3)}" for name, key in SUMMARISED)
            of = f"{row['name']} ({row['termination'] or 'as trained'}), {row['populations']} populations"
            lines.append(f"{of}: {', '.join(parts)}")
    lines.append(f"{report['episodes']} episodes per pair, {report['steps']['evaluation']:,} environment steps")
    return lines


def to_json(report: Mapping[str, Any]) -> str:
    """The JSON object as text."""
    return json.dumps(report, indent=1, allow_nan=False) + "\n"
