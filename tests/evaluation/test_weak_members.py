"""Who does not play, on figures by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from popgen.evaluation.crossplay import CrossPlayResult, Estimate, Pairing
from popgen.evaluation.weak_members import find_weak_members, list_weak_members
from popgen.population.manifest import EnvironmentInfo, MemberInfo


def pairing(seat_0: str, seat_1: str, score: float, error: float) -> Pairing:
    known = Estimate(0.0, 0.0)
    return Pairing((seat_0, seat_1), np.zeros(1), Estimate(score, error), known, known, np.zeros((2, 0)))


def result(*scores: float, error: float = 0.1, beside_random: float = -100.0) -> CrossPlayResult:
    """Members with this self-play, and with this score beside a random partner."""
    names = [str(member) for member in range(1, len(scores) + 1)]
    own = [pairing(name, name, score, error) for name, score in zip(names, scores, strict=True)]
    beside = [pairing(*seats, beside_random, error) for m in names for seats in ((m, "random"), ("random", m))]
    pairings = {one.seats: one for one in own + beside}
    info = EnvironmentInfo.model_construct(name="overcooked/cramped_room")
    return CrossPlayResult(info, "any", (), (), tuple(range(1, len(scores) + 1)), 5, 0, 0, 0, pairings)


def weak(*scores: float, target: float = 0.0, share: float = 0.25, error: float = 0.1) -> list[tuple[int, str]]:
    targets = dict.fromkeys(range(1, len(scores) + 1), target)
    return [(one.member, one.what) for one in find_weak_members(result(*scores, error=error), targets, share)]


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
    still = find_weak_members(result(0.0, 0.0, beside_random=0.0), {}, 0.25)
    assert [(one.member, one.what, one.aim) for one in still] == [
        (1, "random partner", 0.0),
        (2, "random partner", 0.0),
    ]
    told = "member 1 does not play: self-play 0.00 dishes is no better than with a random partner, 0.00"
    assert still[0].describe("dishes") == told
    # Penalties have no scale, but an order.
    for score, beside, names in ((0.2, 0.2, [1]), (0.3, 0.2, []), (-9.0, -9.5, []), (-9.0, -8.0, [1])):
        found = find_weak_members(result(score, beside_random=beside), {}, 0.25)
        assert [one.member for one in found] == names
    assert find_weak_members(result(0.0, beside_random=0.0), {}, 0.0) == []


def test_one_of_a_pair_is_measured_by_its_play_with_its_mate() -> None:
    """Alone they serve nothing; the second pair serves little together."""
    table = {("1", "2"): 9.0, ("2", "1"): 11.0, ("3", "4"): 1.0, ("4", "3"): 1.0}
    known = Estimate(0.0, 0.0)
    played = {seats: replace(one, score=known) for seats, one in result(*[0.0] * 4).pairings.items()}
    played |= {seats: one for seats, one in result(*[0.0] * 4).pairings.items() if "random" in seats}
    played |= {seats: pairing(*seats, score, 0.1) for seats, score in table.items()}
    pairs = replace(result(*[0.0] * 4), pairings=played, mates={1: 2, 2: 1, 3: 4, 4: 3})
    found = find_weak_members(pairs, {}, 0.25)
    assert [(one.member, one.aim, one.sp.mean) for one in found] == [(3, 10.0, 1.0), (4, 10.0, 1.0)]


def test_a_weak_member_is_told_in_a_line() -> None:
    (found,) = find_weak_members(result(0.5), {1: 10.0}, 0.25)
    line = "member 1 does not play: self-play 0.50 dishes is below 25% of its target, 10.00"
    assert found.describe("dishes") == line and found.sp.mean == pytest.approx(0.5)


def test_who_is_not_meant_to_play_with_itself_is_not_named() -> None:
    """A half trained copy, an ego with partners, and one of a pair that is kept alone; an ego of self-play is meant to,
    and so are the last two, a pair."""
    taught = [{"method": "mappo"}]
    extras = [{"skill": "half"}, {"trained_with": taught}, {"role": "biased", "pair": 1}, {"trained_with": []}]
    extras += [{"role": role, "pair": 2} for role in ("biased", "partner")]
    infos = [MemberInfo.model_construct(id=member, extra=extra) for member, extra in enumerate(extras, 1)]
    still = result(*[0.0] * 6, beside_random=0.0)
    mates = {("5", "6"), ("6", "5")}
    pairs = replace(
        still, pairings=still.pairings | {seats: pairing(*seats, 0.0, 0.1) for seats in mates}, mates={5: 6, 6: 5}
    )
    assert [one.member for one in list_weak_members(infos, pairs, 0.25)] == [4, 5, 6]
