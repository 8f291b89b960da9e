from __future__ import annotations

import io
from collections.abc import Iterator

import pytest

from popgen.progress import NullReporter, PlainReporter, RichReporter, clock_text, make_reporter, time_left


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def reporter_at(times: list[float]) -> tuple[PlainReporter, io.StringIO]:
    clock: Iterator[float] = iter(times)
    stream = io.StringIO()
    return PlainReporter(stream, every=5.0, clock=lambda: next(clock)), stream


def test_plain_lines_come_every_few_seconds_and_at_the_end() -> None:
    # made, phase began, then one time per update
    reporter, stream = reporter_at([0.0, 10.0, 11.0, 12.0, 16.5, 17.0])
    reporter.phase("member 1", 100)
    reporter.update(10, steps=1000, dishes=0.5)
    reporter.update(20, steps=2000)
    reporter.update(65, steps=6500)
    reporter.update(100, steps=10_000)
    reporter.note("done")
    reporter.close()
    assert stream.getvalue().splitlines() == [
        "member 1  10%  steps 1,000  dishes 0.50  1s passed  about 9s left",
        "member 1  65%  steps 6,500  dishes 0.50  6s passed  about 4s left",
        "member 1  100%  steps 10,000  dishes 0.50  7s passed  about 0s left",
        "done",
    ]


def test_a_phase_of_unknown_length_promises_nothing() -> None:
    reporter, stream = reporter_at([0.0, 0.0, 8.0])
    reporter.phase("waiting", 0)
    reporter.update(3, steps=3)
    assert stream.getvalue() == "waiting  steps 3  8s passed\n"


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0s"), (59.4, "59s"), (125, "2:05"), (3725, "1:02:05")])
def test_clock_text(seconds: float, text: str) -> None:
    assert clock_text(seconds) == text


def test_time_left() -> None:
    assert time_left(25, 100, 10) == 30 and time_left(200, 100, 10) == 0
    assert time_left(0, 100, 10) is None and time_left(1, 0, 10) is None


def test_the_stream_decides_the_form() -> None:
    assert isinstance(make_reporter(stream=io.StringIO()), PlainReporter)
    assert isinstance(make_reporter(quiet=True), NullReporter)
    terminal = Terminal()
    reporter = make_reporter(stream=terminal)
    assert isinstance(reporter, RichReporter)
    reporter.update(1)  # before any phase: nothing to show
    reporter.phase("member [1]", 10)
    reporter.update(5, steps=1234)
    reporter.note("a [bold] note")
    reporter.phase("member 2", 0)
    reporter.update(1, dishes=2.0)
    reporter.close()
    shown = terminal.getvalue()
    assert "steps 1,234" in shown and "a [bold] note" in shown and "dishes 2.00" in shown and "member [1]" in shown


def test_null_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    reporter = NullReporter()
    reporter.phase("x", 1)
    reporter.update(1, a=1)
    reporter.note("y")
    reporter.close()
    assert capsys.readouterr() == ("", "")
