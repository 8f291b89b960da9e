"""Where games run: behind `GameHost`, in the server or in the browser (`browser_host`).

`ServerGameHost` steps every game at fixed times of a monotonic clock (150 ms apart, no drift) in one thread beside the
event loop, the earliest one first; a second thread writes what was played, half a second's steps at a time, so that a
killed server loses less than a second.
"""

from __future__ import annotations

import heapq
import json
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from popgen.pages.live_game import KEYS, Keyboard
from popgen.study.game_records import FINISHED, VOID, GameEnd, GameRecords, GameTicket, Tick
from popgen.study.hosted_game import HostedGame, PartnerShelf
from popgen.study.record_writer import RecordWriter
from popgen.study.study_messages import GameMessage

LATE_LIMIT = 1.0
"""Periods by which a step may be late before all later ones move, so that none is hurried."""

_log = logging.getLogger("popgen.study")
Tell = Callable[[dict[str, Any]], None]


@dataclass(frozen=True)
class Pace:
    """Times of games.

    Attributes:
        period: seconds of a step; 0: a step is played when the browser says that it is ready.
        warn_steps, end_steps: without a key, until the warning and until the game is void.
    """

    period: float
    warn_steps: int
    end_steps: int


class GameHost(Protocol):
    """Runs the games of a study."""

    def open(self, ticket: GameTicket, place: int, tell: Tell, *, pictures: bool) -> None:
        """Have a game ready; it starts at the browser's `go`. `tell` gets what the browser is to know."""

    def receive(self, game: int, message: GameMessage) -> None:
        """A message of the game's browser."""

    def close(self, game: int) -> None:
        """The browser is gone; returns when everything that was played is recorded."""

    def stop(self) -> None:
        """No more games; returns when everything that was played is recorded."""


@dataclass(frozen=True)
class _PlannedStep:
    """The person's part of a step: action, seconds after it was due, key events, milliseconds there and back."""

    action: int
    late: float
    keys: list[list[Any]]
    latency: float | None


class _RunningGame:
    """One open game: what the host knows beside the game itself."""

    def __init__(self, ticket: GameTicket, place: int, tell: Tell, shelf: PartnerShelf, pictures: bool) -> None:
        self.ticket, self.place, self.tell, self.shelf = ticket, place, tell, shelf
        self.partner = shelf.take()
        self.game = HostedGame(shelf.env, self.partner, ticket.seat, ticket.seed)
        names = shelf.env.spec.action_names
        self.keyboard = Keyboard(names.index("stay"))
        self.codes = {KEYS[name]: number for number, name in enumerate(names) if name in KEYS}
        self.running = self.over = False
        self.due = 0.0
        self.idle = 0
        self.keys: list[list[Any]] = []
        self.latency: float | None = None
        self.sent: dict[int, float] = {}
        self.busy = threading.Lock()
        self._pictures = pictures
        self._shown: np.ndarray | None = None
        self._known: set[int] = set()

    def take_keys(self, message: GameMessage) -> None:
        for event in message.keys:
            action = self.codes.get(event.code)
            if action is None:
                continue
            (self.keyboard.press if event.down else self.keyboard.release)(action)
            if len(self.keys) < 64:
                self.keys.append([event.code, int(event.down), round(event.at, 1)])
            self.idle = 0

    def take_step(self, late: float) -> _PlannedStep:
        """What the next step needs; keys that come later belong to the one after it."""
        planned = _PlannedStep(self.keyboard.take_action(), late, self.keys, self.latency)
        self.keys, self.latency = [], None
        self.idle += 1
        return planned

    def describe(self) -> dict[str, Any]:
        """The present picture, as changes since the last one, or the state for who looks at no pictures."""
        told: dict[str, Any] = {"step": self.game.step, "score": round(self.game.score, 4)}
        if not self._pictures:
            return told | {"state": self.game.state.tolist()}
        numbers = self.shelf.pictures.draw(self.game.state)
        changed = np.arange(len(numbers)) if self._shown is None else np.flatnonzero(numbers != self._shown)
        fresh = sorted({int(numbers[cell]) for cell in changed} - self._known)
        self._shown = numbers
        self._known |= set(fresh)
        told["cells"] = [int(value) for cell in changed for value in (cell, numbers[cell])]
        return told | {"tiles": [[number, self.shelf.pictures.url(number)] for number in fresh]}

    def begin(self) -> dict[str, Any]:
        """What the browser must know before the first step."""
        rows, columns = self.shelf.pictures.size
        facts = {"seat": self.ticket.seat, "steps": self.ticket.steps, "number": self.ticket.number}
        return {"begin": {**facts, "rows": rows, "columns": columns, "layout": self.ticket.layout}, **self.describe()}


