"""How long work tells what it is doing: the `Reporter` that pipelines speak to, and its three forms."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, Protocol, TextIO

Figure = float | int | str


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
        """Nothing."""

    def update(self, done: float, **figures: Figure) -> None:
        """Nothing."""

    def note(self, text: str) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""


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
        self._name, self._total, self._began, self._last = "", 0.0, clock(), -float("inf")
        self._figures: dict[str, Figure] = {}

    def phase(self, name: str, total: float) -> None:
        self._name, self._total, self._began, self._last = name, total, self.clock(), -float("inf")
        self._figures = {}

    def update(self, done: float, **figures: Figure) -> None:
        self._figures.update(figures)
        now = self.clock()
        if now - self._last < self.every and not 0 < self._total <= done:
            return
        self._last = now
        parts = [self._name]
        if self._total:
            parts.append(f"{100 * min(1.0, done / self._total):.0f}%")
        parts += [f"{name} {_show(value)}" for name, value in self._figures.items()]
        parts.append(f"{clock_text(now - self._began)} passed")
        left = time_left(done, self._total, now - self._began)
        if left is not None:
            parts.append(f"about {clock_text(left)} left")
        self._line("  ".join(parts))

    def note(self, text: str) -> None:
        self._line(text)

    def close(self) -> None:
        """Nothing to put away."""

    def _line(self, text: str) -> None:
        print(text, file=self.stream, flush=True)


class RichReporter:
    """A live bar with phase, figures and time left, for terminals."""

    def __init__(self, stream: TextIO | None = None) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

        columns = (
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=24),
            TaskProgressColumn(),
            TextColumn("{task.fields[figures]}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
        )
        self._progress = Progress(*columns, console=Console(file=stream or sys.stderr))
        self._task: Any = None
        self._began = time.monotonic()
        self._figures: dict[str, Figure] = {}
        self._progress.start()

    def phase(self, name: str, total: float) -> None:
        if self._task is not None:
            self._progress.update(self._task, left="")
            self._progress.stop_task(self._task)
        self._began, self._figures = time.monotonic(), {}
        self._task = self._progress.add_task(name, total=total or None, figures="", left="")

    def update(self, done: float, **figures: Figure) -> None:
        if self._task is None:
            return
        self._figures.update(figures)
        shown = "  ".join(f"{name} {_show(value)}" for name, value in self._figures.items())
        left = time_left(done, self._progress.tasks[self._task].total or 0, time.monotonic() - self._began)
        text = "" if left is None else f"about {clock_text(left)} left"
        self._progress.update(self._task, completed=done, figures=shown, left=text)

    def note(self, text: str) -> None:
        self._progress.console.print(text, markup=False, highlight=False)

    def close(self) -> None:
        self._progress.stop()


def make_reporter(quiet: bool = False, stream: TextIO | None = None) -> Reporter:
    """The reporter that suits `stream` (stderr by default): a bar on a terminal, lines elsewhere."""
    stream = stream or sys.stderr
    if quiet:
        return NullReporter()
    return RichReporter(stream) if stream.isatty() else PlainReporter(stream)


def time_left(done: float, total: float, passed: float) -> float | None:
    """Seconds left at the mean speed so far; None while nothing can be said."""
    if done <= 0 or total <= 0 or passed <= 0:
        return None
    return max(0.0, passed * (total - done) / done)


def clock_text(seconds: float) -> str:
    """Seconds as 5s, 2:05 or 1:02:05."""
    whole = int(round(seconds))
    if whole < 60:
        return f"{whole}s"
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _show(value: Figure) -> str:
    if isinstance(value, float):
        return f"{value:.2f}" if abs(value) < 1000 else f"{value:,.0f}"
    return f"{value:,}" if isinstance(value, int) else value
