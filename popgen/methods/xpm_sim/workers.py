"""What XPM-Sim's training loop asks of its workers, and what they answer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from popgen.methods.training import Figures, Pending, PolicySnapshot, Sampled, Segments, State
from popgen.play.rollout import Match
from popgen.types import Weights


@dataclass(frozen=True)
class Learned:
    """What some updates gave.

    Attributes:
        acting: a handle of the policy's weights after them.
        metrics: mean figures.
        steps, trajectories: simulated meanwhile.
    """

    acting: Pending[Weights]
    metrics: Figures
    steps: int
    trajectories: int


@dataclass(frozen=True)
class RestartCheck:
    """What the exact dynamics say of a finished member (`popgen.methods.xpm_sim.restart_check`), and their steps."""

    figures: dict[str, float]
    steps: int


class Workers(Protocol):
    """Samplers of real episodes, and one learner with its buffers and the exact dynamics F.

    The learner works on what it is asked in the order of asking.
    """

    def put(self, weights: Weights) -> Pending[Weights]:
        """A handle of weights that this process holds."""
        ...

    def begin_member(
        self, member: int, seed: int, partners: Mapping[int, Pending[Weights]], encoder: Pending[State | None] | None
    ) -> Pending[Weights]:
        """Fresh networks and empty buffers beside frozen partners; the fresh policy's weights."""
        ...

    def play(self, matches: list[Match], policies: dict[int, PolicySnapshot], seed: int, steps: int) -> list[Sampled]:
        """`steps` steps from the start in every environment of the matches."""
        ...

    def ingest(
        self, segments: list[Segments], strength: dict[int, float], multipliers: dict[int, float]
    ) -> Pending[None]:
        """Real episodes into the buffers B_SP and B_XP; each partner's return in real cross-play, and its multiplier
        (`popgen.play.partner_strength`)."""
        ...

    def learn(self, updates: int) -> Pending[Learned]:
        """Simulate and update so many times."""
        ...

    def check(self) -> Pending[RestartCheck]:
        """Is self-play as good from cross-play's states as from its own?"""
        ...

    def critics(self) -> Pending[Weights]:
        """The critics' weights."""
        ...

    def encoder(self) -> Pending[State | None]:
        """The encoder that members share, None without one."""
        ...

    def state(self) -> State:
        """Handles of everything to continue from exactly here."""
        ...

    def load_state(self, state: State) -> None:
        """Continue from `state()`, after `begin_member` with the same partners."""
        ...

    def end(self) -> None:
        """End all of them."""
