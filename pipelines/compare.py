"""The comparison as one call: start what is asked for, read all runs, write the report, log it to MLflow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from popgen.config.run_config import RunConfig
from popgen.config.sections import TrackingConfig
from popgen.evaluation.held_members import HeldScores, hold_members
from popgen.pipelines.run_batch import run_all
from popgen.population import load_population
from popgen.progress import Reporter
from popgen.reports.comparison import Group, costs, group_runs, quality_costs
from popgen.reports.comparison_report import Comparison, chosen_thresholds, to_dict, write_report
from popgen.reports.run_record import REAL, RunRecord, planned_run, read_run
from popgen.runs.mlflow_tracker import SCALING_METRIC, Tracker, address_in_mlflow

EXPERIMENT = "popgen-compare"
"""Name of the MLflow experiment that comparisons go to."""

HELD_SEED = 20_000
"""Of held evaluations; no run is trained or evaluated with it by default."""


def compare_runs(
    runs: Sequence[tuple[str | None, str | Path]],
    starts: Sequence[tuple[str | None, RunConfig]],
    out: str | Path,
    *,
    agents: int | None,
    sp: float | None,
    xp: float | None,
    episodes: int,
    tracking: TrackingConfig,
    reporter: Reporter,
) -> dict[str, Any]:
    """Compare finished runs, and runs that are started first.

    Args:
        runs: (label or None for the method, folder).
        starts: (label or None, run to start), see `popgen.pipelines.run_batch`; finished ones are not started again.
        out: folder of the report and, without another URI, of `mlflow.db`.
        agents: M up to which costs are extrapolated; None for costs as measured.
        sp, xp: thresholds of equal quality; None takes the defaults.
        episodes: of the held evaluation of every run, for each member alone and for each pair and seating.
        tracking: of the MLflow runs of this comparison.
        reporter: told of progress.

    Returns:
        The object of `popgen.reports.comparison_report`, `files` (paths by name) and `tracking` (command and address
        that show it in MLflow, None without).

    Raises:
        UserError: a run that is unfinished or cannot be compared with the others, or one that fails.
    """
    # All that can be refused is, before hours are spent.
    records = [read_run(path, label) for label, path in runs]
    planned = [planned_run(config, label) for label, config in starts]
    chosen_thresholds(group_runs(records + planned), sp, xp)
    folders = run_all([config for _, config in starts], reporter=reporter)
    started = [read_run(folder, label) for folder, (label, _) in zip(folders, starts, strict=True)]
    groups = group_runs(records + started)
    thresholds = chosen_thresholds(groups, sp, xp)
    held = hold_runs(groups, list(thresholds), episodes, reporter)
    comparison = Comparison(tuple(groups), agents, thresholds, held)
    files = write_report(comparison, out)
    tracked = log_comparison(comparison, files, Path(out), tracking)
    return to_dict(comparison) | {"files": {name: str(path) for name, path in files.items()}, "tracking": tracked}


def hold_runs(
    groups: Sequence[Group], environments: Sequence[str], episodes: int, reporter: Reporter
) -> dict[str, HeldScores]:
    """Held evaluations of all runs on some environments, with one seed and equally many episodes: folder -> scores."""
    runs = [run for group in groups if group.environment in environments for run in group.runs]
    if runs:
        reporter.phase("held evaluation", len(runs))
    found = {}
    for number, run in enumerate(runs, start=1):
        found[str(run.path)] = hold_members(load_population(run.path / "population"), episodes, HELD_SEED)
        reporter.update(number, run=run.run_id)
    return found


def log_comparison(
    comparison: Comparison, files: Mapping[str, Path], out: Path, tracking: TrackingConfig
) -> dict[str, str] | None:
    """One MLflow run for the comparison, with its tables and pictures, and a nested one for each run compared.

    Returns:
        The command and the address that show it; None with tracking disabled.
    """
    told = {"agents": comparison.agents or 0, "runs": len(_list_runs(comparison))}
    whole = Tracker(tracking, out, "comparison", told)
    for group in comparison.groups:
        for run in group.runs:
            name = f"{group.label}/{group.environment}/s{run.seed}"
            tracker = Tracker(tracking, out, name, _describe_run(group, run), parent=whole.run_id)
            figures = drop_constant_zeros(points(comparison, group, run))
            for agents, row in figures.items():
                tracker.log(row, step=agents)
                if SCALING_METRIC in row:
                    whole.log({f"environment_steps/{name}": row[SCALING_METRIC]}, step=agents)
            tracker.log({SCALING_METRIC: 0.0}, step=0)
            whole.log({f"environment_steps/{name}": 0.0}, step=0)
            tracker.finish()
    for path in files.values():
        whole.log_artifact(path, "comparison")
    if "comparison.md" in files:
        pictures = [name for name in files if name.endswith(".png")]
        shown = "\n".join(f"![{Path(name).stem}](artefact:comparison/{name})" for name in pictures)
        whole.describe(f"{shown}\n\n{files['comparison.md'].read_text(encoding='utf-8')}")
    whole.finish()
    return address_in_mlflow(tracking, whole.state(), out) if tracking.enabled else None


def drop_constant_zeros(points: Mapping[int, Mapping[str, float]]) -> dict[int, dict[str, float]]:
    """Without the figures that are 0 everywhere: they would be empty charts."""
    some = {name for row in points.values() for name, value in row.items() if value}
    return {agents: {name: row[name] for name in row if name in some} for agents, row in points.items()}


def points(comparison: Comparison, group: Group, run: RunRecord) -> dict[int, dict[str, float]]:
    """Number of agents -> metrics. Extrapolated figures have metrics of their own."""
    found: dict[int, dict[str, float]] = {}
    for cost in costs(run, comparison.agents):
        end = "by_members" if cost.measured else "by_members_extrapolated"
        figures = {f"environment_steps_{end}": cost.real, f"simulated_steps_{end}": cost.simulated}
        figures |= {f"{kind}_steps_{end}": cost.steps[str(kind)] for kind in REAL}
        if cost.seconds is not None:
            figures[f"seconds_{end}"] = cost.seconds
        found[cost.agents] = figures
    limits = comparison.thresholds.get(group.environment)
    held = comparison.held.get(str(run.path))
    if limits is not None and held is not None:
        for many in quality_costs(run, limits, held):
            end = "_lower_bound" if many.bound else ""
            found[many.agents][f"steps_to_quality_by_members{end}"] = float(many.steps)
    return found


def _describe_run(group: Group, run: RunRecord) -> dict[str, Any]:
    return {
        "label": group.label,
        "method": group.method,
        "environment": group.environment,
        "cooking": run.environment.cooking,
        "seed": run.seed,
        "scale": run.scale,
        "run": str(run.path),
        "members": len(run.members),
    }


def _list_runs(comparison: Comparison) -> list[RunRecord]:
    return [run for group in comparison.groups for run in group.runs]
