"""What a method on MAPPO adds to self-play: which trajectories, with whom, and with what weight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from popgen.losses.policy_losses import SIGN
from popgen.methods.mappo.config import DiversityConfig
from popgen.methods.mappo.population_bonus import PopulationBonus
from popgen.types import Kind


@dataclass(frozen=True)
class Term:
    """One expected return in an objective, beside self-play's.

    Attributes:
        kind: of its trajectories; its sign is that of `popgen.losses.policy_losses.SIGN`.
        weight: its lambda, by the recipe; 0 leaves the term out.
    """

    kind: Kind
    weight: Callable[[DiversityConfig], float]

    @property
    def sign(self) -> float:
        """Is the return to rise (+1) or to fall (-1)?"""
        return SIGN[self.kind]


@dataclass(frozen=True)
class Objective:
    """Self-play's return and further terms, all of them with the strongest partner.

    Attributes:
        terms: beside self-play.
        fresh_episodes: the strongest partner is found by whole episodes of the present policy with every partner,
            played for that alone; otherwise by the episodes of training, which then has cross-play with every partner.
        together: all members learn together, though they never meet.
        bonus: a reward beside the environment's, by what the other members that learn would do.
        bonus_score: mean self-play score at which it is paid in full; in proportion below. 0: always in full.
        noise: share of random actions of whoever has the other seat, which is the member itself; 0: plain self-play.
    """

    terms: tuple[Term, ...] = ()
    fresh_episodes: bool = False
    together: bool = False
    bonus: PopulationBonus | None = None
    bonus_score: float = 0.0
    noise: float = 0.0

    @property
    def meets_partners(self) -> bool:
        """Is anything but self-play in it?"""
        return bool(self.terms)

    def samples(self, kind: Kind, diversity: DiversityConfig) -> bool:
        """Does training sample trajectories of this kind with partners, by this recipe? Cross-play always: its episodes
        tell who is the strongest."""
        return any(term.kind is kind and (kind is Kind.XP or term.weight(diversity) > 0.0) for term in self.terms)


SELF_PLAY = Objective()
"""MAPPO alone: J(j) = J_SP(j). Members differ by their seeds."""
