"""The constraint on cross-play: multipliers by hand, and what they do to the objective."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from popgen.losses.policy_losses import bound_advantage, next_multiplier
from popgen.play.partner_strength import PartnerConstraint


@pytest.mark.parametrize(
    ("now", "cross", "own", "expected"),
    [
        (0.5, 40.0, 40.0, 1.0),  # as good as self-play: a whole step up
        (0.2, -10.0, 40.0, 0.45),  # half of the way from the limit to self-play: half a step
        (0.5, -110.0, 40.0, 0.25),  # as far below the limit: half a step down
        (0.1, -200.0, 40.0, 0.0),  # never below 0
        (0.9, 40.0, 40.0, 1.0),  # nor above 1
        (0.7, -200.0, -60.0, 0.7),  # no convention yet
    ],
)
def test_multipliers_by_hand(now: float, cross: float, own: float, expected: float) -> None:
    assert next_multiplier(now, cross, own, limit=-60.0, step=0.5) == pytest.approx(expected)


def test_each_partner_has_its_own_and_the_pressure_is_whole_until_it_is_met() -> None:
    constraint = PartnerConstraint(-60.0, 0.5)
    constraint.add({1: -160.0}, None)  # self-play is not known yet
    assert [constraint.multiplier(k) for k in (1, 2)] == [1.0, 1.0]
    for _ in range(2):
        constraint.add({1: -110.0}, 40.0)
    assert [constraint.multiplier(k) for k in (1, 2)] == [0.5, 1.0]
    again = PartnerConstraint(-60.0, 0.5)
    again.load_state(constraint.state())
    assert again.multipliers == constraint.multipliers == {1: 0.5}


def test_without_a_limit_there_is_no_constraint() -> None:
    constraint = PartnerConstraint(None, 0.5)
    constraint.add({1: -1000.0}, 40.0)
    assert constraint.multiplier(1) == 1.0 and constraint.state() == {}


def test_bounds_are_in_units_of_self_plays_spread() -> None:
    given = torch.tensor([-172.0, -0.1, 0.3, 5.0])
    bounded = bound_advantage(given, clip=1.5, unit=0.4)
    torch.testing.assert_close(bounded, torch.tensor([-0.6, -0.1, 0.3, 0.6]))
    assert bound_advantage(given, clip=0.0, unit=torch.tensor(0.4)).tolist() == given.tolist()


def test_partners_are_drawn_in_proportion_and_get_the_largest_multiplier() -> None:
    constraint, rng = PartnerConstraint(-60.0, 0.5), np.random.default_rng(0)
    constraint.multipliers = {1: 0.75, 2: 0.0, 3: 0.25}
    drawn = np.bincount([constraint.draw_partner([1, 2, 3], rng) for _ in range(4000)], minlength=4) / 4000
    np.testing.assert_allclose(drawn, [0.0, 0.75, 0.0, 0.25], atol=0.03)
    assert constraint.pressure([1, 2, 3]) == 0.75 and constraint.pressure([1, 2, 3, 4]) == 1.0
    constraint.multipliers = {1: 0.0, 2: 0.0}
    assert {constraint.draw_partner([1, 2], rng) for _ in range(50)} == {1, 2} and constraint.pressure([1, 2]) == 0.0
