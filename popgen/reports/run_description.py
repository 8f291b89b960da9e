"""A run and its experiment in a few lines of Markdown, as MLflow shows them above its charts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from popgen.population.member_pairs import read_mates
from popgen.reports.crossplay_report import matrix_sheet, restate_pairs
from popgen.reports.frames import estimate_text, number_text, steps_text
from popgen.reports.method_titles import title_of
from popgen.reports.run_findings import Finding
from popgen.reports.run_record import RunRecord
from popgen.types import Kind

MARKS = {True: "✓", False: "⚠", None: "·"}

_LISTED = 30
"""Runs in the table of an experiment, the latest."""

_PICTURES = ("crossplay.png", "learning_first.png", "learning_later.png", "steps_by_members.png")


def describe_run(run: RunRecord, findings: Sequence[Finding]) -> str:
    """The SP/XP table, what it means, and pictures; addresses are `artefact:PATH` of the run's artefacts."""
    scores = run.scores
    real = sum(member.real for member in run.members)
    head = f"**{run.environment.name}, {title_of(run.method)}, seed {run.seed}**: "
    head += f"{len(run.members)} members, SP {estimate_text(scores['sp'])}, XP {estimate_text(scores['xp'])} "
    head += f"{scores['unit']}, {steps_text(real)} real environment steps"
    simulated = sum(member.steps.get(str(Kind.SIMULATED), 0) for member in run.members)
    head += f", {steps_text(simulated)} simulated ones" if simulated else ""
    said = "\n".join(f"- {MARKS[finding.good]} {finding.text}" for finding in findings)
    there = [name for name in _PICTURES if (run.path / "report" / name).is_file()]
    pictures = "\n".join(f"![{Path(name).stem}](artefact:report/{name})" for name in there)
    whole = "The whole on one page, with replays: artefact `report/report.html`."
    return "\n\n".join([head, said, matrix_sheet(scores).to_markdown(), whole, pictures]) + "\n"


def describe_experiment(run: Path) -> str:
    """A table of the finished runs beside `run`, itself among them, and the latest one's picture of SP and XP."""
    rows = []
    folders = sorted(run.parent.iterdir(), key=lambda path: path.stat().st_mtime)
    for folder in folders:
        try:
            scores = json.loads((folder / "report" / "crossplay.json").read_text(encoding="utf-8"))
            mates = read_mates(folder / "population")
            scores = restate_pairs(scores, mates) if mates else scores
            sp, xp = (number_text(scores[name]["mean"]) for name in ("sp", "xp"))
            seed, size = scores["training_seed"], len(scores["members"])
            cells = (folder.name, title_of(scores["method"]), scores["environment"]["name"], seed, size, sp, xp)
        except (OSError, ValueError, LookupError, TypeError, AttributeError):
            continue
        rows.append(f"| {' | '.join(str(cell).replace('|', '/') for cell in cells)} |")
    head = "| run | method | layout | seed | members | SP | XP |\n| -- | -- | -- | --: | --: | --: | --: |"
    note = "Populations of partners: SP is play of a member with itself (in pairs: with its mate), XP of two different "
    note += "ones (in pairs: of different pairs). Runs of members are nested in their population's. To compare "
    note += "methods, choose their runs and look at `environment_steps`, against the number of agents (step)."
    return f"{note}\n\n{head}\n" + "\n".join(rows[-_LISTED:]) + "\n\n![SP/XP](artefact:report/crossplay.png)\n"
