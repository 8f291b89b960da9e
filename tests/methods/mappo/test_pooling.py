"""Advantages by hand, signs and weights by kind, and who learns from what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.rollouts import VIEW, mp, reads_observation, rollout, sp, xp
from torch import Tensor

from popgen.methods.mappo.pooling import MemberTrajectories, Plan, PooledBatch, advantages, gather, pool
from popgen.nets.feed_forward import ValueNet
from popgen.types import Kind

OPTIONS = {"discount": 0.5, "lam": 0.5, "value_decay": 0.0}


def one_column(**given: np.ndarray) -> MemberTrajectories:
    """Three steps of one environment: values 1, 2, 4 and 8 of its four observations, rewards 10, 20, 30."""
    obs = np.array([1.0, 2.0, 4.0, 8.0], np.float32).reshape(4, 1, 1, 1).repeat(2, 2)
    reward = np.array([[10.0], [20.0], [30.0]], np.float32)
    found = gather([rollout(3, sp(1, 1), obs=obs, reward=reward, **given)], Kind.SP, 1, 1)
    assert found is not None
    return found


def mark(t: int) -> np.ndarray:
    return np.arange(3)[:, None] == t


def estimated(found: MemberTrajectories) -> tuple[list[float], list[float]]:
    advantage, returns = advantages(found, reads_observation(), VIEW, discount=0.5, lam=0.5)
    return advantage.flatten().tolist(), returns.flatten().tolist()


def test_advantages_by_hand() -> None:
    """gamma = lambda = 1/2; deltas r + v'/2 - v: 10 + 1 - 1, 20 + 2 - 2, 30 + 4 - 4; A = delta + A'/4."""
    third = 30.0
    second = 20.0 + third / 4
    first = 10.0 + second / 4
    assert estimated(one_column()) == ([first, second, third], [first + 1, second + 2, third + 4])


def test_nothing_follows_a_terminated_episode() -> None:
    advantage, _ = estimated(one_column(terminated=mark(1)))
    assert advantage == [10.0 + 18.0 / 4, 20.0 - 2.0, 30.0]


def test_an_episode_cut_at_the_horizon_has_the_value_it_ended_with() -> None:
    """The last observation before the reset is 100; the row after it, 4, is of the next episode."""
    cut = {"cut_at": np.array([[1, 0]]), "cut_obs": np.full((1, 2, 1), 100.0, np.float32)}
    advantage, _ = estimated(one_column(truncated=mark(1), **cut))
    assert advantage == [10.0 + (20.0 + 50.0 - 2.0) / 4, 20.0 + 50.0 - 2.0, 30.0]


def kinds() -> list:
    return [rollout(6, sp(3), xp(3, 1), xp(1, 3), xp(2, 3), mp(1, 3), seed=seed, seats=seats(seed)) for seed in (1, 2)]


def seats(seed: int) -> np.ndarray:
    """As `kinds` sits them; member 3 has both seats of the mixed play's columns from steps 2 and 5 on."""
    match = np.array([[3, 3]] * 4 + [[3, 1]] * 2 + [[1, 3]] * 2 + [[2, 3]] * 2 + [[1, 3]] * 2)
    table = np.broadcast_to(match, (6, 12, 2)).astype(np.int32).copy()
    table[2:, 10] = table[5:, 11] = 3
    return table


def critics() -> dict[str, ValueNet]:
    return {name: reads_observation() for name in ("SP", "XP_1", "XP_2", "MP_1")}


def batch(plan: Plan, rollouts: list | None = None) -> PooledBatch:
    pooled = pool(rollouts or kinds(), 3, plan, critics(), VIEW, **OPTIONS)
    assert pooled is not None
    return pooled


def raw(kind: Kind, partner: int) -> tuple[Tensor, MemberTrajectories]:
    found = gather(kinds(), kind, 3, partner)
    assert found is not None
    advantage, _ = advantages(found, reads_observation(), VIEW, discount=0.5, lam=0.5)
    return advantage, found


