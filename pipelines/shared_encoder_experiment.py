"""The shared-encoder ablation as a call: runs with and without it, trained or taken, and the report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.pipelines.run_batch import run_all
from popgen.progress import Reporter
from popgen.reports.run_record import read_run
from popgen.reports.shared_encoder_report import build_report, write_report


def shared_encoder(
    runs: Sequence[str | Path], starts: Sequence[RunConfig], out: str | Path, *, reporter: Reporter
) -> dict[str, Any]:
    """Learning curves of later members with the shared encoder and without it.

    Args:
        runs: folders of finished runs of either kind.
        starts: runs to start first, see `popgen.pipelines.run_batch`.
        out: folder of the report.
        reporter: told of progress.

    Returns:
        The object of `popgen.reports.shared_encoder_report.build_report` and `files` (paths by name).

    Raises:
        UserError: a run that fails or is unfinished, runs that cannot be compared, a folder that cannot be written.
    """
    known = [read_run(path) for path in runs]  # what is wrong with them is told before anything is trained
    folders = run_all(starts, reporter=reporter)
    report = build_report([*known, *(read_run(folder) for folder in folders)])
    try:
        files = write_report(report, Path(out))
    except OSError as error:
        raise UserError(str(out), f"cannot be written: {error.strerror}", "choose another folder") from error
    return report | {"files": {name: str(path) for name, path in files.items()}}
