"""Sampler actor: steps real environments with published policies."""

from __future__ import annotations

import time
from typing import Any, Protocol, runtime_checkable

from popgen.actors.actor_setup import build_env, limit_threads
from popgen.config.sections import EnvConfig
from popgen.methods.training import Collected, Pending, PolicySnapshot, Sampled, SegmentCount
from popgen.methods.transport import Transport
from popgen.nets.weights import Weights
from popgen.play.matches import Match
from popgen.play.sampler import Sampler
from popgen.policies.policy_registry import build_policy
from popgen.types import Kind, Segment


@runtime_checkable
class Learning(Protocol):
    """A policy that takes new weights while it plays."""

    def load(self, weights: Weights) -> None:
        """Act with these from now on."""


class SamplerActor:
    """Holds one `Sampler` at a time; segment numbers continue over all of them."""

    def __init__(self, env: EnvConfig, name: str, threads: int, transport: Transport) -> None:
        limit_threads(threads)
        self.env_config, self.name, self.transport = env, name, transport
        self.sequence = 0
        self.sampler: Sampler | None = None

    def open(self, matches: list[Match], policies: dict[int, PolicySnapshot], seed: int, stagger: bool = False) -> None:
        """Start fresh episodes of the given matches; `policies` holds one for every member in them."""
        env = build_env(self.env_config, sum(match.envs for match in matches), seed)
        built = {
            member: build_policy(policy.kind, policy.config, policy.weights.result(), env.spec)
            for member, policy in policies.items()
        }
        self.sampler = Sampler(env, matches, built, name=self.name, seed=seed, stagger=stagger, sequence=self.sequence)

    def collect(self, steps: int, member: int | None = None, weights: Pending[Weights] | None = None) -> Sampled:
        """Play `steps` joint steps, with new weights for one member if given. Segments stay in the store, by kind."""
        if self.sampler is None:
            raise RuntimeError("open before collect")
        began = time.process_time()
        if member is not None and weights is not None:
            policy = self.sampler.policies[member]
            assert isinstance(policy, Learning)
            policy.load(weights.result())
        segments, episodes = self.sampler.collect(steps)
        self.sequence = self.sampler.sequence
        counts = [SegmentCount(s.kind, s.members, s.sequence, s.steps) for s in segments]
        by_kind: dict[Kind, list[Segment]] = {}
        for segment in segments:
            by_kind.setdefault(segment.kind, []).append(segment)
        stored = {kind: self.transport.put(part) for kind, part in by_kind.items()}
        return Sampled(Collected(self.name, counts, episodes, time.process_time() - began), stored)

    def state(self) -> dict[str, Any]:
        """The running episodes and the number of the next segment."""
        return {"sequence": self.sequence, "sampler": self.sampler.state() if self.sampler else None}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`, after `open` with the same matches."""
        self.sequence = int(state["sequence"])
        if state["sampler"] is not None and self.sampler is not None:
            self.sampler.load_state(state["sampler"])
            self.sampler.sequence = self.sequence
