"""What the training loop of egos asks of its worker, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from popgen.methods.ego.ego_rollout import EndedEpisode
from popgen.methods.training import Figures, Pending, State
from popgen.types import Weights


@dataclass(frozen=True)
class Iterations:
    """What some iterations gave.

    Attributes:
        figures: means over them.
        steps: environment steps.
        simulated: steps of the exact simulator that moved augmented starts on.
        episodes: whole ones that ended.
        cpu_seconds: of the worker.
    """

    figures: Figures
    steps: int
    simulated: int
    episodes: list[EndedEpisode]
    cpu_seconds: float


class Workers(Protocol):
    """One learner with its environments and partners; it works on what it is asked in the order of asking."""

    def begin_member(self, seed: int) -> Pending[None]:
        """Fresh networks, critics and episodes."""
        ...

    def iterate(self, count: int) -> Pending[Iterations]:
        """So many rollouts with their updates."""
        ...

    def acting(self) -> Pending[Weights]:
        """The ego's weights."""
        ...

    def critics(self) -> Pending[Weights]:
        """The critics' weights."""
        ...

    def state(self) -> Pending[State]:
        """Everything to continue from exactly here."""
        ...

    def load_state(self, state: State) -> None:
        """Continue from `state()`, after `begin_member`."""
        ...

    def end(self) -> None:
        """End the learner."""
