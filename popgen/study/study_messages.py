"""What a browser may send: bodies of requests, and messages of a game. Anything else is refused."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

LARGEST_BODY = 16_384
"""Bytes of a request that are read."""

LARGEST_MESSAGE = 8_192
"""Bytes of a game's message that are read."""

MOST_STEPS = 4
"""Steps of one message, where the browser plays them."""

LONGEST_STATE = 512
"""Bytes of a state."""

MOST_KEYS = 16
"""Key events of one message."""


class Body(BaseModel):
    """No unknown keys, no conversion between types."""

    model_config = ConfigDict(extra="forbid", strict=True)


class SessionBody(Body):
    """Begin. `recruit`: a recruiting platform's number for the participant; only a keyed digest of it is kept."""

    recruit: Annotated[str, Field(min_length=1, max_length=100)] | None = None


class ConsentBody(Body):
    """Take part or not, by the text of this version."""

    agreed: bool
    version: Annotated[str, Field(max_length=500)]


class AnswersBody(Body):
    """Answers to a form."""

    form: Annotated[str, Field(max_length=40)]
    answers: dict[Annotated[str, Field(max_length=40)], Annotated[str, Field(max_length=500)]]


class WithdrawBody(Body):
    """Stop; with `delete`, everything recorded is deleted."""

    delete: bool


class DeleteBody(Body):
    """Delete everything of the participant with this code."""

    code: Annotated[str, Field(pattern=r"^[0-9a-f]{20}$")]


class EmptyBody(Body):
    """Nothing to say."""


@dataclass(frozen=True)
class KeyEvent:
    """A key went down or up.

    Attributes:
        code: `KeyboardEvent.code`.
        down: or up.
        at: milliseconds of the browser's clock.
    """

    code: str
    down: bool
    at: float


@dataclass(frozen=True)
class UploadedStep:
    """A step that the browser has played.

    Attributes:
        step: its number.
        state: before it.
        actions: of both players.
        time_ms: since the game was opened.
        late_us: after the time when it was due.
        keys: since the step before.
    """

    step: int
    state: bytes
    actions: tuple[int, int]
    time_ms: int
    late_us: int
    keys: tuple[KeyEvent, ...]


@dataclass(frozen=True)
class GameMessage:
    """What a browser tells about a running game.

    Attributes:
        keys: events since the last message.
        go: start, or go on after a pause.
        hidden: the page is out of sight: pause.
        seen: the step whose picture has been shown, to measure the latency.
        ready: the step that may be played, where the server waits for it (simulated participants).
        steps: that the browser has played since the last message, where it plays them.
        latency: milliseconds until its last steps were known to be recorded, as the browser measured.
    """

    keys: tuple[KeyEvent, ...] = ()
    go: bool = False
    hidden: bool = False
    seen: int | None = None
    ready: int | None = None
    steps: tuple[UploadedStep, ...] = ()
    latency: float | None = None


def read_game_message(text: str) -> GameMessage | None:
    """A message, None for anything that is none."""
    if len(text) > LARGEST_MESSAGE:
        return None
    try:
        told = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(told, dict) or not told or not set(told) <= _KNOWN:
        return None
    keys = _read_keys(told.get("keys", []))
    flags = [told.get(name, False) for name in ("go", "hidden")]
    steps = [told.get(name) for name in ("seen", "ready")]
    played, latency = _read_steps(told.get("steps", [])), told.get("latency")
    if keys is None or not all(isinstance(flag, bool) for flag in flags) or not all(map(_is_step, steps)):
        return None
    if played is None or not (latency is None or _is_time(latency)):
        return None
    return GameMessage(keys, flags[0], flags[1], steps[0], steps[1], played, latency)


_KNOWN = {"keys", "go", "hidden", "seen", "ready", "steps", "latency"}


def _read_steps(told: Any) -> tuple[UploadedStep, ...] | None:
    """Lists of step, state in hexadecimal digits, both actions, time, lateness, keys."""
    if not isinstance(told, list) or len(told) > MOST_STEPS:
        return None
    steps = []
    for one in told:
        if not (isinstance(one, list) and len(one) == 7):
            return None
        (step, state, first, second, time_ms, late_us), keys = one[:6], _read_keys(one[6])
        numbers = (step, first, second, time_ms, late_us)
        if keys is None or any(number is None or not _is_step(number) for number in numbers):
            return None
        if not (isinstance(state, str) and len(state) <= 2 * LONGEST_STATE and re.fullmatch(r"([0-9a-f]{2})*", state)):
            return None
        steps.append(UploadedStep(step, bytes.fromhex(state), (first, second), time_ms, late_us, keys))
    return tuple(steps)


def _read_keys(told: Any) -> tuple[KeyEvent, ...] | None:
    if not isinstance(told, list) or len(told) > MOST_KEYS:
        return None
    events = []
    for one in told:
        if not (isinstance(one, list) and len(one) == 3):
            return None
        code, down, at = one
        if not (isinstance(code, str) and len(code) <= 20 and down in (0, 1) and not isinstance(down, bool)):
            return None
        if not _is_time(at):
            return None
        events.append(KeyEvent(code, down == 1, float(at)))
    return tuple(events)


def _is_time(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, int | float) and 0 <= value < 2**53


def _is_step(value: Any) -> bool:
    return value is None or (isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**31)