class ServerGameHost:
    """Games in the server; see the module's docstring.

    Args:
        records: where games are written.
        shelves: (layout, ego) -> its partners; ego None for the tutorial.
        pace: times of games.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        records: GameRecords,
        shelves: dict[tuple[str, str | None], PartnerShelf],
        pace: Pace,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.pace, self.clock = pace, clock
        self._shelves = shelves
        self._writer = RecordWriter(records)
        self._games: dict[int, _RunningGame] = {}
        self._due: list[tuple[float, int]] = []
        self._wake = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run_games, name="popgen-games", daemon=True)
        self._thread.start()

    def open(self, ticket: GameTicket, place: int, tell: Tell, *, pictures: bool) -> None:
        """See `GameHost`; raises ValueError where a recording is not what the simulator and the ego give."""
        one = _RunningGame(ticket, place, tell, self._shelves[ticket.layout, ticket.ego], pictures)
        wrong = one.game.repeat(ticket.actions)
        if wrong is not None:
            raise ValueError(f"game {ticket.id} cannot be gone on with: step {wrong} is not the ego's")
        begun = one.begin()
        with self._wake:
            self._games[ticket.id] = one
        tell(begun)
        if one.game.step >= ticket.steps:  # killed between the last step and the end
            self._finish_game(one, FINISHED)

    def receive(self, game: int, message: GameMessage) -> None:
        """See `GameHost`."""
        with self._wake:
            one = self._games.get(game)
            if one is None or one.over:
                return
            one.take_keys(message)
            sent = one.sent.pop(message.seen, None) if message.seen is not None else None
            if sent is not None:
                one.latency = (self.clock() - sent) * 1000
            if message.hidden and one.running:
                one.running = False
                one.tell({"paused": "hidden"})
            if message.go and not one.running:
                one.running, one.idle = True, 0
                one.due = self.clock() + self.pace.period
                if self.pace.period > 0:
                    self._schedule_game(one)
            if self.pace.period == 0 and one.running and message.ready == one.game.step:
                one.due = self.clock()
                self._schedule_game(one)

    def close(self, game: int) -> None:
        """See `GameHost`."""
        with self._wake:
            one = self._games.pop(game, None)
        if one is None:
            return
        with one.busy:  # a step that is being played is played to its end
            one.running, one.over = False, True
        self._writer.flush()
        one.shelf.give_back(one.partner)

    def stop(self) -> None:
        """End both threads; everything that was played is recorded."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join()
        self._writer.stop()

    def _schedule_game(self, one: _RunningGame) -> None:
        """Call with `_wake` held."""
        heapq.heappush(self._due, (one.due, one.ticket.id))
        self._wake.notify()

    def _run_games(self) -> None:
        """The thread of all games."""
        while True:
            with self._wake:
                while not self._stopping and (not self._due or self._due[0][0] > self.clock()):
                    self._wake.wait(max(0.0, self._due[0][0] - self.clock()) if self._due else None)
                if self._stopping:
                    return
                due, game = heapq.heappop(self._due)
                one = self._games.get(game)
                if one is None or not one.running or one.over or one.due != due:
                    continue
                planned = one.take_step(self.clock() - due)
            with one.busy:
                if not one.over:
                    self._step_game(one, planned)

    def _step_game(self, one: _RunningGame, planned: _PlannedStep) -> None:
        try:
            played = one.game.advance(planned.action)
        except Exception:  # one game's failure must not end the others'
            _log.exception("game %d failed at step %d", one.ticket.id, one.game.step)
            one.running = False
            self._writer.tell(lambda: one.tell({"over": "failed"}))  # a reload goes on after what is recorded
            return
        tick = Tick(
            game=one.ticket.id,
            step=one.game.step - 1,
            state=played.state.tobytes(),
            action_0=played.actions[0],
            action_1=played.actions[1],
            score=played.score,
            keys=json.dumps(planned.keys, separators=(",", ":")),
            time_ms=int(time.time() * 1000) - one.ticket.began_ms,
            late_us=max(0, int(planned.late * 1e6)),
            latency_ms=planned.latency,
        )
        self._writer.put(tick)
        one.sent = {one.game.step: self.clock()} if one.game.step % 4 == 0 else one.sent
        one.tell(one.describe())
        if one.game.step >= one.ticket.steps:
            self._finish_game(one, FINISHED)
        elif one.idle >= self.pace.end_steps:
            self._finish_game(one, VOID)
        else:
            self._plan_next(one)

    def _plan_next(self, one: _RunningGame) -> None:
        if one.idle == self.pace.warn_steps:
            one.tell({"warning": round((self.pace.end_steps - self.pace.warn_steps) * self.pace.period, 1)})
        if self.pace.period == 0:
            return
        with self._wake:
            one.due += self.pace.period
            now = self.clock()
            if now - one.due > LATE_LIMIT * self.pace.period:
                one.due = now
            self._schedule_game(one)

    def _finish_game(self, one: _RunningGame, status: str) -> None:
        """The browser hears of the end once it is recorded."""
        one.running, one.over = False, True
        end = GameEnd(one.ticket.id, one.ticket.participant, one.place, status, one.game.score)
        told = {"over": status, "score": round(one.game.score, 4)}
        self._writer.put(end, lambda: one.tell(told))
