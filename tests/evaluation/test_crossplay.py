from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.scripted import HORIZON, ONE, STAY, TWO, Cast, Script

from popgen.errors import UserError
from popgen.evaluation.crossplay import CrossPlayResult, Obstruction, Pairing, evaluate_population
from popgen.evaluation.estimates import Estimate
from popgen.population import load_population


def pairing(row: str, column: str, mean: float, error: float = 0.1) -> Pairing:
    figure = Estimate(mean, error)
    return Pairing((row, column), np.array([mean]), figure, figure, figure, np.zeros((2, 2)))


def result(scores: dict[tuple[str, str], float], members: tuple[int, ...], error: float = 0.1) -> CrossPlayResult:
    base = evaluate_population(Cast(Script([STAY])), 1, 0)  # type: ignore[arg-type]
    pairings = {key: pairing(*key, mean, error) for key, mean in scores.items()}
    return replace(base, members=members, pairings=pairings, episodes=20)


def test_estimate_by_hand() -> None:
    figure = Estimate.of(np.array([1.0, 2.0, 3.0, 6.0]))
    # mean 3, squared deviations 4 + 1 + 0 + 9 = 14, s^2 = 14 / 3, error = sqrt(14 / 3 / 4)
    assert figure.mean == 3.0 and figure.error == pytest.approx(math.sqrt(14 / 12))
    assert Estimate.of(np.array([5.0])).mean == 5.0 and math.isnan(Estimate.of(np.array([5.0])).error)
    assert math.isnan(Estimate.of(np.array([])).mean)


def test_average_by_hand() -> None:
    average = Estimate.average([Estimate(1.0, 0.3), Estimate(3.0, 0.4)])
    assert average.mean == 2.0 and average.error == pytest.approx(0.25)
    assert math.isnan(Estimate.average([]).mean)


def test_below_needs_two_standard_errors_of_the_difference() -> None:
    # sqrt(0.3^2 + 0.4^2) = 0.5, so the difference must exceed 1
    assert Estimate(0.0, 0.3).below(Estimate(1.01, 0.4))
    assert not Estimate(0.0, 0.3).below(Estimate(0.99, 0.4))
    assert not Estimate(0.0, math.nan).below(Estimate(9.0, 0.4))  # one episode: nothing to judge by
    assert not Estimate(0.0, 0.1).below(Estimate(9.0, math.nan))
    assert not Estimate(math.nan, 0.1).below(Estimate(1.0, 0.1))
    assert not Estimate(0.0, 0.1).below(Estimate(math.nan, math.nan))


def test_rows_are_seat_0_and_columns_seat_1() -> None:
    got = evaluate_population(Cast(Script([ONE]), Script([TWO, STAY])), 4, 0)  # type: ignore[arg-type]
    mean, error = got.to_frame("mean"), got.to_frame("error")
    # Per episode both give 6 points in seat 0 and 60 in seat 1: `two` is worth double but played half as often.
    np.testing.assert_array_equal(mean, [[66, 66], [66, 66]])
    np.testing.assert_array_equal(error, 0)
    assert got.score(1, 2).mean == 66 and got.score(1, "idle").mean == 6 and got.score("idle", 1).mean == 60
    np.testing.assert_array_equal(got.pairings["1", "2"].events, [[6, 0], [0, 3]])
    np.testing.assert_array_equal(got.pairings["2", "1"].events, [[0, 3], [6, 0]])
    assert got.pairings["1", "2"].reward.mean == 132 and got.pairings["1", "2"].shaped.mean == 6 + 15
    assert got.beside("idle", 1).mean == 6 and got.beside("idle", 0).mean == 60 and got.beside("idle").mean == 33
    assert 6 <= got.score(1, "random").mean <= 126 and got.score(1, "random").error > 0
    assert len(got.pairings) == 2 * 2 + 2 * 2 * 2
    assert got.steps == (12 * 4 + got.mixed_episodes) * HORIZON and got.mixed_episodes == (2 + 4) * 2


@pytest.mark.parametrize("members", [1, 2, 3])
def test_progress_counts_every_episode_of_mixed_play_too(members: int) -> None:
    told: list[tuple[int, int]] = []
    cast = Cast(*[Script([ONE]) for _ in range(members)])
    got = evaluate_population(cast, 3, 0, max_envs=8, progress=lambda *at: told.append(at))  # type: ignore[arg-type]
    assert told == sorted(told) and {total for _, total in told} == {got.count_episodes()}
    assert told[-1][0] == got.count_episodes()


