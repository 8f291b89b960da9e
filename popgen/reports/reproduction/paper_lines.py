"""The paper's figures, by the columns of the targets' tables."""

from __future__ import annotations

from collections import defaultdict

from popgen.reports import paper_figures as paper
from popgen.reports.conventions_report import PAPER as CONVENTIONS
from popgen.reports.paper_ego_figures import AVERAGES, EGOS, list_cells
from popgen.reports.reproduction.target_records import PaperLine

ANY_EXIT, SP, XP, TOTAL, AVERAGE = "any exit", "SP", "XP", "steps in all", "average"


def list_sabotage_lines(environment: str) -> list[PaperLine]:
    """Table "Results of the MPPMR environment"."""
    rows = [row for row in paper.SABOTAGE if row.environment == environment]
    return [PaperLine(row.method, {ANY_EXIT: row.average or 0.0, SP: row.sp, XP: row.xp}) for row in rows]


def list_score_lines(environment: str) -> list[PaperLine]:
    """Table "Average SP and XP Results"."""
    rows = [row for row in paper.REPORTED if row.environment == environment and not row.ended_early]
    return [PaperLine(row.method, {SP: row.sp, XP: row.xp}) for row in rows]


def list_step_lines(environment: str) -> list[PaperLine]:
    """Totals of eight agents, from the tables of hyper-parameters."""
    if environment not in paper.XPM_WM_STEPS:
        return []
    own = paper.xpm_wm_budget(environment, paper.AGENTS) or 0
    lines = [PaperLine(f"{paper.OWN_METHOD}, {paper.AGENTS} agents", {TOTAL: own})]
    for method in paper.BASELINES:
        for reading in paper.READINGS:
            steps = paper.baseline_budget(method, paper.AGENTS, reading)
            lines.append(PaperLine(f"{method}, {paper.AGENTS} agents, {reading}", {TOTAL: sum(steps.values())}))
    return lines


def list_ego_lines(environment: str) -> list[PaperLine]:
    """The table of the layout: an ego a row, here; its columns are hold-out populations."""
    cells: dict[str, dict[str, float]] = defaultdict(dict)
    for cell in list_cells(environment):
        cells[cell.ego][f"beside {cell.holdout}"] = cell.mean
    averages: dict[str, float] = dict(zip(EGOS, AVERAGES.get(environment, ()), strict=False))
    return [PaperLine(f"E-{ego}", {**row, AVERAGE: averages[ego]}) for ego, row in cells.items()]


def list_convention_lines(environment: str) -> list[PaperLine]:
    """Table 3, over all layouts: dishes of people with a convention less those of all, beside its egos."""
    found: dict[str, dict[str, float]] = defaultdict(dict)
    for behaviour, egos in CONVENTIONS.items():
        for ego, (high, low) in egos.items():
            found[ego] |= {f"{behaviour}, high": high, f"{behaviour}, low": low}
    return [PaperLine(f"{ego}, people", cells) for ego, cells in found.items()]
