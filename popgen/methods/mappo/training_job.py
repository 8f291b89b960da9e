"""What one RLlib algorithm is to train: the members, the partners, and who plays in which environments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from popgen.config.sections import EnvConfig
from popgen.methods.mappo.config import DiversityConfig, PpoConfig
from popgen.methods.mappo.hidden_utility import Utility
from popgen.methods.mappo.population_bonus import PopulationBonus
from popgen.nets.feed_forward import Sizes
from popgen.play.rollout import Match
from popgen.types import Kind, Weights

PLAIN_ONE_IN = 4
"""Beside a noisy partner: of so many environments of a member's own play it plays one plainly with itself."""


@dataclass(frozen=True)
class Job:
    """One training: `learning` members together, against each other and `frozen` predecessors.

    Attributes:
        env: the environment.
        ppo, diversity: the recipe; `diversity` None for self-play alone.
        learning: members to train.
        frozen: member -> weights of its actor.
        mixed: with mixed play (CoMeDi).
        fresh: the strongest partner is found by episodes of its own (CoMeDi), not by the training's.
        seed: of everything.
        bonus: added to self-play's reward.
        bonus_score: mean self-play score at which it is paid in full; in proportion below. 0: always in full.
        pairs: learning member -> who has the other seat in its play, where that is not itself: another learning member,
            or -m for the member's own policy with random actions among its own. Beside that it also plays plainly with
            itself in some environments, which tell its score and are not learned from.
        utilities: learning member -> what it is paid in the training reward's place.
        noise: share of the random actions.
        all_partners: cross-play with every partner is trained on in each iteration, not with one of them.
    """

    env: EnvConfig
    ppo: PpoConfig
    diversity: DiversityConfig | None
    learning: tuple[int, ...]
    seed: int
    frozen: Mapping[int, Weights] = field(default_factory=dict)
    mixed: bool = False
    fresh: bool = False
    bonus: PopulationBonus | None = None
    bonus_score: float = 0.0
    pairs: Mapping[int, int] = field(default_factory=dict)
    utilities: Mapping[int, Utility] = field(default_factory=dict)
    noise: float = 0.0
    all_partners: bool = False

    @property
    def owners(self) -> list[int]:
        """Those of `learning` for whom their own play is sampled and counted: of a pair the first."""
        others = set(self.pairs.values())
        return [member for member in self.learning if member not in others]

    def owner_of(self, member: int) -> int:
        """For whom a member's own play is counted."""
        return next((owner for owner, other in self.pairs.items() if other == member), member)

    def mate_of(self, member: int) -> int:
        """Who has the other seat in a member's own play: itself but for pairs."""
        owner = self.owner_of(member)
        return self.pairs.get(member, member) if owner == member else owner

    def partners(self, member: int) -> list[int]:
        """Whom a learning member meets in cross-play: of pairs, those in its mate's place in the others."""
        if self.diversity is None:
            return []
        if self.pairs:
            places = self.pairs.values() if member in self.pairs else self.pairs
            return sorted({*places} - {self.mate_of(member)})
        return sorted({*self.frozen, *self.learning} - {member})

    def matches(self) -> list[Match]:
        """All environments: self-play of every member, cross-play and mixed play of every pair in both seatings.

        Where two members learn together, their cross-play trains both; its steps are the later member's, as if it had
        been added to a population of the earlier ones (of pairs, the second's).
        """
        matches = [match for member in self.owners for match in self._own_play(member)]
        if self.diversity is None:
            return matches
        half = self.diversity.xp_envs // 2
        pairs = sorted({(k, m) for m in self.learning for k in self.partners(m) if k < m or k in self.frozen})
        for k, m in pairs:
            matches += [Match(Kind.XP, (m, k), half, m), Match(Kind.XP, (k, m), half, m)]
        half = self.diversity.mp_envs // 2
        for k, m in pairs if self.mixed else []:
            matches += [Match(Kind.MP, (m, k), half, m), Match(Kind.MP, (k, m), half, m)]
        return matches

    def is_noisy(self, member: int) -> bool:
        """Does it learn beside its own policy with random actions?"""
        return self.mate_of(member) == -member

    def _own_play(self, member: int) -> list[Match]:
        """A member with itself, or its pair in both seatings; beside a noisy partner also plainly with itself."""
        mate, envs = self.mate_of(member), self.ppo.envs
        if mate == member:
            return [Match(Kind.SP, (member, member), envs, member)]
        plain = max(1, envs // PLAIN_ONE_IN) if self.is_noisy(member) else 0
        envs -= plain
        seatings = [((member, mate), envs - envs // 2), ((mate, member), envs // 2)]
        seatings += [((member, member), plain)] if plain else []
        return [Match(Kind.SP, members, count, member) for members, count in seatings]

    def critics(self, member: int) -> list[str]:
        """Names of a member's critics, one for each kind of trajectory and partner."""
        kinds = (Kind.XP, Kind.MP) if self.mixed else (Kind.XP,)
        return [critic_name(Kind.SP, member)] + [critic_name(kind, k) for kind in kinds for k in self.partners(member)]


def critic_name(kind: Kind, partner: int) -> str:
    """The critic of trajectories of a kind with a partner; self-play has one."""
    return "SP" if kind is Kind.SP else f"{kind}_{partner}"


def sizes_of(ppo: PpoConfig) -> Sizes:
    """The networks of a recipe."""
    return Sizes(ppo.units, ppo.layers, ppo.activation, tuple(ppo.cnn_kernels), ppo.cnn_channels)


def policy_config(ppo: PpoConfig) -> dict[str, Any]:
    """`FeedForwardPolicy.config()` of the members that a recipe trains."""
    named = {} if ppo.view == "features" else {"name": ppo.view}
    return {**sizes_of(ppo).as_dict(), **named, "greedy": False}
