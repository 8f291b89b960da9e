"""Stepping: what a rollout holds against steps taken by hand, mixed play, waiting groups, going on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from popgen.envs import BatchedEnv, make_env
from popgen.envs.reward import training_reward
from popgen.methods.mappo.slots import Rollout, SlotPool
from popgen.nets.feed_forward import FeedForwardNet, Sizes
from popgen.play.rollout import Match
from popgen.types import Kind

HORIZON = 12
SP, XP, BACK, MP = (
    Match(Kind.SP, (1, 1), 3, 1),
    Match(Kind.XP, (2, 1), 2, 2),
    Match(Kind.XP, (1, 2), 2, 2),
    Match(Kind.MP, (1, 2), 6, 2),
)


def kitchen(count: int, seed: int) -> BatchedEnv:
    return make_env("overcooked/cramped_room", count, seed=seed, horizon=HORIZON)


def arena(count: int, seed: int) -> BatchedEnv:
    return make_env("rendezvous/mppmr", count, seed=seed, horizon=30, bounds=0.8, start_noise=0.2, sensitivity=8.0)


def actors(make: Callable[[int, int], BatchedEnv] = kitchen) -> dict[int, FeedForwardNet]:
    spec = make(1, 0).spec
    nets = {}
    for member in (1, 2):
        torch.manual_seed(member)
        nets[member] = FeedForwardNet(spec.views["features"], spec.num_actions, 2, Sizes(8, 1))
        nets[member][-1].weight.data *= 20  # decided, and different from member to member
    return nets


def pool(*groups: Match, make: Callable[[int, int], BatchedEnv] = kitchen, **options: Any) -> SlotPool:
    return SlotPool(make, groups, "features", seed=5, **options)


@pytest.mark.parametrize("make", [kitchen, arena])
def test_a_rollout_is_what_the_environment_does(make: Callable[[int, int], BatchedEnv]) -> None:
    """Played again by hand: the recorded actions from the recorded states give the recorded rows."""
    slots = pool(SP, XP, make=make)
    states, nets = slots.states.copy(), actors(make)
    rollout = slots.play([0, 1], 40, nets)
    env = make(5, 0)
    env.set_state(states)
    generator = pool(SP, XP, make=make).generator
    env.load_generator_state(generator)
    cuts = []
    for t in range(40):
        assert (rollout.obs[t] == env.observe()).all()
        result = env.step(rollout.actions[t])
        np.testing.assert_allclose(rollout.reward[t], training_reward(env.spec, result), rtol=1e-6)
        np.testing.assert_array_equal(rollout.score[t], result.score)
        assert (rollout.terminated[t] == result.terminated).all() and (rollout.truncated[t] == result.truncated).all()
        for column in np.flatnonzero(result.truncated):
            cuts.append((t, int(column), env.observe()[column]))
        if result.done.any():
            env.reset(indices=np.flatnonzero(result.done))
    assert (rollout.obs[40] == env.observe()).all()
    assert [tuple(at) for at in rollout.cut_at] == [cut[:2] for cut in cuts]
    assert all((obs == cut[2]).all() for obs, cut in zip(rollout.cut_obs, cuts, strict=True))
    ended = rollout.truncated if make is kitchen else rollout.terminated
    assert rollout.steps == 200 and ended.any()


def test_log_probabilities_are_the_acting_members() -> None:
    nets = actors()
    rollout = pool(SP, XP, BACK).play([0, 1, 2], 20, nets)
    assert (rollout.seats[:, :3] == 1).all()
    assert (rollout.seats[:, 3:5] == [2, 1]).all() and (rollout.seats[:, 5:] == [1, 2]).all()
    obs = torch.from_numpy(rollout.obs[:-1])
    for member, net in nets.items():
        logits = net(obs.flatten(0, 2), torch.eye(2).repeat(20 * 7, 1)).log_softmax(-1).view(20, 7, 2, -1)
        chosen = logits.gather(-1, torch.from_numpy(rollout.actions).long().unsqueeze(-1)).squeeze(-1)
        mine = torch.from_numpy(rollout.seats == member)
        torch.testing.assert_close(torch.from_numpy(rollout.log_prob)[mine], chosen[mine].detach())


def test_actions_are_drawn_from_the_logits() -> None:
    def biased(obs: Tensor, seats: Tensor) -> Tensor:
        return torch.log(torch.tensor([0.5, 0.3, 0.1, 0.1, 1e-9, 1e-9])).expand(len(obs), 6)

    rollout = pool(Match(Kind.SP, (1, 1), 100, 1)).play([0], 100, {1: biased})
    shares = np.bincount(rollout.actions.ravel(), minlength=6) / rollout.actions.size
    np.testing.assert_allclose(shares, [0.5, 0.3, 0.1, 0.1, 0, 0], atol=0.015)


def test_episodes_are_whole_and_their_figures_are_sums() -> None:
    rollout = pool(SP, XP, make=arena).play([0, 1], 90, actors(arena))
    done = rollout.terminated | rollout.truncated
    for index, group in enumerate(rollout.matches):
        columns = rollout.columns(index)
        found = sorted(e.shaped for e in rollout.episodes if (e.kind, e.members) == (group.kind, group.members))
        by_hand = []
        for column in range(columns.start, columns.stop):
            ends = [-1, *np.flatnonzero(done[:, column])]
            whole = ends[:-1] if column == columns.start else ends[1:-1]  # the others began in the middle of one
            by_hand += [rollout.reward[a + 1 : ends[ends.index(a) + 1] + 1, column].sum() for a in whole]
        assert found == pytest.approx(sorted(by_hand), rel=1e-5) and len(found) > group.envs
    assert all(e.score == pytest.approx(e.shaped) for e in rollout.episodes)  # both are the reward here


def test_once_tells_of_the_first_episode_of_every_environment() -> None:
    slots = pool(SP, XP, make=arena, stagger=False, once=True)
    rollout = slots.play([0, 1], 90, actors(arena))
    assert (rollout.terminated | rollout.truncated).sum() > 10
    assert sorted(episode.members for episode in rollout.episodes) == [(1, 1)] * 3 + [(2, 1)] * 2


def test_mixed_play_goes_over_to_the_owner_once_in_an_episode() -> None:
    slots = pool(MP, stagger=False)
    first = slots.switch.copy()
    rollout = slots.play([0], 5 * HORIZON, actors())
    both = (rollout.seats == 2).all(-1)
    assert ((rollout.seats == [1, 2]).all(-1) | both).all()  # the partner in seat 0 before, the owner in both after
    episodes = both.reshape(5, HORIZON, 6)
    assert (np.diff(episodes.astype(int), axis=1) >= 0).all()
    points = HORIZON - episodes.sum(1)
    assert (points[0] == first).all() and points.min() >= 0 and points.max() < HORIZON and len(np.unique(points)) > 4


def test_switch_points_are_even_over_the_horizon() -> None:
    counts = np.bincount(pool(MP).draw_switches(24_000), minlength=HORIZON)
    assert len(counts) == HORIZON and counts.min() > 1800 and counts.max() < 2200


def test_a_group_that_is_not_played_waits() -> None:
    slots, nets = pool(SP, XP), actors()
    slots.play([0, 1], 3, nets)
    waiting = slots.states[slots.rows(1)].copy(), slots.age[slots.rows(1)].copy()
    rollout = slots.play([0], 7, nets)
    assert rollout.matches == (SP,) and rollout.steps == 21
    assert (slots.states[slots.rows(1)] == waiting[0]).all() and (slots.age[slots.rows(1)] == waiting[1]).all()
    goes_on = slots.play([1], 1, nets)
    assert (goes_on.obs[0] == kitchen(2, 0).encode(waiting[0])).all()


@pytest.mark.parametrize("make", [kitchen, arena])
def test_a_pool_goes_on_from_its_state(make: Callable[[int, int], BatchedEnv]) -> None:
    nets, groups = actors(make), (SP, XP, MP)
    one = pool(*groups, make=make)
    one.play([0, 1, 2], 17, nets)
    state = one.state()
    other = SlotPool(make, groups, "features", seed=99)
    other.load_state(state)
    later: list[Rollout] = [slots.play([0, 1, 2], 25, nets) for slots in (one, other)]
    for name in ("obs", "actions", "log_prob", "reward", "seats", "cut_obs"):
        assert (getattr(later[0], name) == getattr(later[1], name)).all()
    assert later[0].episodes == later[1].episodes


def test_ends_of_episodes_are_spread_over_the_horizon() -> None:
    rollout = pool(Match(Kind.SP, (1, 1), HORIZON, 1)).play([0], HORIZON, actors())
    assert (rollout.truncated.sum(1) == 1).all()
    assert len(rollout.episodes) == 1  # only the one that began at its beginning is whole
