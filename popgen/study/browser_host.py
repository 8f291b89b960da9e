"""Games that run in the browser: it plays the rules and the ego, and sends what was played.

The server plays every step again as it comes: the state, and the ego's action by its program and its generator, must be
those that were sent. What is not is refused, so that only proven steps are recorded. Playing a step again takes some
hundredths of a millisecond and nobody waits for it, so that it needs no thread beside the event loop.
"""

from __future__ import annotations

import json
import logging
import threading
from typing import Any

from popgen.pages.live_game import KEYS
from popgen.policies.program_runner import describe_generator
from popgen.study.game_host import Pace, Tell
from popgen.study.game_records import FINISHED, VOID, GameEnd, GameRecords, GameTicket, Tick
from popgen.study.hosted_game import HostedGame, PartnerShelf
from popgen.study.record_writer import RecordWriter
from popgen.study.study_messages import GameMessage, UploadedStep

FLUSH_SECONDS = 0.15
"""Steps wait so long at most until they are written: the browser stops where a second's steps are not."""

_log = logging.getLogger("popgen.study")


class _OpenGame:
    """One game of a browser."""

    def __init__(self, ticket: GameTicket, place: int, tell: Tell, shelf: PartnerShelf) -> None:
        self.ticket, self.place, self.tell, self.shelf = ticket, place, tell, shelf
        self.partner = shelf.take()
        self.game = HostedGame(shelf.env, self.partner, ticket.seat, ticket.seed)
        self.over = False
        self.idle = 0
        self.lock = threading.Lock()
        self._codes = {KEYS[name] for name in shelf.env.spec.action_names if name in KEYS}

    def replay_step(self, told: UploadedStep, latency: float | None) -> Tick | None:
        """The step as a record; None where the rules or the ego give another one."""
        game, seat = self.game, self.ticket.seat
        own = told.actions[seat]
        if told.step != game.step or told.state != game.state.tobytes() or own >= game.env.spec.num_actions:
            return None
        played = game.advance(own)
        if played.actions != told.actions:
            return None
        keys = [key for key in told.keys if key.code in self._codes]
        self.idle = 1 if keys else self.idle + 1
        return Tick(
            game=self.ticket.id,
            step=told.step,
            state=told.state,
            action_0=told.actions[0],
            action_1=told.actions[1],
            score=played.score,
            keys=json.dumps([[key.code, int(key.down), round(key.at, 1)] for key in keys], separators=(",", ":")),
            time_ms=told.time_ms,
            late_us=told.late_us,
            latency_ms=latency,
        )

    def begin(self, pace: Pace, elapsed_ms: int) -> dict[str, Any]:
        """What the browser must know to play."""
        ticket = self.ticket
        rows, columns = self.shelf.pictures.size
        facts = {"seat": ticket.seat, "steps": ticket.steps, "number": ticket.number, "layout": ticket.layout}
        times = {"step_ms": pace.period * 1000, "warn_steps": pace.warn_steps, "end_steps": pace.end_steps}
        ego = {"seed": ticket.seed, "generator": describe_generator(ticket.seed), "actions": ticket.actions.tolist()}
        begun = {**facts, **times, **ego, "rows": rows, "columns": columns, "elapsed_ms": elapsed_ms, "host": "browser"}
        return {"begin": begun, "step": self.game.step, "score": round(self.game.score, 4)}


class BrowserGameHost:
    """See the module's docstring, and `GameHost`.

    Args:
        records: where games are written.
        shelves: (layout, ego) -> its partners, which have programs; ego None for the tutorial.
        pace: times of games, which the browsers keep.
    """

    def __init__(self, records: GameRecords, shelves: dict[tuple[str, str | None], PartnerShelf], pace: Pace) -> None:
        self.pace = pace
        self._records, self._shelves = records, shelves
        self._writer = RecordWriter(records, FLUSH_SECONDS)
        self._games: dict[int, _OpenGame] = {}

    def open(self, ticket: GameTicket, place: int, tell: Tell, *, pictures: bool) -> None:
        """See `GameHost`; raises ValueError where a recording is not what the simulator and the ego give."""
        one = _OpenGame(ticket, place, tell, self._shelves[ticket.layout, ticket.ego])
        wrong = one.game.repeat(ticket.actions)
        if wrong is not None:
            raise ValueError(f"game {ticket.id} cannot be gone on with: step {wrong} is not the ego's")
        self._games[ticket.id] = one
        tell(one.begin(self.pace, self._records.people.now() - ticket.began_ms))
        if one.game.step >= ticket.steps:  # killed between the last step and the end
            self._finish_game(one, FINISHED)

    def receive(self, game: int, message: GameMessage) -> None:
        """See `GameHost`; steps that are recorded already are passed over."""
        one = self._games.get(game)
        if one is None:
            return
        with one.lock:
            if message.go:
                one.idle = 0
            latency = message.latency
            for told in message.steps:
                if not one.over and told.step >= one.game.step:
                    self._take_step(one, told, latency)
                    latency = None
            if message.steps and not one.over:
                kept = {"kept": one.game.step}
                self._writer.tell(lambda: one.tell(kept))

    def _take_step(self, one: _OpenGame, told: UploadedStep, latency: float | None) -> None:
        """Record a step, and end the game with the last one or a wrong one, once those before are recorded."""
        tick = one.replay_step(told, latency)
        if tick is None:
            _log.error("game %d: step %d is not what the rules and the ego give", one.ticket.id, told.step)
            one.over = True
            self._writer.tell(lambda: one.tell({"over": "failed"}))
            return
        self._writer.put(tick)
        if one.game.step >= one.ticket.steps:
            self._finish_game(one, FINISHED)
        elif one.idle >= self.pace.end_steps:
            self._finish_game(one, VOID)

    def _finish_game(self, one: _OpenGame, status: str) -> None:
        """The browser hears of the end once it is recorded."""
        one.over = True
        end = GameEnd(one.ticket.id, one.ticket.participant, one.place, status, one.game.score)
        told = {"over": status, "score": round(one.game.score, 4)}
        self._writer.put(end, lambda: one.tell(told))

    def close(self, game: int) -> None:
        """See `GameHost`."""
        one = self._games.pop(game, None)
        if one is None:
            return
        with one.lock:
            one.over = True
        self._writer.flush()
        one.shelf.give_back(one.partner)

    def stop(self) -> None:
        """See `GameHost`."""
        self._writer.stop()
