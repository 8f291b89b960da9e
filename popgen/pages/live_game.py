"""A person plays with a member: one game, step by step, without a clock and without a connection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from popgen.pages.game_recording import RecordedGame, choose_player
from popgen.pages.tile_atlas import TileAtlas
from popgen.population.store import Population

PERSON = "you"
"""Label of the person in a recording."""

KEYS = {
    **{"north": "ArrowUp", "south": "ArrowDown", "west": "ArrowLeft", "east": "ArrowRight"},
    **{"up": "ArrowUp", "down": "ArrowDown", "left": "ArrowLeft", "right": "ArrowRight", "interact": "Space"},
}
"""Action -> key of the keyboard (`KeyboardEvent.code`); `stay` is played where no key is."""


class Keyboard:
    """Which action the keys mean at a step: the last one pressed since the step before, else the one still held."""

    def __init__(self, idle: int) -> None:
        self._idle, self._held = idle, list[int]()
        self._pressed: int | None = None

    def press(self, action: int) -> None:
        """A key goes down; the browser's repetitions change nothing."""
        if action not in self._held:
            self._held.append(action)
            self._pressed = action

    def release(self, action: int) -> None:
        """A key goes up; what was pressed for a moment only still counts at the next step."""
        if action in self._held:
            self._held.remove(action)

    def take_action(self) -> int:
        """The action of this step."""
        action = self._pressed if self._pressed is not None else (self._held or [self._idle])[-1]
        self._pressed = None
        return action


@dataclass(frozen=True)
class Pairing:
    """Who plays with the person.

    Attributes:
        partner: a member's number as text, `random` or `idle`.
        seat: of the person, 0 or 1.
        seed: of the partner's draws and of the environment.
    """

    partner: str
    seat: int
    seed: int


class LiveGame:
    """One game of the exact simulator.

    Args:
        population: of the partner; its environment is played.
        pairing: who plays where.

    Raises:
        UserError: there is no such partner.
    """

    def __init__(self, population: Population, pairing: Pairing) -> None:
        env_seed, seat_seed = (int(s >> 1) for s in np.random.SeedSequence(pairing.seed).generate_state(2))
        self.pairing, self.spec = pairing, population.spec
        self._policy = choose_player(population, pairing.partner)
        self._policy.reset(1, seat_seed)
        self._env = population.make_env(1)
        self._env.reset(seed=env_seed)
        self._atlas, self._sent = TileAtlas(), 0
        self._shown: np.ndarray | None = None
        self._actions = np.zeros((1, self.spec.num_players), np.uint8)
        self._states, self._taken = [self._env.get_state()[0]], list[np.ndarray]()
        self._scores, self._events = list[float](), list[np.ndarray]()
        self.over = False

    @property
    def idle_action(self) -> int:
        """The action of a person who presses nothing."""
        names = self.spec.action_names
        return names.index("stay") if "stay" in names else 0

    def advance(self, action: int) -> dict[str, Any]:
        """The person plays `action`, the partner answers the same state; gives `describe()`.

        Raises:
            ValueError: the game is over, or there is no such action.
        """
        if self.over or not 0 <= action < self.spec.num_actions:
            raise ValueError("the game is over" if self.over else f"no action {action}")
        first = np.array([not self._taken])
        chosen = self._policy.act(self._env.observe(self._policy.view), self._actions, first)
        self._actions = np.array(chosen, np.uint8)
        self._actions[0, self.pairing.seat] = action
        result = self._env.step(self._actions)
        self._states.append(self._env.get_state()[0])
        self._taken.append(self._actions[0].copy())
        self._scores.append(float(result.score[0]))
        self._events.append(result.events[0].copy())
        self.over = bool(result.done[0])
        return self.describe()

    def describe(self) -> dict[str, Any]:
        """What changed since the last call.

        Keys: step, horizon, score, unit, over; rows, columns; cells (cell, tile, cell, tile, ...); tiles (`data:` URLs
        of new ones, in the order of their numbers); actions (names by seat), happened (seat, event) of the last step.
        """
        numbers = self._atlas.add(self._env.render_rgb(0))
        changed = np.arange(len(numbers)) if self._shown is None else np.flatnonzero(numbers != self._shown)
        self._shown, tiles = numbers, self._atlas.tile_urls(self._sent)
        self._sent = len(self._atlas)
        events = np.argwhere(self._events[-1]) if self._events else []
        return {
            "step": len(self._taken),
            "horizon": self.spec.horizon,
            "score": round(sum(self._scores), 4),
            "unit": self.spec.score_name,
            "over": self.over,
            "rows": self._atlas.rows,
            "columns": self._atlas.columns,
            "cells": [int(value) for cell in changed for value in (cell, numbers[cell])],
            "tiles": tiles,
            "actions": [self.spec.action_names[a] for a in self._taken[-1]] if self._taken else [],
            "happened": [[int(seat), self.spec.event_names[event]] for seat, event in events],
        }

    def to_recording(self) -> RecordedGame:
        """What was played so far; at least one step."""
        partner, seat = self.pairing.partner, self.pairing.seat
        players = (PERSON, partner) if seat == 0 else (partner, PERSON)
        return RecordedGame(
            players=players,
            seed=self.pairing.seed,
            states=np.stack(self._states),
            actions=np.stack(self._taken),
            scores=np.array(self._scores, np.float64),
            events=np.stack(self._events),
        )
