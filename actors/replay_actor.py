"""Replay actor: B_SP or B_XP."""

from __future__ import annotations

from typing import Any

from popgen.actors.actor_setup import build_env
from popgen.config.sections import EnvConfig
from popgen.methods.training import Pending
from popgen.methods.xpm_wm.play_tally import Tally, TallyKeeper
from popgen.methods.xpm_wm.replay import Replay, Windows
from popgen.methods.xpm_wm.window_requests import Request, draw
from popgen.types import Segment


class ReplayActor:
    """Takes segments once each, serves encoded windows, and tells what it has taken in.

    Args:
        counted: view whose players' own states are counted; "" for none.
    """

    def __init__(self, env: EnvConfig, capacity: int, seed: int, counted: str = "") -> None:
        self.replay = Replay(build_env(env, 1), capacity, seed)
        self.keeper = TallyKeeper(self.replay.env, counted)
        self.seen: set[tuple[str, int]] = set()
        self.turn = 0

    def ingest(self, segments: Pending[list[Segment]], owner: int) -> int:
        """Store segments; a retried call adds nothing. Returns the rows held."""
        for segment in segments.result():
            key = (segment.sampler, segment.sequence)
            if key not in self.seen:
                self.seen.add(key)
                self.replay.add(segment, owner)
                self.keeper.add(segment, owner)
        return self.replay.size

    def draw(self, requests: tuple[Request, ...], length: int, view: str, repeats: int) -> list[list[Windows | None]]:
        """For each of `repeats` updates, the windows of every request (None where nothing matches)."""
        drawn = []
        for _ in range(repeats):
            drawn.append([draw(self.replay, request, length, view, self.turn) for request in requests])
            self.turn += 1
        return drawn

    def tally(self, owner: int) -> Tally:
        """Of all segments so far, with `owner` as the present member."""
        return self.keeper.tally(owner)

    def state(self) -> dict[str, Any]:
        """Contents, counters and generator."""
        seen = sorted([list(key) for key in self.seen])
        return {"replay": self.replay.state(), "seen": seen, "turn": self.turn, "tally": self.keeper.state()}

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
        self.keeper.load_state(contents["tally"])
