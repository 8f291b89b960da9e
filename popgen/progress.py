"""Progress of long work: the `Reporter` that pipelines speak to, and its three forms."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TextIO

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

Figure = float | int | str

SPEED_SECONDS = 600.0
"""The estimate of the time left takes the mean speed of so many seconds."""

BAR_WIDTH, NARROW_BAR, WIDE = 10, 5, 100
"""Columns of the bar, on terminals of at least `WIDE` columns and on others."""
FIXED_WIDTH = 4 + 7 + 7 + 7
"""Columns of a progress line beside its name, bar and figures: share, time passed, time left, gaps."""
WHOLE_WIDTH = len("all 9.5 min")


class Reporter(Protocol):
    """Phases one after the other, each with a known amount of work in any unit."""

    def phase(self, name: str, total: float) -> None:
        """Begin a phase (and end the one before); `total` 0 means that its length is unknown."""

    def expect(self, seconds: float | None) -> None:
        """The whole work, of which this phase is a part, takes so many seconds more; None: nobody knows."""

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

    def expect(self, seconds: float | None) -> None:
        """Ignore the estimate."""

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
        self._last, self._heard = -float("inf"), clock()
        self._expected: float | None = None
        self._closed = threading.Event()

    def break_silence(self) -> None:
        """From now on a phase that says nothing for `every` seconds gets a line too, from a thread of its own."""

        def watch() -> None:
            while not self._closed.wait(self.every / 4):
                self.tell_if_silent()

        threading.Thread(target=watch, name="progress", daemon=True).start()

    def tell_if_silent(self) -> None:
        """A line about the phase, if there was none for `every` seconds."""
        if self._phase.task.description and self.clock() - self._heard >= self.every:
            self._print_phase()

    def phase(self, name: str, total: float) -> None:
        """See `Reporter.phase`."""
        self._phase, self._last = PhaseClock(name, total, self.clock), -float("inf")

    def expect(self, seconds: float | None) -> None:
        """See `Reporter.expect`."""
        self._expected = None if seconds is None else self.clock() + seconds

    def update(self, done: float, **figures: Figure) -> None:
        """See `Reporter.update`."""
        self._phase.update(done, figures)
        now = self.clock()
        if now - self._last < self.every and not self._phase.task.finished:
            return
        self._last = now
        self._print_phase()

    def note(self, text: str) -> None:
        """See `Reporter.note`."""
        self._print_line(text)

    def close(self) -> None:
        """See `Reporter.close`."""
        self._closed.set()

    def _print_phase(self) -> None:
        left = None if self._expected is None else self._expected - self.clock()
        if left is None or left <= 0.0:  # what took longer than expected promises nothing
            return self._print_line("  ".join(self._phase.describe()))
        self._print_line("  ".join([*self._phase.describe(left), f"about {whole_text(left)} in all"]))

    def _print_line(self, text: str) -> None:
        self._heard = self.clock()
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

    def describe(self, whole: float | None = None) -> list[str]:
        """Name, share, figures, time passed and time left, as far as they are known.

        A phase to its full length may seem to take longer than the `whole` work, which knows that it can end early:
        then only that is told.
        """
        task = self.task
        parts = [task.description]
        if task.total:
            parts.append(f"{task.percentage:.0f}%")
        parts += [figure_text(name, value) for name, value in self.figures.items()]
        parts.append(f"{clock_text(task.elapsed or 0.0)} passed")
        if task.total and task.time_remaining is not None and is_believed(task.time_remaining, whole):
            parts.append(f"about {clock_text(task.time_remaining)} left")
        return parts


def is_believed(left: float, whole: float | None) -> bool:
    """Whether a phase's own time left can be shown beside that of the whole work."""
    return whole is None or left <= max(whole, 0.0)


class PhaseColumn(TimeRemainingColumn):
    """The phase's time left, where it is not longer than that of the whole work."""

    def render(self, task: Task) -> Text:
        """Of a task whose field `expected` is the time of the end of the whole."""
        expected, left = task.fields.get("expected"), task.time_remaining
        if expected is not None and left is not None and not is_believed(left, expected - task.get_time()):
            return Text("")
        return super().render(task)


class WholeColumn(ProgressColumn):
    """The time that the whole work still takes, which counts down between two estimates, and is not told once it has
    run out: work that takes longer than expected promises nothing."""

    def render(self, task: Task) -> Text:
        """Of a task whose field `expected` is the time of the end."""
        expected = task.fields.get("expected")
        left = None if expected is None else expected - task.get_time()
        return Text("" if left is None or left <= 0.0 else f"all {whole_text(left)}")


class RichReporter:
    """A live bar with phase, figures, time passed and time left, for terminals: rich's own columns.

    Where a line is too long for the terminal, the last figures are left out whole, never cut.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        console = Console(file=stream or sys.stderr)
        bar = BAR_WIDTH if console.width >= WIDE else NARROW_BAR
        columns = (
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=bar),
            TaskProgressColumn(),
            TextColumn("{task.fields[figures]}", markup=False),
            TimeElapsedColumn(),
            PhaseColumn(),
            WholeColumn(),
        )
        self._fixed = bar + FIXED_WIDTH
        self._progress = Progress(*columns, console=console, speed_estimate_period=SPEED_SECONDS)
        self._task: TaskID | None = None
        self._room = 0
        self._figures: dict[str, Figure] = {}
        self._expected: float | None = None
        self._progress.start()

    def phase(self, name: str, total: float) -> None:
        """See `Reporter.phase`."""
        if self._task is not None:
            self._progress.stop_task(self._task)
            self._progress.update(self._task, expected=None)  # the last line has it
        self._figures = {}
        self._room = self._progress.console.width - len(name) - self._fixed
        self._task = self._progress.add_task(escape(name), total=total or None, figures="", expected=self._expected)

    def expect(self, seconds: float | None) -> None:
        """See `Reporter.expect`."""
        self._expected = None if seconds is None else self._progress.get_time() + seconds
        if self._task is not None:
            self._progress.update(self._task, expected=self._expected)

    def update(self, done: float, **figures: Figure) -> None:
        """See `Reporter.update`."""
        if self._task is None:
            return
        self._figures.update(figures)
        texts = [figure_text(name, value) for name, value in self._figures.items()]
        room = self._room - (WHOLE_WIDTH if self._expected is not None else 0)
        self._progress.update(self._task, completed=done, figures=fit_texts(texts, room))

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
    if shown.isatty():
        return RichReporter(shown)
    lines = PlainReporter(shown)
    lines.break_silence()
    return lines


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


def whole_text(seconds: float) -> str:
    """A rough time, to a fifth or closer: 40 s, 2.5 min, 14 min, 2.5 h."""
    seconds = max(seconds, 0.0)
    if seconds <= 90:
        return f"{math.ceil(seconds / 10) * 10} s"
    if seconds < 585:
        return f"{round(seconds / 30) / 2:g} min"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def clock_text(seconds: float) -> str:
    """Seconds as 5s, 2:05 or 1:02:05."""
    whole = int(round(seconds))
    if whole < 60:
        return f"{whole}s"
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