def test_signs_weights_and_scales() -> None:
    """+(A - mean)/s in self-play, -lambda_XP (A - mean)/s in cross-play, +lambda_MP (A - mean)/s in mixed play, with
    s the deviation of that kind's advantages or of self-play's, whichever is larger."""
    pooled = batch(Plan(1, lambda_xp=0.5, lambda_mp=0.25))
    own, _ = raw(Kind.SP, 3)
    expected, scales = [], []
    for kind, partner, factor in ((Kind.SP, 3, 1.0), (Kind.XP, 1, -0.5), (Kind.MP, 1, 0.25)):
        advantage, found = raw(kind, partner)
        counted = found.trained.any(-1)
        centred = advantage - advantage[counted].mean()
        scales.append(max(own.std(correction=0), advantage[counted].std(correction=0)))
        scale = scales[-1]
        expected.append((factor * centred / scale).unsqueeze(-1).expand_as(found.trained)[found.trained])
    torch.testing.assert_close(pooled.advantage, torch.cat(expected))
    assert scales[0] in scales[1:] and len(set(scales)) > 1  # both cases
    assert [len(part) for part in expected] == [6 * 8 * 2, 6 * 8, 2 * (4 + 1) * 2]
    assert pooled.cross.tolist() == [False] * 96 + [True] * 48 + [False] * 20
    for part in pooled.weight.split([96, 48, 20]):
        assert part.sum().item() == pytest.approx(1.0)


def test_lower_cross_play_returns_are_preferred() -> None:
    """The row of the highest cross-play advantage is pushed down, that of the lowest up."""
    pooled, (advantage, found) = batch(Plan(1, lambda_xp=0.5)), raw(Kind.XP, 1)
    best, worst = int(advantage.flatten().argmax()), int(advantage.flatten().argmin())
    assert found.trained.sum(-1).eq(1).all()
    cross = pooled.advantage[pooled.cross]
    assert cross[best] < 0 < cross[worst]


def test_cross_play_is_bounded_by_self_plays_spread_where_told() -> None:
    own, _ = raw(Kind.SP, 3)
    advantage, _ = raw(Kind.XP, 1)
    spread = float(own.std(correction=0))
    bounded = advantage.flatten().clamp(-0.1 * spread, 0.1 * spread)
    expected = -0.5 * (bounded - bounded.mean()) / spread  # its own spread is smaller now
    assert bounded.abs().max() < advantage.abs().max()
    pooled = batch(Plan(1, lambda_xp=0.5, xp_clip=0.1))
    torch.testing.assert_close(pooled.advantage[pooled.cross], expected)


def test_cross_play_alone_counts_no_less_than_the_floor() -> None:
    played = [replace(one, covered=np.full_like(one.reward, 2.0)) for one in kinds()]
    floored = [replace(one, reward=one.reward.copy()) for one in played]
    for one in floored:  # what follows the four columns of self-play
        one.reward[:, 4:] = np.maximum(one.reward[:, 4:], -1.0)
    by_floor, by_hand, as_it_is = (
        batch(Plan(1, lambda_xp=0.5, xp_floor=floor), rollouts).advantage
        for floor, rollouts in ((-0.5, played), (None, floored), (None, played))
    )
    torch.testing.assert_close(by_floor, by_hand, rtol=0.0, atol=0.0)
    assert not torch.equal(by_floor, as_it_is)


def test_only_the_members_own_seats_are_trained() -> None:
    pooled = batch(Plan(1, lambda_xp=0.5))
    rollouts = kinds()
    mine = np.concatenate([np.concatenate([r.log_prob[:, 4:6, 0], r.log_prob[:, 6:8, 1]], 1) for r in rollouts], 1)
    assert sorted(pooled.log_prob[pooled.cross].tolist()) == sorted(mine.ravel().tolist())
    seats = pooled.extras[pooled.cross]
    assert seats.sum(0).tolist() == [24, 24]  # both seatings


def test_mixed_play_trains_only_after_the_switch() -> None:
    found = gather(kinds(), Kind.MP, 3, 1)
    assert found is not None
    by_hand = torch.zeros(6, 4, 2, dtype=torch.bool)
    by_hand[2:, 0] = by_hand[5:, 1] = by_hand[2:, 2] = by_hand[5:, 3] = True
    assert torch.equal(found.trained, by_hand)
    pooled = batch(Plan(1, lambda_xp=0.5, lambda_mp=0.25))
    assert len(pooled.critics["MP_1"].target) == 10


