"""Who plays in the real environments: matches of both phases, and policies as they travel to samplers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from popgen.envs.contract import EnvSpec
from popgen.methods.training import Pending, PolicySnapshot, Sampled
from popgen.methods.xpm_wm.config import XpmWmRun
from popgen.nets.weights import Weights
from popgen.play.episodes import Episode
from popgen.play.matches import Match
from popgen.policies.simple_policies import RandomPolicy
from popgen.types import RANDOM_MEMBER, Kind

Pair = tuple[int, int]


def policy_snapshot(config: XpmWmRun, acting: Pending[Weights]) -> PolicySnapshot:
    """A member's policy as it travels to a sampler."""
    sizes = {"world_model": config.world_model.model_dump(mode="json"), "agent": config.agent.model_dump(mode="json")}
    return PolicySnapshot("world_model", sizes, acting)


def random_snapshot(spec: EnvSpec, interact: float, put: Callable[[Any], Pending[Any]]) -> PolicySnapshot:
    """The random player; where there is such an action, it interacts with probability `interact` (0: as any other)."""
    names, probabilities = spec.action_names, None
    if interact and "interact" in names:
        rest = (1.0 - interact) / (len(names) - 1)
        probabilities = [interact if name == "interact" else rest for name in names]
    random = RandomPolicy(spec.num_actions, probabilities)
    return PolicySnapshot(random.kind, random.config(), put({}))


def random_match(envs: int) -> Match:
    """Random play in all environments."""
    return Match(Kind.RANDOM, (RANDOM_MEMBER, RANDOM_MEMBER), envs)


def self_play_match(member: int, envs: int) -> Match:
    """Self-play in all environments."""
    return Match(Kind.SP, (member, member), envs)


def seatings(member: int, partners: Sequence[int]) -> list[Pair]:
    """Every partner, in both seats."""
    return [pair for partner in partners for pair in ((member, partner), (partner, member))]


def later_matches(member: int, pairs: Sequence[Pair], episodes_sp: int, episodes_xp: int, seed: int) -> list[Match]:
    """Self-play, and cross-play of every pair, in an order drawn by `seed`: an episode in each environment."""
    order = np.random.default_rng(seed).permutation(len(pairs))
    counts = np.bincount(np.arange(episodes_xp) % len(pairs), minlength=len(pairs))
    cross = [Match(Kind.XP, pairs[i], int(n)) for i, n in zip(order, counts, strict=True)]
    return [self_play_match(member, episodes_sp), *cross]


def episodes_of(sampled: Sequence[Sampled]) -> list[Episode]:
    """The episodes that ended, in the samplers' order."""
    return [episode for one in sampled for episode in one.collected.episodes]


def steps_of(sampled: Sequence[Sampled]) -> int:
    """Environment steps of all of them."""
    return sum(one.collected.steps for one in sampled)
