"""Which files one round of a later member goes through: `python tests/house/round_files.py` prints them.

Round 2 of member 2 of XPM-WM at scale=smoke, workers in this process: every function of this project that is called
between the end of round 1 and the end of round 2 counts for the file that defines it. Files of environments do not.
The checkpoint after the round counts too.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any
from unittest import mock

ROOT = Path(__file__).resolve().parents[2]
OVERRIDES = ("method=xpm_wm", "scale=smoke", "population.size=2", "phase2.rounds=3", "tracking=off")
MEMBER, ROUND = 2, 2
MOST = 25
"""Files that a round goes through at most; docs/design.md says which they are and why."""
SERVICES = ("actors", "pipelines", "popgen/runs", "popgen/progress.py", "popgen/durable_files.py", "popgen/config")
"""Rooms that know nothing of learning; the other files are the algorithm."""


@contextlib.contextmanager
def note_called_code(called: set[CodeType]) -> Iterator[None]:
    """Add the code of every Python function that is called in the block, by this thread or one that starts in it."""

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            called.add(frame.f_code)

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]


class RoundEndedError(Exception):
    """The round has been seen: the run need not go on."""


def run_one_round(root: Path) -> set[CodeType]:
    """The code that the round calls, of a run in `root`."""
    from popgen.cli.compose import compose
    from popgen.config.run_config import RunConfig
    from popgen.methods.training import Record, Round
    from popgen.pipelines import population
    from popgen.pipelines.training_driver import TrainingDriver
    from popgen.progress import NullReporter

    called: set[CodeType] = set()

    class ProfiledDriver(TrainingDriver):
        """Profiles from the end of one round to the end of the next."""

        profile: Any = None

        def take_in(self, record: Record) -> bool:
            """As the driver does; the profile begins and ends after it."""
            answer = super().take_in(record)
            if isinstance(record, Round) and record.member == MEMBER:
                if record.number == ROUND - 1:
                    self.profile = note_called_code(called)
                    self.profile.__enter__()
                elif record.number == ROUND:
                    self.profile.__exit__(None, None, None)
                    raise RoundEndedError
            return answer

    config = RunConfig.parse(compose([*OVERRIDES, f"run.root={root}", "run.id=round", "run.transport=inline"]))
    with (
        mock.patch.object(population, "TrainingDriver", ProfiledDriver),
        contextlib.suppress(RoundEndedError),
    ):
        population.run_population(config, reporter=NullReporter())
    return called


def group_by_file(called: set[CodeType], root: Path) -> dict[str, set[str]]:
    """File of the project -> names of its functions that were called, environments apart."""
    files: dict[str, set[str]] = collections.defaultdict(set)
    for code in called:
        path = Path(code.co_filename).resolve()
        if path.is_relative_to(root):
            name = path.relative_to(root).as_posix()
            if name.startswith(("popgen/", "actors/", "pipelines/")) and not name.startswith("popgen/envs/"):
                files[name].add(code.co_qualname)
    return dict(files)


def find_round_files(root: Path = ROOT) -> list[str]:
    """The files that the round goes through, a line each."""
    with tempfile.TemporaryDirectory(prefix="pg-") as folder:
        files = group_by_file(run_one_round(Path(folder)), root)
    return [f"{name} ({len(functions)} functions)" for name, functions in sorted(files.items())]


def main() -> int:
    """Print the files in two groups, or with --functions what is called in each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--functions", action="store_true", help="print the functions too")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="pg-") as folder:
        files = group_by_file(run_one_round(Path(folder)), ROOT)
    services = sorted(name for name in files if name.startswith(SERVICES))
    algorithm = sorted(files.keys() - set(services))
    print(f"{len(files)} files, at most {MOST}: {len(algorithm)} of the algorithm, {len(services)} of services")
    for title, names in (("algorithm", algorithm), ("services", services)):
        print(title)
        for name in names:
            print(f"  {name} ({len(files[name])} functions)")
            if arguments.functions:
                print(*(f"      {function}" for function in sorted(files[name])), sep="\n")
    return int(len(files) > MOST)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