def test_what_happens_before_the_switch_does_not_reach_the_estimates_after_it() -> None:
    changed = []
    for seed in (1, 2):
        table = kinds()[seed - 1]
        reward = table.reward.copy()
        reward[:2, 10:] += 1000.0
        changed.append(rollout(6, *table.matches, seed=seed, seats=table.seats, reward=reward))
    plain = batch(Plan(1, lambda_xp=0.5, lambda_mp=0.25))
    other = batch(Plan(1, lambda_xp=0.5, lambda_mp=0.25), changed)
    torch.testing.assert_close(plain.advantage, other.advantage)
    torch.testing.assert_close(plain.critics["MP_1"].target, other.critics["MP_1"].target)


def test_each_critic_sees_its_own_trajectories_only() -> None:
    pooled, rollouts = batch(Plan(2, lambda_xp=0.5)), kinds()
    assert set(pooled.critics) == {"SP", "XP_2"}
    shown = {"SP": slice(0, 4), "XP_2": slice(8, 10)}
    for name, columns in shown.items():
        seen = np.concatenate([r.obs[:-1, columns, 0] for r in rollouts], 1).ravel()
        assert sorted(pooled.critics[name].obs.flatten().tolist()) == sorted(seen.tolist())
    assert pooled.critics["XP_2"].extras.tolist() == [[0.0, 1.0]] * 24  # member 3 sits in seat 1


def test_members_that_learn_together_each_take_their_seat_of_the_same_trajectories() -> None:
    table = rollout(3, sp(1), sp(2), xp(1, 2), xp(2, 1))
    for member, partner, first in ((1, 2, 0), (2, 1, 1)):
        found = gather([table], Kind.XP, member, partner)
        assert found is not None
        assert found.seat.tolist() == [first, first, 1 - first, 1 - first]
        assert found.trained.sum().item() == 12
        assert (found.trained.numpy() == (table.seats[:, 8:] == member)).all()


def test_ends_of_episodes_follow_their_columns() -> None:
    """Groups are cut out and put side by side: the places of truncations must move with them."""
    at = np.array([[0, 1], [1, 4], [2, 7]])
    final = np.array([1.0, 2.0, 3.0], np.float32).reshape(3, 1, 1).repeat(2, 1)
    table = rollout(3, sp(3), xp(3, 1), xp(1, 3), cut_at=at, cut_obs=final)
    found = gather([table, table], Kind.XP, 3, 1)
    assert found is not None
    assert found.steps.cut_at.tolist() == [[1, 0], [2, 3], [1, 4], [2, 7]]
    assert found.steps.cut_obs[:, 0, 0].tolist() == [2.0, 3.0, 2.0, 3.0]


def test_an_epoch_has_every_row_once() -> None:
    pooled = batch(Plan(1, lambda_xp=0.5, lambda_mp=0.25))
    parts = list(pooled.minibatches(5, torch.Generator().manual_seed(1)))
    assert len(parts) == 5
    assert sorted(torch.cat([part["log_prob"] for part in parts]).tolist()) == sorted(pooled.log_prob.tolist())
    assert sum(float(part["weight"].sum()) for part in parts) / 5 == pytest.approx(3.0)  # a mean of each kind
    for name, rows in pooled.critics.items():
        seen = torch.cat([part["critics"][name].target for part in parts if name in part["critics"]])
        assert sorted(seen.tolist()) == sorted(rows.target.tolist())


def test_without_self_play_there_is_nothing_to_learn() -> None:
    """A lost runner may have had all of it; cross-play alone has no scale."""
    assert pool([rollout(3, xp(3, 1))], 3, Plan(1, 0.5), {"XP_1": reads_observation()}, VIEW, **OPTIONS) is None


def test_mixed_play_before_any_switch_is_left_out() -> None:
    table = rollout(3, sp(3), xp(3, 1), mp(1, 3))
    pooled = batch(Plan(1, 0.5, 0.25), [table])
    assert set(pooled.critics) == {"SP", "XP_1"}


def test_a_single_step_after_the_switch_gives_finite_figures() -> None:
    seats = np.broadcast_to(np.array([[3, 3]] * 4 + [[1, 3]] * 2), (3, 6, 2)).astype(np.int32).copy()
    seats[2, 4] = 3
    pooled = pool([rollout(3, sp(3), mp(1, 3), seats=seats)], 3, Plan(1, 0.0, 0.25), critics(), VIEW, **OPTIONS)
    assert pooled is not None and len(pooled.critics["MP_1"].target) == 1
    assert np.isfinite(list(pooled.figures.values())).all() and pooled.advantage[-2:].tolist() == [0.0, 0.0]
