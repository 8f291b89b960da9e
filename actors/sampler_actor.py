"""Sampler actor: steps real environments with published policies."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import ray

from popgen.actors.actor_setup import build_env, limit_threads
from popgen.config.sections import EnvConfig
from popgen.nets.weights import Weights
from popgen.play.sampler import Episode, Match, Sampler
from popgen.policies.policy_registry import build_policy
from popgen.types import Kind, Segment


@dataclass(frozen=True)
class PolicySnapshot:
    """A policy as it travels: kind, configuration and weights (`popgen.policies.policy_registry.build_policy`)."""

    kind: str
    config: dict[str, Any]
    weights: Weights


@dataclass(frozen=True)
class Collected:
    """What the ledger and the driver need of a round of sampling, beside the segments themselves.

    counts: (kind, members, sequence, steps) per segment; episodes: those that ended; cpu_seconds: of the sampler.
    """

    sampler: str
    counts: list[tuple[Kind, tuple[int, int], int, int]]
    episodes: list[Episode]
    cpu_seconds: float = 0.0


class SamplerActor:
    """Holds one `Sampler` at a time; segment numbers go on over all of them."""

    def __init__(self, env: EnvConfig, name: str, threads: int) -> None:
        limit_threads(threads)
        self.env_config, self.name = env, name
        self.sequence = 0
        self.sampler: Sampler | None = None

    def open(self, matches: list[Match], parts: dict[int, Any], seed: int, stagger: bool) -> None:
        """Start fresh episodes of the given matches; `parts` holds `PolicySnapshot`, or a reference to them, for every
        member in them. All samplers of a node read one copy of what is referred to."""
        parts = {m: ray.get(p) if isinstance(p, ray.ObjectRef) else p for m, p in parts.items()}
        env = build_env(self.env_config, sum(match.envs for match in matches), seed)
        policies = {member: build_policy(p.kind, p.config, p.weights, env.spec) for member, p in parts.items()}
        self.sampler = Sampler(
            env, matches, policies, name=self.name, seed=seed, stagger=stagger, sequence=self.sequence
        )

    def collect(
        self, steps: int, member: int | None = None, weights: Weights | None = None
    ) -> tuple[list[Segment], Collected]:
        """Play `steps` joint steps, with new weights for one member if given; segments and their counts."""
        if self.sampler is None:
            raise RuntimeError("open before collect")
        began = time.process_time()
        if member is not None and weights is not None:
            self.sampler.policies[member].load(weights)
        segments, episodes = self.sampler.collect(steps)
        self.sequence = self.sampler.sequence
        counts = [(s.kind, s.members, s.sequence, s.steps) for s in segments]
        return segments, Collected(self.name, counts, episodes, time.process_time() - began)

    def state(self) -> dict[str, Any]:
        """The running episodes and the number of the next segment."""
        return {"sequence": self.sequence, "sampler": self.sampler.state() if self.sampler else None}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from `state()`, after `open` with the same matches."""
        self.sequence = int(state["sequence"])
        if state["sampler"] is not None and self.sampler is not None:
            self.sampler.load_state(state["sampler"])
            self.sampler.sequence = self.sequence
