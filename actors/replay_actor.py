"""Replay actor: B_SP or B_XP."""

from __future__ import annotations

from typing import Any

from popgen.actors.actor_setup import build_env
from popgen.config.sections import EnvConfig
from popgen.methods.training import Pending
from popgen.methods.xpm_wm.replay import Replay, Windows
from popgen.methods.xpm_wm.window_requests import Request, draw
from popgen.types import Segment


class ReplayActor:
    """Takes segments once each and serves encoded windows."""

    def __init__(self, env: EnvConfig, capacity: int, seed: int) -> None:
        self.replay = Replay(build_env(env, 1), capacity, seed)
        self.seen: set[tuple[str, int]] = set()
        self.turn = 0

    def ingest(self, segments: Pending[list[Segment]], owner: int) -> int:
        """Store segments; a retried call adds nothing. Returns the rows held."""
        for segment in segments.result():
            key = (segment.sampler, segment.sequence)
            if key not in self.seen:
                self.seen.add(key)
                self.replay.add(segment, owner)
        return self.replay.size

    def draw(self, requests: tuple[Request, ...], length: int, view: str, repeats: int) -> list[list[Windows | None]]:
        """For each of `repeats` updates, the windows of every request (None where nothing matches)."""
        drawn = []
        for _ in range(repeats):
            drawn.append([draw(self.replay, request, length, view, self.turn) for request in requests])
            self.turn += 1
        return drawn

    def state(self) -> dict[str, Any]:
        """Contents, counters and generator."""
        return {"replay": self.replay.state(), "seen": sorted([list(key) for key in self.seen]), "turn": self.turn}

    def marks(self) -> dict[str, Any]:
        """What `state` holds beside the contents: small enough for every iteration."""
        return {"rng": self.replay.rng.bit_generator.state, "turn": self.turn}

    def load_marks(self, marks: dict[str, Any]) -> None:
        """Draw on from `marks()`, with contents that were added again."""
        self.replay.rng.bit_generator.state = marks["rng"]
        self.turn = int(marks["turn"])

    def load_state(self, state: Pending[dict[str, Any]]) -> None:
        """Continue from `state()`."""
        contents = state.result()
        self.replay.load_state(contents["replay"])
        self.seen = {(str(name), int(number)) for name, number in contents["seen"]}
        self.turn = int(contents["turn"])