def test_the_frame_names_its_seats_and_can_hold_the_partners() -> None:
    got = evaluate_population(Cast(Script([ONE]), Script([TWO, STAY])), 4, 0)  # type: ignore[arg-type]
    frame = got.to_frame(labels=(2, "idle"))
    assert (frame.index.name, frame.columns.name) == ("seat_0", "seat_1")
    assert frame.loc["2", "2"] == 66 and frame.loc["2", "idle"] == 6 and math.isnan(frame.loc["idle", "idle"])


def test_unequal_seats_and_means() -> None:
    asymmetric = Script([ONE], [STAY])
    got = evaluate_population(Cast(asymmetric, Script([TWO])), 2, 0)  # type: ignore[arg-type]
    np.testing.assert_array_equal(got.to_frame(), [[6, 126], [12, 132]])
    assert got.sp.mean == (6 + 132) / 2 and got.xp.mean == (126 + 12) / 2


def test_mean_xp_is_over_ordered_pairs() -> None:
    scores = {(str(i), str(j)): 10.0 * i + j for i in (1, 2, 3) for j in (1, 2, 3)}
    got = result(scores, (1, 2, 3), error=0.6)
    assert got.sp.mean == pytest.approx((11 + 22 + 33) / 3)
    assert got.xp.mean == pytest.approx((12 + 13 + 21 + 23 + 31 + 32) / 6)
    assert got.sp.error == pytest.approx(0.6 / math.sqrt(3)) and got.xp.error == pytest.approx(0.6 / math.sqrt(6))


PAIRED = [[0, 9, 0, 0], [9, 0, 4.15, 0], [0, 3.85, 0, 11], [0, 0, 10.95, 0]]
"""Dishes of two pairs of HSP in the cramped room, row: the member in seat 0."""


def test_the_own_play_of_a_pair_is_play_with_the_mate_and_cross_play_is_across_pairs() -> None:
    table = {(str(i + 1), str(j + 1)): float(PAIRED[i][j]) for i in range(4) for j in range(4)}
    got = replace(result(table, (1, 2, 3, 4), error=0.2), mates={1: 2, 2: 1, 3: 4, 4: 3})
    assert got.is_paired and got.sp.mean == pytest.approx((9 + 9 + 11 + 10.95) / 4)
    assert got.sp.error == pytest.approx(0.2 / 2)
    assert len(got.crossed) == 8 and got.xp.mean == pytest.approx(8.0 / 8)
    assert [got.own_play(m).mean for m in got.members] == pytest.approx([9, 9, 10.975, 10.975])
    alone = replace(got, mates={})
    assert not alone.is_paired and alone.sp.mean == 0.0 and alone.xp.mean == pytest.approx(47.95 / 12)


def test_mates_are_compared_with_nobody_and_one_whose_mate_is_left_out_has_no_own_play() -> None:
    table = {(str(i + 1), str(j + 1)): float(PAIRED[i][j]) for i in range(4) for j in range(4)}
    for partner in ("random", "idle"):
        for member in "1234":
            table[member, partner] = table[partner, member] = 20.0
    got = replace(result(table, (1, 2, 3, 4)), mates={1: 2, 2: 1, 3: 4, 4: 3})
    assert len(got.comparisons) == 8 * 4 and {one.pair for one in got.obstructions} == set(got.crossed)
    few = replace(got, members=(1, 2, 3), mates={1: 2, 2: 1, 3: 4})
    assert few.sp.mean == 9.0 and few.crossed == [(1, 3), (2, 3), (3, 1), (3, 2)]
    assert math.isnan(replace(got, members=(3,), mates={3: 4}).sp.mean)
    assert math.isnan(replace(got, members=(1, 2), mates={1: 2, 2: 1}).xp.mean)


