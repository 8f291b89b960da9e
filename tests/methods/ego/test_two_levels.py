"""The two levels of HiPT against brute force, by hand, and by counting."""

from __future__ import annotations

import numpy as np
import torch
from support.small import kitchen

from popgen.methods.ego.ego_learner import _describe_choices
from popgen.methods.ego.ego_networks import EgoSizes
from popgen.methods.ego.ego_policy import HierarchicalEgoPolicy
from popgen.methods.ego.ego_rollout import Choices
from popgen.methods.ego.two_levels import (
    advantages_of_decisions,
    cut_segments,
    draw_durations,
    influence_of_skill,
    information_of_skill,
    pay_segments,
)


def softmax(logits: np.ndarray) -> np.ndarray:
    weights = np.exp(logits)
    return weights / weights.sum(-1, keepdims=True)


def test_influence_is_the_divergence_from_the_mixture() -> None:
    rng = np.random.default_rng(0)
    high, low, skill = rng.normal(size=(7, 3)), 2 * rng.normal(size=(7, 3, 6)), rng.integers(0, 3, 7)
    got = influence_of_skill(torch.tensor(high), torch.tensor(low), torch.tensor(skill)).numpy()
    for row in range(7):
        p_high, p_low = softmax(high[row]), softmax(low[row])
        mixture = sum(p_high[z] * p_low[z] for z in range(3))
        chosen = p_low[skill[row]]
        assert abs(got[row] - sum(chosen[a] * np.log(chosen[a] / mixture[a]) for a in range(6))) < 1e-9


def test_a_skill_that_changes_nothing_has_no_influence() -> None:
    logits = torch.randn(5, 1, 6).expand(5, 4, 6)
    assert influence_of_skill(torch.randn(5, 4), logits, torch.tensor([0, 1, 2, 3, 0])).abs().max() < 1e-6


def test_information_is_the_mean_influence_and_has_a_gradient_where_skills_differ() -> None:
    generator = torch.Generator().manual_seed(0)
    high = torch.randn(7, 3, generator=generator)
    low = torch.randn(7, 3, 6, generator=generator).requires_grad_()
    got = information_of_skill(high, low)
    by_skill = torch.stack([influence_of_skill(high, low, torch.full((7,), z)) for z in range(3)], -1)
    torch.testing.assert_close(got, (high.softmax(-1) * by_skill).sum(-1))
    before = got.mean()
    before.backward()
    assert low.grad is not None
    assert information_of_skill(high, low.detach() + low.grad).mean() > before


def test_durations_are_even_over_both_ends() -> None:
    drawn = draw_durations(40_000, 20, 39, torch.Generator().manual_seed(0))
    counts = torch.bincount(drawn, minlength=41)
    assert counts[:20].sum() == 0 and counts[40] == 0
    assert ((counts[20:40] - 2000).abs() < 5 * 2000**0.5).all()


DECIDES = np.array([[1, 1], [0, 0], [1, 1], [0, 1], [0, 0]], bool)
FIRST = np.array([[1, 0], [0, 0], [0, 1], [0, 0], [0, 0]], bool)
DONE = np.array([[0, 0], [0, 1], [0, 0], [0, 0], [1, 0]], bool)


def test_segments_by_hand() -> None:
    segments = cut_segments(DECIDES, FIRST, DONE)
    assert segments.row.tolist() == [0, 0, 1, 1, 1]
    assert segments.step.tolist() == [0, 2, 0, 2, 3]
    assert segments.length.tolist() == [2, 3, 2, 1, 2]
    assert segments.first.tolist() == [True, False, False, True, False]
    assert segments.over.tolist() == [False, True, True, False, False]
    assert segments.last.tolist() == [False, False, False, False, True]


def test_segments_are_paid_their_mean_and_as_published_the_first_its_sum() -> None:
    segments = cut_segments(DECIDES, FIRST, DONE)
    reward, influence = np.arange(10.0).reshape(5, 2), np.ones((5, 2))
    paid = pay_segments(segments, reward, influence, weight=0.5)
    assert paid.tolist() == [1.5, 6.5, 2.5, 5.5, 8.5]  # rows 0: 0 2 | 4 6 8; 1: 1 3 | 5 | 7 9; each and 0.5
    published = pay_segments(segments, reward, influence, weight=0.5, sum_first=True)
    assert published.tolist() == [3.0, 6.5, 2.5, 5.5, 8.5]


def test_advantages_over_decisions_equal_the_recursion() -> None:
    rng = np.random.default_rng(3)
    decides = rng.random((30, 4)) < 0.3
    done = rng.random((30, 4)) < 0.1
    first = np.concatenate([rng.random((1, 4)) < 0.5, done[:-1]])
    decides = decides | first
    decides[0] = True
    segments = cut_segments(decides, first, done)
    paid, value, last = rng.normal(size=len(segments.row)), rng.normal(size=len(segments.row)), rng.normal(size=4)
    got = advantages_of_decisions(segments, paid, value, last, discount=0.9, lam=0.7)
    for row in range(4):
        mine = np.flatnonzero(segments.row == row)
        for place, index in enumerate(mine):
            wanted, factor = 0.0, 1.0
            for other in range(place, len(mine)):
                now = mine[other]
                if segments.over[now]:
                    after = 0.0
                elif other + 1 == len(mine):
                    after = last[row]
                else:
                    after = value[mine[other + 1]]
                wanted += factor * (paid[now] + 0.9 * after - value[now])
                if segments.over[now]:
                    break
                factor *= 0.9 * 0.7
            assert abs(got[index] - wanted) < 1e-12


def test_a_skill_is_kept_for_its_duration_and_drawn_anew_in_a_new_episode() -> None:
    env = kitchen(64)
    sizes = EgoSizes(units=8, head_units=4, skills=3)
    policy = HierarchicalEgoPolicy(sizes, env.spec, duration_least=3, duration_most=5)
    policy.reset(64, 0)
    obs, previous, changed = env.observe(), np.zeros((64, 2), np.uint8), []
    before = None
    for step in range(9):
        first = np.full(64, step in (0, 7))
        policy.act(obs, previous, first)
        memory = policy.memory()
        changed.append(0 if before is None else int((memory["skill"] != before).sum()))
        assert memory["left"].min() >= 0 and memory["left"].max() <= 4
        if step in (0, 7):
            assert set(memory["left"]) == {2, 3, 4}  # after its first step
        before = memory["skill"]
    assert changed[1] == changed[2] == 0 < changed[3] and changed[7] > 64 and changed[8] == 0


def test_a_z_that_is_never_chosen_is_the_one_that_is_chosen_least() -> None:
    """Four zs of which two are drawn, one three times as often: the last ones count too."""
    skill = torch.tensor([[0, 0, 0, 1]])
    nothing = torch.zeros(1, 4)
    found = _describe_choices(Choices(skill, torch.ones(1, 4, dtype=torch.bool), nothing, nothing), 4, 0.0, 0.0)
    assert (found["skill_least"], found["skill_most"]) == (0.0, 0.75)
