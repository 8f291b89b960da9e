"""Partners that act in one stacked call answer as they would one by one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.small import AGENT, MODEL, kitchen

from popgen.methods.xpm_wm.actor_critic import WorldModelPolicy
from popgen.play.policy import Policy
from popgen.play.stacked_partners import PartnerPool, Stackable
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy

SPEC = kitchen().spec


def make_partners(kind: str, count: int = 3) -> list[Policy]:
    if kind == "feed_forward":
        view = SPEC.views["features"]
        return [FeedForwardPolicy(view, SPEC.num_actions, units=8, seed=seed) for seed in range(count)]
    model = MODEL.model_copy(update={"imagination": "mode"})
    partners: list[Policy] = []
    for seed in range(count):
        torch.manual_seed(seed)
        partners.append(WorldModelPolicy(model, AGENT, SPEC))
    return partners


@pytest.mark.parametrize("kind", ["feed_forward", "world_model"])
def test_stacked_logits_equal_each_policys_own(kind: str) -> None:
    rows = 7
    pool = PartnerPool(make_partners(kind), rows, 0)
    (group,) = pool.groups
    env, rng = kitchen(rows), np.random.default_rng(0)
    partner, seat = np.array([0, 1, 2, 0, 1, 0, 0]), np.array([0, 1, 0, 1, 0, 1, 0])
    group.seat_rows(partner)
    networks = [policy.seat_network() for policy in make_partners(kind) if isinstance(policy, Stackable)]
    memories = torch.zeros(rows, group.memory.shape[1])
    previous = np.zeros((rows, 2), np.uint8)
    for step in range(6):
        first = np.array([step in (0, 4)] * 3 + [step == 0] * 4)
        obs, before = torch.from_numpy(env.observe()), torch.from_numpy(previous.astype(np.int64))
        stacked = group.logits(obs, before, torch.from_numpy(first), torch.from_numpy(seat))
        for row in range(rows):
            one = slice(row, row + 1)
            network = networks[partner[row]]
            assert network is not None
            with torch.no_grad():
                logits, memory = network(
                    memories[one], obs[one], before[one], torch.from_numpy(first[one]), torch.tensor([seat[row]])
                )
            memories[one] = memory
            place = (group.index[partner[row]] == row) & torch.from_numpy(group.filled[partner[row]])
            torch.testing.assert_close(stacked[partner[row]][place], logits, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(group.memory, memories, atol=1e-5, rtol=1e-5)
        previous = rng.integers(0, 6, (rows, 2)).astype(np.uint8)
        env.step(previous)


def test_a_seat_network_is_what_act_draws_from() -> None:
    """Over many draws the actions of `act` have the frequencies of the stacked logits."""
    (policy,) = make_partners("world_model", 1)
    rows = 4000
    obs = np.repeat(kitchen(1).observe(), rows, axis=0)
    policy.reset(rows, 0)
    first, previous = np.ones(rows, bool), np.zeros((rows, 2), np.uint8)
    drawn = policy.act(obs, previous, first)
    pool = PartnerPool([policy], rows, 1)
    for seat in (0, 1):
        seats = np.full(rows, seat)
        stacked = pool.act({"features": obs}, previous, first, np.zeros(rows, np.int64), seats)
        shares = [np.bincount(actions, minlength=6) / rows for actions in (drawn[:, seat], stacked)]
        assert np.abs(shares[0] - shares[1]).max() < 0.05


def test_a_mixed_pool_plays_each_in_its_rows_and_continues() -> None:
    partners = [*make_partners("feed_forward", 2), *make_partners("world_model", 2)]
    partners += [RandomPolicy(6), IdlePolicy(SPEC.action_names)]
    rows = 12
    pool = PartnerPool(partners, rows, 0)
    assert [group.numbers for group in pool.groups] == [[0, 1], [2, 3]]
    partner, seat = np.arange(12) % 6, np.arange(12) // 6
    seen = {"features": kitchen(rows).observe()}
    previous, first = np.zeros((rows, 2), np.uint8), np.ones(rows, bool)
    pool.act(seen, previous, first, partner, seat)
    state = pool.state()
    expected = pool.act(seen, previous, ~first, partner, seat)
    assert (expected[[5, 11]] == list(SPEC.action_names).index("stay")).all()
    again = PartnerPool([*make_partners("feed_forward", 2), *make_partners("world_model", 2), *partners[4:]], rows, 9)
    again.load_state(state)
    assert np.array_equal(again.act(seen, previous, ~first, partner, seat), expected)
