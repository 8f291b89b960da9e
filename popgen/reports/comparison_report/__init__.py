"""A comparison of runs as JSON, CSV, Markdown, tables for the terminal and charts.

Keys of the JSON object (`comparison.json`); null stands for what is unknown:

    format, format_version   "popgen-comparison", 1
    agents                   M up to which costs are extrapolated, null for costs as measured
    runs                     label, method, environment, cooking, fingerprint, seed, scale, path, members, adopted,
                             attempts, steps (by kind), real_steps, simulated_steps, evaluation_steps,
                             held_episodes, held_steps (of the evaluation made for this), lost_steps, seconds
    costs                    one per run and M: label, environment, seed, agents, measured, rule, steps (by kind,
                             cumulative), real_steps, simulated_steps, seconds
    scores                   one per label and environment: seeds, sp and xp (mean, low, high over seeds), gap, beside
                             (random, idle), paper (sp, xp or null)
    headline                 one per label and environment: agents (M), runs, passed (runs whose first M agents all
                             passed), steps (mean, low, high of the real steps taken in all by then), simulated, ratio
                             (over the label with the fewest of those whose runs all passed)
    quality                  thresholds (environment -> sp, xp or null), members (label, environment, seed, member,
                             passed or null, sp, xp, taken, simulated, spent, window), agents (label, environment,
                             seed, agents, steps, simulated, reached, lower_bound)
    options                  one per label and environment: given (settings that are not the recipe's), cross_play (all
                             that decide how cross-play is pressed down)
    paper                    environment -> method -> sp, xp: all that the paper has on these environments
    budgets                  both readings of the baselines' budget: source (`paper` or a run), method, environment,
                             agents, reading, budget, steps (by kind), total, ratio (over the paper's XPM-WM)
    notes                    what a reader must know, in sentences

`comparison_contents` makes that object, `comparison_tables` its CSV files and tables, `comparison_charts` the charts.
"""

from __future__ import annotations

import json
from pathlib import Path

from popgen.errors import UserError
from popgen.reports.comparison_report.comparison_charts import draw_comparison
from popgen.reports.comparison_report.comparison_contents import Comparison, chosen_thresholds, to_dict
from popgen.reports.comparison_report.comparison_tables import (
    BUDGET_FIELDS,
    COST_FIELDS,
    QUALITY_FIELDS,
    budgets_csv,
    costs_csv,
    quality_csv,
    to_markdown,
    to_sheets,
)

__all__ = [
    "BUDGET_FIELDS",
    "COST_FIELDS",
    "QUALITY_FIELDS",
    "Comparison",
    "budgets_csv",
    "chosen_thresholds",
    "costs_csv",
    "draw_comparison",
    "quality_csv",
    "to_dict",
    "to_markdown",
    "to_sheets",
    "write_report",
]


def write_report(comparison: Comparison, folder: str | Path) -> dict[str, Path]:
    """Write comparison.json and .md, costs.csv, quality.csv, budgets.csv and the charts; gives the paths by name.

    Raises:
        UserError: the folder cannot be written.
    """
    folder, report = Path(folder), to_dict(comparison)
    texts = {
        "comparison.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
        "comparison.md": to_markdown(report),
        "costs.csv": costs_csv(report),
        "quality.csv": quality_csv(report),
        "budgets.csv": budgets_csv(report),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        return {name: folder / name for name in texts} | draw_comparison(comparison, folder)
    except OSError as error:
        raise UserError(str(folder), f"cannot be written: {error.strerror}", "choose another folder") from error
