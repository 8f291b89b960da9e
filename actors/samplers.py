"""Samplers of real episodes: each an actor that steps environments with published policies, all of them as one pool."""

from __future__ import annotations

import time
from typing import Any, Protocol, runtime_checkable

import numpy as np

from popgen.actors.actor_setup import limit_threads
from popgen.config.run_config import RunConfig
from popgen.config.sections import EnvConfig
from popgen.envs import EnvSpec, make_env
from popgen.errors import UserError
from popgen.methods.training import Collected, Pending, Place, PolicySnapshot, Sampled, SegmentCount, Transport, Worker
from popgen.play.policy import Policy
from popgen.play.rollout import Match, Sampler, split_matches
from popgen.policies.policy_registry import build_policy
from popgen.types import Kind, Segment, Weights


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
        self.played: dict[int, tuple[dict[str, Any], Policy]] = {}

    def open(self, matches: list[Match], policies: dict[int, PolicySnapshot], seed: int, stagger: bool = False) -> None:
        """Start fresh episodes of the given matches; `policies` holds one for every member in them."""
        envs = sum(match.envs for match in matches)
        env = make_env(self.env_config.name, envs, seed=seed, **self.env_config.params)
        players = {member: self._find_policy(member, snapshot, env.spec) for member, snapshot in policies.items()}
        self.played = {member: (policies[member].config, player) for member, player in players.items()}
        self.sampler = Sampler(
            env, matches, players, name=self.name, seed=seed, stagger=stagger, sequence=self.sequence
        )

    def _find_policy(self, member: int, snapshot: PolicySnapshot, spec: EnvSpec) -> Policy:
        """The member's policy: that of its last matches with new weights, a new one where it cannot take them."""
        config, policy = self.played.get(member, ({}, None))
        same = policy is not None and (policy.kind, config) == (snapshot.kind, snapshot.config)
        if not same or not isinstance(policy, Learning):
            return build_policy(snapshot.kind, snapshot.config, snapshot.weights.result(), spec)
        policy.load(snapshot.weights.result())
        return policy

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


class SamplerPool:
    """The samplers as one: matches are split over them as evenly as possible, results come in their order."""

    def __init__(self, samplers: list[Worker[SamplerActor]]) -> None:
        self.samplers = samplers
        self.active: list[int] = []

    def open(self, matches: list[Match], policies: dict[int, PolicySnapshot], seed: int, stagger: bool = False) -> None:
        """Start fresh episodes; every sampler gets the policies of its own matches and a seed of its own."""
        shares = split_matches(matches, len(self.samplers))
        self.active = [index for index, share in enumerate(shares) if share]
        opened = []
        for index in self.active:
            present = sorted({member for match in shares[index] for member in match.members})
            own = {member: policies[member] for member in present}
            sampler = self.samplers[index]
            opened.append(sampler.ask(SamplerActor.open, shares[index], own, sampler_seed(seed, index), stagger))
        for pending in opened:
            pending.result()

    def start(
        self, index: int, steps: int, member: int | None = None, weights: Pending[Weights] | None = None
    ) -> Pending[Sampled]:
        """Let one sampler play, with new weights for one member."""
        return self.samplers[index].ask(SamplerActor.collect, steps, member, weights)

    def collect(self, steps: int) -> list[Sampled]:
        """Let all play at the same time."""
        pending = [self.start(index, steps) for index in self.active]
        return [one.result() for one in pending]

    def state(self) -> list[Pending[dict[str, Any]]]:
        """All samplers' running episodes."""
        return [sampler.ask(SamplerActor.state) for sampler in self.samplers]

    def load_state(self, states: list[dict[str, Any]]) -> None:
        """Continue from `state()`, after `open` with the same matches.

        Raises:
            UserError: another number of samplers.
        """
        if len(states) != len(self.samplers):
            problem = f"{len(self.samplers)}, but the checkpoint is of {len(states)}"
            raise UserError("cluster.samplers", problem, "continue with the same number")
        pairs = zip(self.samplers, states, strict=True)
        for pending in [sampler.ask(SamplerActor.load_state, state) for sampler, state in pairs]:
            pending.result()

    def end(self) -> None:
        """End all samplers."""
        for sampler in self.samplers:
            sampler.end()


def start_samplers(config: RunConfig, attempt: str, transport: Transport) -> SamplerPool:
    """The samplers of one attempt; their names, by which buffers and ledger know a segment, carry the attempt."""
    cluster, place = config.cluster, Place(config.cluster.sampler_cpus)
    names = [f"sampler{index}.{attempt}" for index in range(cluster.samplers)]
    return SamplerPool(
        [transport.start(SamplerActor, place, config.env, name, cluster.threads, transport) for name in names]
    )


def sampler_seed(seed: int, sampler: int) -> int:
    """The seed itself for the first sampler, an independent one for each other."""
    return seed if sampler == 0 else int(np.random.SeedSequence((seed, sampler)).generate_state(1)[0] >> 1)
