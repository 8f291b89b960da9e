"""Several samplers as one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from popgen.actors.samplers import SamplerPool, sampler_seed
from popgen.errors import UserError
from popgen.methods.training import InlineWorker, PolicySnapshot, Ready
from popgen.play.rollout import Match
from popgen.types import Kind


class Sampler:
    """Remembers what it was opened with."""

    def __init__(self) -> None:
        self.opened: list[tuple[list[Match], dict[int, PolicySnapshot], int]] = []

    def open(self, matches: list[Match], policies: dict[int, PolicySnapshot], seed: int, stagger: bool) -> None:
        self.opened.append((matches, policies, seed))


def test_samplers_get_handles_of_their_own_matches_policies() -> None:
    """Weights behind a handle go to a node once, whoever plays with them."""
    samplers: list[Any] = [Sampler() for _ in range(3)]
    pool = SamplerPool([InlineWorker(sampler) for sampler in samplers])
    policies = {member: PolicySnapshot("k", {}, Ready({"w": np.zeros(3)})) for member in (1, 2, 3)}
    pool.open([Match(Kind.XP, (1, 2), 2), Match(Kind.XP, (1, 3), 1)], policies, seed=7)
    assert pool.active == [0, 1, 2]
    assert [set(sampler.opened[0][1]) for sampler in samplers] == [{1, 2}, {1, 2}, {1, 3}]
    assert all(sampler.opened[0][1][1] is policies[1] for sampler in samplers)
    assert [sampler.opened[0][2] for sampler in samplers] == [sampler_seed(7, index) for index in range(3)]


def test_a_checkpoint_is_of_as_many_samplers() -> None:
    pool = SamplerPool([InlineWorker(Sampler())])  # type: ignore[list-item]
    with pytest.raises(UserError, match=r"cluster.samplers: 1, but the checkpoint is of 2"):
        pool.load_state([{}, {}])


def test_samplers_have_seeds_of_their_own() -> None:
    assert sampler_seed(7, 0) == 7
    assert len({sampler_seed(seed, index) for seed in range(20) for index in range(20)}) == 400
