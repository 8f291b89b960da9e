"""Where commands write: what a run or a population consists of is never written over."""

from __future__ import annotations

from pathlib import Path

from popgen.cli.printing import tell_notes
from popgen.errors import UserError

REPORT_BYTES = 16 * 2**20
"""Room that a report needs at most."""

_OWN_FILES = {
    "manifest.json": "a population",
    "member.json": "a member of a population",
    "config.json": "a run",
    "study.json": "a study",
}
"""A file that only such a folder has -> what the folder is."""


def check_report_folder(out: Path, needed: int = REPORT_BYTES, *, quiet: bool = False) -> None:
    """A report's folder, by `--out`: writable, with room, and not that of a run, a population or a study.

    Says so where an earlier report lies there, which is replaced.

    Raises:
        UserError: another folder is to be chosen.
    """
    from popgen.runs.preflight import check_root

    for name, owner in _OWN_FILES.items():
        if (out / name).exists():
            raise UserError("--out", f"{out} is the folder of {owner}", "give the report a folder of its own")
    check_root(out, needed, "--out")
    if not quiet and any(out.glob("*.json")):
        tell_notes([f"{out} holds an earlier report, which is replaced (--out DIR keeps it)"])


def check_written_file(path: str | None, field: str, suffix: str) -> None:
    """A file that a command writes: named by its kind, so that nothing of another kind is replaced.

    Args:
        path: None where the command chooses.
        field: the option.
        suffix: such as `.html`.

    Raises:
        UserError: it has another suffix, or is a folder.
    """
    if path is None:
        return
    if Path(path).suffix.lower() != suffix:
        raise UserError(field, f"{path} does not end in {suffix}", f"name a file such as {Path(path).stem}{suffix}")
    if Path(path).is_dir():
        raise UserError(field, f"{path} is a folder", "name a file in it")