def test_members_of_pairs_are_evaluated_with_their_mates_and_without_mixed_play() -> None:
    """ONE beside TWO makes 21 a step, TWO beside ONE 12; members that stay make nothing."""
    cast = Cast(Script([ONE]), Script([TWO]), Script([STAY]), Script([STAY]), pairs=(7, 7, 5, 5))
    got = evaluate_population(cast, 2, 0)  # type: ignore[arg-type]
    assert got.mates == {1: 2, 2: 1, 3: 4, 4: 3} and got.mixed == () and got.mixed_episodes == 0
    assert got.own_play(1).mean == 6 * (21 + 12) / 2 and got.sp.mean == 6 * (21 + 12) / 4
    assert got.xp.mean == 6 * 2 * (1 + 10 + 2 + 20) / 8
    some = evaluate_population(cast, 2, 0, [1, 3])  # type: ignore[arg-type]
    assert some.mates == {1: 2, 3: 4} and math.isnan(some.sp.mean) and math.isnan(some.own_play(1).mean)
    assert some.xp.mean == 6 * (1 + 10) / 2


def test_one_member_has_no_xp() -> None:
    got = evaluate_population(Cast(Script([ONE])), 1, 0)  # type: ignore[arg-type]
    assert got.sp.mean == 66 and math.isnan(got.xp.mean) and math.isnan(got.sp.error)
    assert got.obstructions == () and got.obstruction == {"random": False, "idle": False}


def scores(xp: float, random: float, idle: float) -> dict[tuple[str, str], float]:
    table = {("1", "1"): 10.0, ("2", "2"): 10.0, ("1", "2"): xp, ("2", "1"): 5.0}
    for partner, score in (("random", random), ("idle", idle)):
        for member in ("1", "2"):
            table[member, partner] = table[partner, member] = score
    return table


def test_obstruction_is_xp_below_play_with_a_random_or_idle_partner() -> None:
    assert result(scores(xp=1.0, random=1.2, idle=0.0), (1, 2)).obstructions == ()  # within two errors
    got = result(scores(xp=1.0, random=2.0, idle=0.0), (1, 2))
    xp, beside = Estimate(1.0, 0.1), Estimate(2.0, 0.1)
    p = 8 * xp.chance_below(beside, 20)  # of eight comparisons; the second least counts no less than the least
    assert 0 < p < 1e-6
    assert got.obstructions == tuple(Obstruction((1, 2), "random", member, xp, beside, p) for member in (1, 2))
    assert got.obstruction == {"random": False, "idle": False}  # mean XP is 3
    assert result(scores(xp=1.0, random=3.5, idle=3.4), (1, 2)).obstruction == {"random": True, "idle": True}
    assert result(scores(xp=1.0, random=2.0, idle=3.4), (1, 2)).obstruction == {"random": False, "idle": True}


def test_each_member_is_compared_in_its_own_seat() -> None:
    table = scores(xp=1.0, random=0.0, idle=0.0)
    table["random", "2"] = 4.0  # member 2 in seat 1 does better with a random partner in seat 0
    table["random", "1"] = table["2", "random"] = 4.9  # the seats that (1, 2) does not have
    (found,) = result(table, (1, 2)).obstructions
    assert (found.pair, found.partner, found.member, found.beside.mean) == ((1, 2), "random", 2, 4.0)


def test_same_seed_same_result_and_chosen_members(random_population: Path) -> None:
    population = load_population(random_population)
    first, again = (evaluate_population(population, 3, 5) for _ in range(2))
    for key, one in first.pairings.items():
        np.testing.assert_array_equal(one.events, again.pairings[key].events)
    assert any(
        (p.events != evaluate_population(population, 3, 6).pairings[k].events).any() for k, p in first.pairings.items()
    )
    chosen = evaluate_population(population, 3, 5, [2])
    assert chosen.members == (2,) and set(chosen.pairings) == {
        ("2", "2"), ("2", "random"), ("random", "2"), ("2", "idle"), ("idle", "2")
    }  # fmt: skip


@pytest.mark.parametrize(
    ("members", "episodes", "told"),
    [
        ([3], 1, "no member 3"),
        ([0], 1, "no member 0"),
        ([1, 1], 1, "different"),
        ([], 1, "different"),
        (None, 0, "at least 1"),
    ],
)
def test_bad_requests(random_population: Path, members: list[int] | None, episodes: int, told: str) -> None:
    with pytest.raises(UserError, match=told):
        evaluate_population(load_population(random_population), episodes, 0, members)


def test_an_empty_population_cannot_be_evaluated() -> None:
    with pytest.raises(UserError, match="has no members yet"):
        evaluate_population(Cast(), 1, 0)  # type: ignore[arg-type]
