"""Who does not play, on figures by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from popgen.evaluation.crossplay import CrossPlayResult, Estimate, Pairing
from popgen.evaluation.weak_members import find_weak_members
from popgen.population.manifest import EnvironmentInfo


def result(*scores: float, error: float = 0.1) -> CrossPlayResult:
    """Members with this self-play."""
    known = Estimate(0.0, 0.0)
    pairings = {
        (str(m), str(m)): Pairing((str(m), str(m)), np.zeros(1), Estimate(score, error), known, known, np.zeros((2, 0)))
        for m, score in enumerate(scores, 1)
    }
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


def test_one_of_a_pair_is_measured_by_its_play_with_its_mate() -> None:
    """Alone they serve nothing; the second pair serves little together."""
    table = {("1", "2"): 9.0, ("2", "1"): 11.0, ("3", "4"): 1.0, ("4", "3"): 1.0}
    known = Estimate(0.0, 0.0)
    played = {seats: replace(one, score=known) for seats, one in result(*[0.0] * 4).pairings.items()}
    for seats, score in table.items():
        played[seats] = Pairing(seats, np.zeros(1), Estimate(score, 0.1), known, known, np.zeros((2, 0)))
    pairs = replace(result(*[0.0] * 4), pairings=played, mates={1: 2, 2: 1, 3: 4, 4: 3})
    found = find_weak_members(pairs, {}, 0.25)
    assert [(one.member, one.aim, one.sp.mean) for one in found] == [(3, 10.0, 1.0), (4, 10.0, 1.0)]


def test_a_weak_member_is_told_in_a_line() -> None:
    (found,) = find_weak_members(result(0.5), {1: 10.0}, 0.25)
    line = "member 1 does not play: self-play 0.50 dishes is below 25% of its target, 10.00"
    assert found.describe("dishes") == line and found.sp.mean == pytest.approx(0.5)
