from __future__ import annotations

import io

import pytest
from rich.progress import Progress

from popgen.progress import (
    Figure,
    NullReporter,
    PhaseColumn,
    PlainReporter,
    RichReporter,
    clock_text,
    fit_texts,
    is_believed,
    make_reporter,
    whole_text,
)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def run_phase(name: str, total: float, updates: list[tuple[float, float, dict[str, Figure]]]) -> list[str]:
    """Lines of a plain reporter for updates (time since the phase began, done, figures)."""
    clock, stream = Clock(), io.StringIO()
    reporter = PlainReporter(stream, every=5.0, clock=clock)
    clock.now = 10.0
    reporter.phase(name, total)
    for seconds, done, figures in updates:
        clock.now = 10.0 + seconds
        reporter.update(done, **figures)
    reporter.note("done")
    reporter.close()
    return stream.getvalue().splitlines()


def test_plain_lines_come_every_few_seconds_and_at_the_end() -> None:
    updates: list[tuple[float, float, dict[str, Figure]]] = [
        (1, 10, {"steps": 1000, "dishes": 0.5}),
        (2, 20, {"steps": 2000}),
        (6.5, 65, {"steps": 6500}),
        (7, 100, {"steps": 10_000}),
    ]
    assert run_phase("member 1", 100, updates) == [
        "member 1  10%  steps 1,000  dishes 0.50  1s passed",
        # 55 in 5.5 seconds since the first update: 35 take 3.5, which rich rounds up.
        "member 1  65%  steps 6,500  dishes 0.50  6s passed  about 4s left",
        "member 1  100%  steps 10,000  dishes 0.50  7s passed  about 0s left",
        "done",
    ]


def test_what_was_there_before_a_phase_does_not_make_it_fast() -> None:
    """It begins at 44 % and does 1 % in 2 seconds: after 10 seconds 51 % are left, which take 102."""
    lines = run_phase("member 2", 100, [(0, 44, {}), (10, 49, {}), (20, 54, {})])
    assert lines[:3] == [
        "member 2  44%  0s passed",
        "member 2  49%  10s passed  about 1:42 left",
        "member 2  54%  20s passed  about 1:32 left",
    ]


def test_a_phase_of_unknown_length_promises_nothing() -> None:
    assert run_phase("waiting", 0, [(8, 3, {"steps": 3})])[0] == "waiting  steps 3  8s passed"


def test_figures_that_do_not_fit_are_left_out_whole() -> None:
    texts = ["steps 1,000", "dishes in training 0.50", "XP 0.10"]
    assert fit_texts(texts, 80) == "steps 1,000  dishes in training 0.50  XP 0.10"
    assert fit_texts(texts, 36) == "steps 1,000  dishes in training 0.50"
    assert fit_texts(texts, 35) == "steps 1,000"
    assert fit_texts(texts, 3) == ""


def test_a_terminal_of_80_columns_shows_numbers_and_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    terminal = Terminal()
    reporter = RichReporter(terminal)
    reporter.phase("member 2 of 8", 100)
    reporter.update(44, steps=123_456, **{"dishes in training": 2.5})
    reporter.close()
    last = [line for line in terminal.getvalue().splitlines() if "44%" in line][-1]
    assert "steps 123,456" in last and "dishes" not in last.replace("dishes in training 2.50", "")
    assert "0:00:00" in last and "-:--:--" in last and "44%" in last


def test_80_columns_have_room_for_steps_and_the_whole_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    terminal = Terminal()
    reporter = RichReporter(terminal)
    reporter.phase("member 2 of 8: imagination", 100)
    reporter.expect(540.0)
    reporter.update(44, steps=123_456, entropy=1.2)
    reporter.phase("member 3 of 8: imagination", 100)
    reporter.close()
    ended, running = [line for line in terminal.getvalue().splitlines() if "imagination" in line][-2:]
    assert "steps 123,456" in ended and "44%" in ended and "-:--:--" in running and "…" not in ended + running
    assert "all 9 min" in running and "all" not in ended, "the last line tells of the whole"


def test_plain_lines_tell_of_the_whole_run_as_far_as_it_is_known() -> None:
    clock, stream = Clock(), io.StringIO()
    reporter = PlainReporter(stream, clock=clock)
    reporter.phase("member 1 of 2: self-play", 10)
    reporter.update(1, steps=5)
    reporter.expect(400.0)
    clock.now = 40.0
    reporter.update(2)
    assert stream.getvalue().splitlines() == [
        "member 1 of 2: self-play  10%  steps 5  0s passed",
        "member 1 of 2: self-play  20%  steps 5  40s passed  about 5:20 left  about 6 min in all",
    ]


def test_an_estimate_that_has_run_out_is_not_told() -> None:
    stream, clock = io.StringIO(), Clock()
    reporter = PlainReporter(stream, every=5.0, clock=clock)
    reporter.phase("work", 0)
    reporter.expect(60.0)
    for now in (10.0, 55.0, 61.0):
        clock.now = now
        reporter.update(1.0)
    told = ["about" in line for line in stream.getvalue().splitlines()]
    assert told == [True, True, False], stream.getvalue()


def test_a_phase_never_takes_longer_than_the_whole() -> None:
    """10 % in 40 s leaves the phase 5:20 to its full length; the whole work, which may end it early, 2 min."""
    clock, stream = Clock(), io.StringIO()
    reporter = PlainReporter(stream, clock=clock)
    reporter.phase("imagination", 10)
    reporter.update(1)
    clock.now = 40.0
    reporter.expect(120.0)
    reporter.update(2)
    assert stream.getvalue().splitlines()[-1] == "imagination  20%  40s passed  about 2 min in all"
    assert [is_believed(left, 120.0) for left in (119.0, 121.0)] == [True, False] and is_believed(1e9, None)
    progress = Progress(disable=True, get_time=clock, speed_estimate_period=600)
    task = progress.add_task("imagination", total=10, expected=None)
    for clock.now, done in ((0.0, 1), (40.0, 2)):
        progress.update(task, completed=done)
    for expected, shown in ((None, "0:05:20"), (400.0, "0:05:20"), (160.0, "")):
        progress.update(task, expected=expected)
        assert PhaseColumn().render(progress.tasks[0]).plain == shown


def test_a_silent_phase_gets_a_line_every_few_seconds() -> None:
    clock, stream = Clock(), io.StringIO()
    reporter = PlainReporter(stream, every=5.0, clock=clock)
    reporter.tell_if_silent()
    reporter.phase("starting Ray", 0)
    for now in (4.0, 5.0, 9.0, 10.0):
        clock.now = now
        reporter.tell_if_silent()
    assert stream.getvalue().splitlines() == ["starting Ray  5s passed", "starting Ray  10s passed"]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(-3, "0 s"), (31, "40 s"), (90, "90 s"), (100, "1.5 min"), (540, "9 min"), (590, "10 min"), (9000, "2.5 h")],
)
def test_whole_text(seconds: float, text: str) -> None:
    assert whole_text(seconds) == text


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0s"), (59.4, "59s"), (125, "2:05"), (3725, "1:02:05")])
def test_clock_text(seconds: float, text: str) -> None:
    assert clock_text(seconds) == text


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
    reporter.expect(3.0)
    reporter.update(1, a=1)
    reporter.note("y")
    reporter.close()
    assert capsys.readouterr() == ("", "")
