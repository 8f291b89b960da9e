"""How differently members act: by hand, at the bounds, and against a replay of one game."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from popgen.envs import make_env
from popgen.evaluation.action_diversity import measure_actions, measure_groups
from popgen.evaluation.holdout_players import Group, Player
from popgen.losses.population_diversity import trajectory_divergence
from popgen.play.rollout import play
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.simple_policies import RandomPolicy

HORIZON = 12
SPEC = make_env("overcooked/cramped_room", 1, horizon=HORIZON).spec


def make(count: int, seed: int) -> Any:
    return make_env("overcooked/cramped_room", count, horizon=HORIZON, seed=seed)


def member(seed: int, *, action: int | None = None) -> FeedForwardPolicy:
    """Random weights, or one action with near certainty."""
    policy = FeedForwardPolicy(SPEC.views["features"], SPEC.num_actions, units=8, layers=1, seed=seed)
    if action is not None:
        last = [module for module in policy.net.modules() if isinstance(module, nn.Linear)][-1]
        with torch.no_grad():
            last.weight.zero_()
            last.bias.copy_(-40.0 * torch.ones(SPEC.num_actions))
            last.bias[action] = 40.0
    return policy


def test_one_member_twice_diverges_from_nobody() -> None:
    found = measure_actions(make, [member(1), member(1)], 2, 0)
    assert found is not None and found.steps == 4 * HORIZON and found.most == pytest.approx(math.log(2))
    assert found.entropy.value == pytest.approx(found.own_entropy.value, abs=1e-6) and found.entropy.value > 1.0
    assert found.actions.value == pytest.approx(0.0, abs=1e-6) == found.trajectories.value


def test_members_of_one_action_each_are_as_far_apart_as_can_be() -> None:
    """ln K nats: by the mean policy's entropy, by single actions and by trajectories."""
    found = measure_actions(make, [member(1, action=a) for a in (0, 4, 5)], 2, 0)
    assert found is not None
    for figure in (found.entropy, found.actions, found.trajectories):
        assert (figure.value, figure.low, figure.high) == pytest.approx((math.log(3),) * 3, abs=1e-5)
    assert found.own_entropy.value == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("kernel", [0.0, 0.5])
def test_figures_are_the_definitions_on_a_replayed_game(kernel: float) -> None:
    """Three members; the same games again, and every member's network on each of their steps."""
    members = [member(seed) for seed in (1, 2, 3)]
    found = measure_actions(make, members, 2, 5, kernel=kernel)
    env, steps = make(6, 0), []
    play(env, members, np.repeat([0, 1, 2], 2)[:, None].repeat(2, 1), seed=5, record=steps.append)
    log_probs = torch.stack(
        [
            torch.stack([torch.log_softmax(one.logits(torch.from_numpy(env.encode(s.states))), -1) for s in steps])
            for one in members
        ]
    ).detach()  # (K, T, N, P, A)
    mean = log_probs.exp().mean(0)
    entropy = -(mean * mean.log()).sum(-1).mean()
    own = -(log_probs.exp() * log_probs).sum(-1).mean()
    taken = torch.stack([torch.from_numpy(s.actions.astype(np.int64)) for s in steps])
    joint = log_probs.gather(-1, taken[None, ..., None].expand(3, -1, -1, -1, 1)).squeeze(-1).sum(-1)
    ends = torch.arange(HORIZON)[:, None].eq(HORIZON - 1).expand(-1, 2)
    parts = [trajectory_divergence(joint[:, :, 2 * k : 2 * k + 2], k, ends, kernel).mean() for k in range(3)]
    assert found is not None
    assert found.entropy.value == pytest.approx(float(entropy), abs=1e-6)
    assert found.own_entropy.value == pytest.approx(float(own), abs=1e-6)
    assert found.actions.value == pytest.approx(float(entropy - own), abs=1e-6)
    assert found.trajectories.value == pytest.approx(float(sum(parts)) / 3, abs=1e-6)
    assert found.trajectories.low <= found.trajectories.value <= found.trajectories.high


def pairs(*actions: tuple[int, int]) -> Group:
    """Pairs of members of one action each."""
    players = [
        Player("hsp", "here", n, str(n), lambda n=n, a=action: member(n, action=a), role, pair)  # type: ignore[misc]
        for pair, both in enumerate(actions, start=1)
        for n, (action, role) in enumerate(zip(both, ("biased", "partner"), strict=True), start=2 * pair - 1)
    ]
    return Group("hsp", "hsp", tuple(players))


def test_members_of_pairs_play_with_their_mates_and_are_compared_as_pairs() -> None:
    """Biased agents do the same, their partners do not. In every own seat two of four say 0, one 4 and one 5; no two
    joint trajectories are alike, though those of a biased agent alone would be."""
    found = {one.part: one.found for one in measure_groups(make, [pairs((0, 4), (0, 5))], 2, 0)}
    whole, biased, partners = (found[part] for part in ("all", "biased", "partner"))
    assert (whole.members, biased.members) == (4, 2) and whole.steps == 8 * HORIZON
    assert whole.entropy.value == pytest.approx(1.5 * math.log(2), abs=1e-5)
    assert whole.trajectories.value == pytest.approx(math.log(4), abs=1e-5)
    assert whole.share is not None and whole.share.value == pytest.approx(1.0, abs=1e-5)
    assert biased.entropy.value == pytest.approx(0.0, abs=1e-5)
    assert partners.entropy.value == pytest.approx(math.log(2), abs=1e-5)
    assert biased.trajectories.value == partners.trajectories.value == pytest.approx(math.log(2), abs=1e-5)


def test_the_same_pair_twice_is_two_members_of_four() -> None:
    found = {one.part: one.found for one in measure_groups(make, [pairs((0, 4), (0, 4))], 2, 0)}
    assert found["all"].trajectories.value == pytest.approx(math.log(2), abs=1e-5)
    assert found["all"].entropy.value == pytest.approx(math.log(2), abs=1e-5)
    share = found["all"].share
    assert share is not None and (share.low, share.value, share.high) == pytest.approx((0.5,) * 3, abs=1e-5)
    assert found["biased"].trajectories.value == pytest.approx(0.0, abs=1e-5)


def test_one_member_has_no_share() -> None:
    found = measure_actions(make, [member(1)], 2, 0)
    assert found is not None and found.share is None and found.most == 0.0


def test_skills_and_roles_are_measured_on_their_own_and_silent_policies_left_out() -> None:
    parts = ("initial", "final", "initial", "final", "half")
    players = tuple(
        Player("fcp", "here", n, str(n), lambda n=n: member(n), part)  # type: ignore[misc]
        for n, part in enumerate(parts, start=1)
    )
    silent = (Player("random", "here", 1, None, lambda: RandomPolicy(6)),)
    found = measure_groups(make, [Group("fcp", "fcp", players), Group("random", None, silent)], 2, 0)
    assert [(one.group, one.part, one.found.members) for one in found] == [
        ("fcp", "all", 5),
        ("fcp", "initial", 2),
        ("fcp", "final", 2),
    ]
