"""Real episodes, spread over all samplers."""

from __future__ import annotations

from typing import Any

import numpy as np

from popgen.actors.sampler_actor import SamplerActor
from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.methods.training import Pending, PolicySnapshot, Sampled
from popgen.methods.transport import Place, Transport, Worker
from popgen.nets.weights import Weights
from popgen.play.matches import Match, split_matches


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
