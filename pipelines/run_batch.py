"""Several runs, one after the other, of which finished ones stay."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.progress import Reporter
from popgen.reports.run_record import is_finished, read_run
from popgen.runs.directory import describe_settings


def named(config: RunConfig, root: Path) -> RunConfig:
    """The same run in `root`, under an id that its settings decide: the same command finds it again."""
    name = config.run.id or f"{describe_settings(config)}-{config.digest()[:8]}"
    return config.model_copy(update={"run": config.run.model_copy(update={"root": str(root), "id": name})})


def check_different(configs: Sequence[RunConfig]) -> None:
    """No two runs may have one folder.

    Raises:
        UserError: they would.
    """
    names: set[str] = set()
    for config in configs:
        if str(config.run.id) in names:
            raise UserError("run.id", f"two runs are called {config.run.id}", "start different ones, without run.id")
        names.add(str(config.run.id))


def run_all(configs: Sequence[RunConfig], *, reporter: Reporter) -> list[Path]:
    """Run what is not finished yet; an interrupted run goes on from its last checkpoint.

    Args:
        configs: validated, with root and id (`named`).
        reporter: told of progress, and of members that do not play.

    Returns:
        The runs' folders, in order.

    Raises:
        UserError: of a run, see `run_population`.
    """
    folders = []
    for number, config in enumerate(configs, start=1):
        folder = Path(config.run.root) / str(config.run.id)
        folders.append(folder)
        if is_finished(folder):
            reporter.note(f"run {number} of {len(configs)}: {folder} is finished")
        else:
            told = f"{config.method} on {config.env.name}, seed {config.run.seed}"
            reporter.note(f"run {number} of {len(configs)}: {told}")
            from popgen.pipelines.population import run_population  # with Ray, which finished runs do without

            run_population(config, reporter=reporter)
        for line in read_run(folder).weak_members:
            reporter.note(f"run {number} of {len(configs)}: {line}")
    return folders
