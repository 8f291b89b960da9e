"""Progress of long work: the `Reporter` that pipelines speak to, and its three forms."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TextIO

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    Task,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

Figure = float | int | str

SPEED_SECONDS = 600.0
"""The estimate of the time left takes the mean speed of so many seconds."""

BAR_WIDTH = 10
FIXED_WIDTH = BAR_WIDTH + 4 + 7 + 7 + 5
"""Columns of a progress line beside its name and figures: bar, share, time passed, time left, gaps."""


class Reporter(Protocol):
    """Phases one after the other, each with a known amount of work in any unit."""

    def phase(self, name: str, total: float) -> None:
        """Begin a phase (and end the one before); `total` 0 means that its length is unknown."""

    def update(self, done: float, **figures: Figure) -> None:
        """`done` of the phase's total; `figures` (steps, dishes, ...) stay until they are given again."""

    def note(self, text: str) -> None:
        """One line that stays on the screen."""

    def close(self) -> None:
        """Nothing more will come."""


class NullReporter:
    """Says nothing."""

    def phase(self, name: str, total: float) -> None:
        """Ignore the phase."""

    def update(self, done: float, **figures: Figure) -> None:
        """Ignore the update."""

    def note(self, text: str) -> None:
        """Ignore the note."""

    def close(self) -> None:
        """There is nothing to put away."""


class PlainReporter:
    """A line every few seconds, for logs and pipes.

    Args:
        stream: where the lines go.
        every: seconds between two lines of a phase; its first update always gets one.
        clock: seconds, monotonic.
    """

    def __init__(
        self, stream: TextIO | None = None, every: float = 5.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.stream, self.every, self.clock = stream or sys.stderr, every, clock
        self._phase = PhaseClock("", 0, clock)
        self._last = -float("inf")

    def phase(self, name: str, total: float) -> None:
        """See `Reporter.phase`."""
        self._phase, self._last = PhaseClock(name, total, self.clock), -float("inf")

    def update(self, done: float, **figures: Figure) -> None:
        """See `Reporter.update`."""
        self._phase.update(done, figures)
        now = self.clock()
        if now - self._last < self.every and not self._phase.task.finished:
            return
        self._last = now
        self._print_line("  ".join(self._phase.describe()))

    def note(self, text: str) -> None:
        """See `Reporter.note`."""
        self._print_line(text)

    def close(self) -> None:
        """Nothing to put away."""

    def _print_line(self, text: str) -> None:
        print(text, file=self.stream, flush=True)


class PhaseClock:
    """One phase: what is done, its figures, and rich's estimate of the time left, without a display.

    The estimate takes the speed between the first update and the last. So a phase that begins at 44 %, as it does
    after a resume, does not count what was there before it.
    """

    def __init__(self, name: str, total: float, clock: Callable[[], float]) -> None:
        progress = Progress(disable=True, get_time=clock, speed_estimate_period=SPEED_SECONDS)
        self._progress, self._id = progress, progress.add_task(name, total=total or None)
        self.figures: dict[str, Figure] = {}

    @property
    def task(self) -> Task:
        """Rich's record of the phase."""
        return self._progress.tasks[0]

    def update(self, done: float, figures: Mapping[str, Figure]) -> None:
        """`done` of the total; `figures` stay until they are given again."""
        self.figures.update(figures)
        self._progress.update(self._id, completed=done)

    def describe(self) -> list[str]:
        """Name, share, figures, time passed and time left, as far as they are known."""
        task = self.task
        parts = [task.description]
        if task.total:
            parts.append(f"{task.percentage:.0f}%")
        parts += [figure_text(name, value) for name, value in self.figures.items()]
        parts.append(f"{clock_text(task.elapsed or 0.0)} passed")
        if task.total and task.time_remaining is not None:
            parts.append(f"about {clock_text(task.time_remaining)} left")
        return parts


class RichReporter:
    """A live bar with phase, figures, time passed and time left, for terminals: rich's own columns.

    Where a line is too long for the terminal, the last figures are left out whole, never cut.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        columns = (
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=BAR_WIDTH),
            TaskProgressColumn(),
            TextColumn("{task.fields[figures]}", markup=False),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        console = Console(file=stream or sys.stderr)
        self._progress = Progress(*columns, console=console, speed_estimate_period=SPEED_SECONDS)
        self._task: TaskID | None = None
        self._room = 0
        self._figures: dict[str, Figure] = {}
        self._progress.start()

    def phase(self, name: str, total: float) -> None:
        """See `Reporter.phase`."""
        if self._task is not None:
            self._progress.stop_task(self._task)
        self._figures = {}
        self._room = self._progress.console.width - len(name) - FIXED_WIDTH
        self._task = self._progress.add_task(escape(name), total=total or None, figures="")

    def update(self, done: float, **figures: Figure) -> None:
        """See `Reporter.update`."""
        if self._task is None:
            return
        self._figures.update(figures)
        texts = [figure_text(name, value) for name, value in self._figures.items()]
        self._progress.update(self._task, completed=done, figures=fit_texts(texts, self._room))

    def note(self, text: str) -> None:
        """See `Reporter.note`."""
        self._progress.console.print(text, markup=False, highlight=False, emoji=False)

    def close(self) -> None:
        """See `Reporter.close`."""
        self._progress.stop()


def make_reporter(quiet: bool = False, stream: TextIO | None = None) -> Reporter:
    """The reporter that suits `stream` (stderr by default): a bar on a terminal, lines elsewhere."""
    shown = stream or sys.stderr
    if quiet:
        return NullReporter()
    return RichReporter(shown) if shown.isatty() else PlainReporter(shown)


def figure_text(name: str, value: Figure) -> str:
    """A figure of the progress line: its name, then its number."""
    if isinstance(value, float):
        text = f"{value:.2f}" if abs(value) < 1000 else f"{value:,.0f}"
    else:
        text = f"{value:,}" if isinstance(value, int) else value
    return f"{name} {text}"


def fit_texts(texts: Sequence[str], width: int) -> str:
    """The first of the texts that fit into `width` side by side, whole."""
    line = ""
    for text in texts:
        longer = f"{line}  {text}" if line else text
        if len(longer) > width:
            break
        line = longer
    return line


def clock_text(seconds: float) -> str:
    """Seconds as 5s, 2:05 or 1:02:05."""
    whole = int(round(seconds))
    if whole < 60:
        return f"{whole}s"
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
