"""Real episodes, spread over all samplers."""

from __future__ import annotations

from typing import Any

import numpy as np
import ray

from popgen.actors.sampler_actor import Collected, PolicySnapshot
from popgen.errors import UserError
from popgen.play.sampler import Match, split_matches


class SamplerPool:
    """The sampler actors as one: matches are split over them as evenly as possible, results come in their order."""

    def __init__(self, samplers: list[Any]) -> None:
        self.samplers = samplers
        self.active: list[int] = []
        self._stored: dict[int, tuple[PolicySnapshot, Any]] = {}

    def open(self, matches: list[Match], parts: dict[int, PolicySnapshot], seed: int, stagger: bool = False) -> None:
        """Start fresh episodes; every sampler gets the policies of its own matches and a seed of its own.

        Policies travel as references: a member's weights go into the object store once, and from there once to each
        node, for as long as `parts` holds the same weights for it.
        """
        self._store(parts)
        shares = split_matches(matches, len(self.samplers))
        self.active = [index for index, share in enumerate(shares) if share]
        opened = []
        for index in self.active:
            present = sorted({member for match in shares[index] for member in match.members})
            own = {member: self._stored[member][1] for member in present}
            opened.append(self.samplers[index].open.remote(shares[index], own, seed_of(seed, index), stagger))
        ray.get(opened)

    def _store(self, parts: dict[int, PolicySnapshot]) -> None:
        known = self._stored
        same = {m for m, p in parts.items() if m in known and known[m][0].weights is p.weights and p.weights}
        self._stored = {m: known[m] if m in same else (p, ray.put(p)) for m, p in parts.items()}

    def start(self, index: int, steps: int, member: int | None = None, weights: Any = None) -> tuple[Any, Any]:
        """Let one sampler play, with new weights (a reference) for one member: references to segments and counts."""
        return self.samplers[index].collect.options(num_returns=2).remote(steps, member, weights)

    def collect(self, steps: int) -> list[tuple[Any, Collected]]:
        """Let all play at the same time: segments (a reference) and counts of each."""
        pending = [self.start(index, steps) for index in self.active]
        return [(segments, ray.get(counts)) for segments, counts in pending]

    def state(self) -> list[dict[str, Any]]:
        """All samplers' running episodes."""
        return ray.get([sampler.state.remote() for sampler in self.samplers])

    def load_state(self, states: list[dict[str, Any]]) -> None:
        """Go on from `state()`, after `open` with the same matches.

        Raises:
            UserError: another number of samplers.
        """
        if len(states) != len(self.samplers):
            problem = f"{len(self.samplers)}, but the checkpoint is of {len(states)}"
            raise UserError("cluster.samplers", problem, "go on with the same number")
        ray.get([sampler.load_state.remote(state) for sampler, state in zip(self.samplers, states, strict=True)])


def seed_of(seed: int, sampler: int) -> int:
    """The seed itself for the first sampler, an independent one for each other."""
    return seed if sampler == 0 else int(np.random.SeedSequence((seed, sampler)).generate_state(1)[0] >> 1)
