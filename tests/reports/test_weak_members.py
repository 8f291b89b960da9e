"""Who does not play, on figures by hand."""

from __future__ import annotations

import math
from typing import Any

import pytest

from popgen.population.manifest import MemberInfo
from popgen.reports.weak_members import find_weak_members, list_weak_members


def pairing(seat_0: int | str, seat_1: int | str, score: float, error: float = 0.1) -> dict[str, Any]:
    known = None if math.isnan(error) else error
    return {"seat_0": str(seat_0), "seat_1": str(seat_1), "score": {"mean": score, "standard_error": known}}


def scores_of(*own: float, error: float = 0.1, beside_random: float = -100.0) -> dict[str, Any]:
    """Of members with this self-play, and with this score beside a random partner."""
    members = range(1, len(own) + 1)
    pairs = [pairing(member, member, score, error) for member, score in zip(members, own, strict=True)]
    pairs += [pairing(*seats, beside_random, error) for m in members for seats in ((m, "random"), ("random", m))]
    return {"members": list(members), "unit": "dishes", "pairs": pairs}


def weak(*own: float, target: float = 0.0, share: float = 0.25, error: float = 0.1) -> list[tuple[int, str]]:
    targets = dict.fromkeys(range(1, len(own) + 1), target)
    return [(one.member, one.what) for one in find_weak_members(scores_of(*own, error=error), targets, share)]


def test_a_member_far_below_the_others_is_named() -> None:
    assert weak(10.0, 0.0, 9.0, 11.0) == [(2, "other members")]
    assert weak(10.0, 2.4, 9.0, 11.0) == []  # 2.4 + two standard errors are 2.6, a quarter of 10 is 2.5
    assert weak(10.0, 0.0) == []  # one other member is no measure


def test_a_member_far_below_its_target_is_named_even_alone() -> None:
    assert weak(0.5, target=10.0) == [(1, "target")] and weak(2.5, target=10.0) == []
    assert weak(0.0, 0.0, 0.0, target=10.0) == [(1, "target"), (2, "target"), (3, "target")]
    assert weak(9.0, 9.0, 9.0, target=1000.0) == []  # a target that nobody is meant to reach


def test_figures_that_are_uncertain_or_have_no_scale_name_nobody() -> None:
    assert weak(0.0, target=10.0, error=1.3) == [] and weak(0.0, target=10.0, error=float("nan")) == [(1, "target")]
    assert weak(-50.0, -1.0, -2.0, -1.5) == [] and weak(0.0, target=10.0, share=0.0) == []


def test_members_that_all_stand_still_are_no_better_than_with_a_random_partner() -> None:
    """No target, and no other member that plays: each has nothing, alone and beside a random partner."""
    still = find_weak_members(scores_of(0.0, 0.0, beside_random=0.0), {}, 0.25)
    assert [(one.member, one.what, one.aim) for one in still] == [
        (1, "random partner", 0.0),
        (2, "random partner", 0.0),
    ]
    told = "member 1 does not play: self-play 0.00 dishes is no better than with a random partner, 0.00"
    assert still[0].describe("dishes") == told
    # Penalties have no scale, but an order.
    for score, beside, names in ((0.2, 0.2, [1]), (0.3, 0.2, []), (-9.0, -9.5, []), (-9.0, -8.0, [1])):
        found = find_weak_members(scores_of(score, beside_random=beside), {}, 0.25)
        assert [one.member for one in found] == names
    assert find_weak_members(scores_of(0.0, beside_random=0.0), {}, 0.0) == []


def test_one_of_a_pair_is_measured_by_its_play_with_its_mate() -> None:
    """Alone they serve nothing; the second pair serves little together."""
    table = {(1, 2): 9.0, (2, 1): 11.0, (3, 4): 1.0, (4, 3): 1.0}
    alone = scores_of(*[0.0] * 4)
    pairs = [*alone["pairs"], *(pairing(*seats, score) for seats, score in table.items())]
    found = find_weak_members({**alone, "pairs": pairs, "mates": [2, 1, 4, 3]}, {}, 0.25)
    assert [(one.member, one.aim, one.sp.mean) for one in found] == [(3, 10.0, 1.0), (4, 10.0, 1.0)]


def test_a_weak_member_is_told_in_a_line() -> None:
    (found,) = find_weak_members(scores_of(0.5), {1: 10.0}, 0.25)
    line = "member 1 does not play: self-play 0.50 dishes is below 25% of its target, 10.00"
    assert found.describe("dishes") == line and found.sp.mean == pytest.approx(0.5)


def test_who_is_not_meant_to_play_with_itself_is_not_named() -> None:
    """A half trained copy, an ego with partners, and one of a pair that is kept alone; an ego of self-play is meant to,
    and so are the last two, a pair."""
    taught = [{"method": "mappo"}]
    extras = [{"skill": "half"}, {"trained_with": taught}, {"role": "biased", "pair": 1}, {"trained_with": []}]
    extras += [{"role": role, "pair": 2} for role in ("biased", "partner")]
    infos = [MemberInfo.model_construct(id=member, extra=extra) for member, extra in enumerate(extras, 1)]
    still = scores_of(*[0.0] * 6, beside_random=0.0)
    pairs = [*still["pairs"], pairing(5, 6, 0.0), pairing(6, 5, 0.0)]
    found = list_weak_members(infos, {**still, "pairs": pairs, "mates": [1, 2, 3, 4, 6, 5]}, 0.25)
    assert [one.member for one in found] == [4, 5, 6]
