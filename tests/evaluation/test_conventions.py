"""Conventions: effects by hand, their size without an effect, intervals with a known one, coverage, recorded people."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.small import kitchen

from popgen.cli.parser import parse
from popgen.envs import BatchedEnv
from popgen.envs.overcooked.transition_events import EVENTS
from popgen.errors import UserError
from popgen.evaluation.convention_coverage import measure_coverage
from popgen.evaluation.convention_effects import (
    BEHAVIOURS,
    Effect,
    Samples,
    collect_samples,
    correct_by_holm,
    measure_effects,
    tabulate_effects,
)
from popgen.evaluation.played_games import PlayedGame, count_members, count_people, count_table_games
from popgen.humans.record_tables import TableGame
from popgen.humans.recordings import load_games
from popgen.policies.simple_policies import RandomPolicy
from popgen.reports.conventions_report import PlayersReport, effects_table, to_sentences, write_conventions

PLATING, WALK = EVENTS.index("take_soup_from_pot"), EVENTS.index("walk")


def game(platings: tuple[float, float], dishes: float, who: str, layout: str = "room", steps: int = 400) -> PlayedGame:
    counts = np.zeros((2, len(EVENTS)))
    counts[:, PLATING] = platings
    return PlayedGame(layout, (who, who), steps, dishes, counts)


def test_rates_are_counts_in_400_steps() -> None:
    one = game((6.0, 3.0), 9.0, "a", steps=1200)
    assert one.rates[:, PLATING].tolist() == [2.0, 1.0] and one.dish_rate == 3.0


def test_shares_of_what_both_did() -> None:
    samples = collect_samples([game((6.0, 2.0), 8.0, "a"), game((0.0, 0.0), 0.0, "b")], shares=True)
    assert samples.values[:, 0].tolist() == [0.75, 0.25, 0.5, 0.5] and samples.dishes.tolist() == [8.0, 8.0, 0.0, 0.0]


def test_groups_and_effects_by_hand() -> None:
    """Values 0, 1, 2, 3 of four participants: mean 1.5, SD sqrt(1.25); half an SD away are 0 (1.5 away) and 1 (0.5 is
    not: 0.559 is wanted), so that low is {0} and high {3}, each of one participant, which has no interval; at 0.4 SD
    low is {0, 1} with dishes 0 and 2 against 3 for all."""
    samples = Samples(np.array([[0.0], [1.0], [2.0], [3.0]]), np.array([0.0, 2.0, 4.0, 6.0]), np.arange(4), np.zeros(4))
    high, low = measure_effects(samples, ["it"], 0.5)
    assert (high.size, low.size) == (1, 1) and math.isnan(high.effect) and math.isnan(low.p)
    high, low = measure_effects(samples, ["it"], 0.4)
    assert (high.effect, low.effect) == (2.0, -2.0) and high.size == low.size == 2
    influence = np.array([-1 / 2 + 3 / 4, 1 / 2 + 1 / 4, -1 / 4, -3 / 4])
    error = math.sqrt(4 / 3 * (influence**2).sum())
    assert low.high - low.effect == pytest.approx(12.706205 * error, rel=1e-6)  # Student's t of one degree of freedom


def test_within_strata_a_layout_with_more_to_do_is_no_behaviour() -> None:
    """Ten dishes and platings in one layout, two in the other, whoever plays: pooled an effect, within none."""
    games = [game((n + i, n + i), float(n), f"{i}", layout) for i in range(8) for layout, n in (("a", 10), ("b", 2))]
    pooled = tabulate_effects(games, 0.5, pooled=True)[0]
    within = tabulate_effects(games, 0.5)[0]
    assert pooled.effect == pytest.approx(4.0) and within.effect == pytest.approx(0.0, abs=1e-12)


def test_holms_correction_by_hand() -> None:
    def one(p: float) -> Effect:
        return Effect("it", "high", 5, 5, 1.0, 0.0, 2.0, p)

    corrected = correct_by_holm([one(0.04), one(0.01), one(float("nan")), one(0.03)])
    assert [e.p_holm for e in corrected[:2]] == pytest.approx([0.06, 0.03])
    assert math.isnan(corrected[2].p_holm) and corrected[3].p_holm == pytest.approx(0.06)
    assert [e.significant for e in corrected] == [False, True, False, False]


def simulate(rng: np.random.Generator, slope: float, participants: int = 40, games: int = 20) -> Samples:
    """Dishes with a participant's own level; behaviour likewise; `slope` dishes for each unit of behaviour."""
    count = participants * games
    clusters = np.repeat(np.arange(participants), games)
    values = rng.normal(size=(count, 3)) + rng.normal(size=(participants, 3))[clusters]
    dishes = rng.normal(size=count) + rng.normal(size=participants)[clusters] + slope * values[:, 0]
    return Samples(values, dishes, clusters, np.zeros(count, int))


def test_without_an_effect_few_cells_are_significant_and_intervals_hold_a_known_one() -> None:
    rng = np.random.default_rng(0)
    found, cells, held, runs = 0, 0, 0, 300
    # Behaviour has variance 2; beyond t = half an SD its mean is phi(0.5) / (1 - Phi(0.5)) SD.
    expected = (
        0.7 * math.sqrt(2.0) * (math.exp(-0.125) / math.sqrt(2 * math.pi)) / (0.5 * math.erfc(0.5 / math.sqrt(2)))
    )
    for _ in range(runs):
        effects = correct_by_holm(measure_effects(simulate(rng, 0.0), list(BEHAVIOURS), 0.5))
        found, cells = found + sum(effect.significant for effect in effects), cells + len(effects)
        known = measure_effects(simulate(rng, 0.7), list(BEHAVIOURS), 0.5)[0]
        held += known.low <= expected <= known.high
    assert found / cells <= 0.05
    assert held / runs >= 0.93


def test_coverage_by_hand() -> None:
    """People at two points, a member at one of them and one far away; what nobody varies does not count."""
    people = [game((0.0, 0.0), 0.0, "a"), game((4.0, 4.0), 0.0, "b"), game((4.0, 4.0), 0.0, "c")]
    near = measure_coverage(people, [game((4.0, 4.0), 0.0, "m")], seed=0)
    far = measure_coverage(people, [game((4.0 + 3 * 1.8856180, 4.0 + 3 * 1.8856180), 0.0, "m")], seed=0)
    assert near.nearest == 0.0 and near.people == 6 and near.members == 2
    assert far.nearest == pytest.approx(3.0, rel=1e-6)  # in SD of 0, 4, 4
    assert near.average == pytest.approx((4.0 - 8.0 / 3.0) / 1.8856180, rel=1e-6)


def test_what_goes_together_is_lost_by_shuffling() -> None:
    """People either plate or walk; members do just that, and are far from people who are made up of both."""
    rng = np.random.default_rng(1)

    def one(who: str, plates: bool) -> PlayedGame:
        made = game((0.0, 0.0), 0.0, who)
        made.counts[:, PLATING], made.counts[:, WALK] = (10.0, 0.0) if plates else (0.0, 100.0)
        made.counts[:, [PLATING, WALK]] += rng.uniform(0, 0.5, (2, 2))
        return made

    people = [one(f"p{i}", i % 2 == 0) for i in range(20)]
    coverage = measure_coverage(people, [one("m1", True), one("m2", False)], seed=0)
    assert coverage.nearest < 0.5 * coverage.shuffled and coverage.nearest < coverage.average


def test_recorded_people_in_the_cramped_room() -> None:
    """The research notes' table: 16 games, 2.96 platings and 9.27 onions a player, 5.92 dishes, in 400 steps."""
    games = count_people(load_games(layouts=["cramped_room"]))
    rates = np.concatenate([one.rates for one in games])
    assert len(games) == 16
    assert round(float(rates[:, PLATING].mean()), 2) == 2.96
    assert round(float(rates[:, EVENTS.index("take_onion_from_dispenser")].mean()), 2) == 9.27
    assert round(float(np.mean([one.dish_rate for one in games])), 2) == 5.92


def test_the_report_is_readable_and_complete(tmp_path) -> None:  # type: ignore[no-untyped-def]
    games = [game((i + 1.0, 1.0), float(i), f"p{i}") for i in range(6)]
    within = tabulate_effects(games, 0.5)
    report = PlayersReport("people [x]", 6, within, tabulate_effects(games, 0.5, pooled=True), {})
    files = write_conventions([report], tmp_path / "out")
    assert [file.name for file in files] == ["conventions.json", "effects.csv"]
    assert len(files[1].read_text().splitlines()) == 1 + 2 * len(within) == 1 + 2 * 9
    assert effects_table(report).row_count == 9 and to_sentences([report])[0].startswith("people [x]: ")


def test_a_threshold_is_a_number_above_zero() -> None:
    with pytest.raises(UserError, match="threshold"):
        parse(["conventions", "--threshold", "0"])


def test_two_people_are_one_participant_whoever_has_which_seat() -> None:
    env = kitchen(horizon=4)
    states, nothing = env.get_state().repeat(4, 0), np.full((4, 2), 4, np.uint8)
    tables = [
        TableGame(env, "room", trial, players, (True, True), states, nothing, np.zeros(4))
        for trial, players in (("1", ("ann", "bob")), ("2", ("bob", "ann")), ("3", ("bob", "cid")))
    ]
    samples = collect_samples(count_table_games(tables)["people"])
    assert samples.clusters.tolist() == [0, 0, 0, 0, 1, 1]


class Kitchen:
    """As much of a population as counting needs: each member takes one action for 20 steps."""

    path = "kitchen"

    def __init__(self, *actions: str, pairs: tuple[int, ...]) -> None:
        names = kitchen().spec.action_names
        self._actions = [[float(name == action) for name in names] for action in actions]
        extras = [{"role": "partner", "pair": pair} if pair else {} for pair in pairs]
        self.members = tuple(type("MemberInfo", (), {"extra": extra})() for extra in extras)

    def __len__(self) -> int:
        return len(self._actions)

    def __getitem__(self, member: int) -> RandomPolicy:
        return RandomPolicy(6, self._actions[member - 1])

    def make_env(self, num_envs: int) -> BatchedEnv:
        return kitchen(num_envs)


def test_games_of_a_pair_are_of_both_in_each_seating_and_of_one_participant() -> None:
    """The first two are a pair, one stays and one interacts; the third plays with itself."""
    population: Any = Kitchen("stay", "interact", "stay", pairs=(4, 4, 0))
    games = count_members(population, 2, 0)
    stays = [game.counts[:, EVENTS.index("stay")].tolist() for game in games]
    assert stays == [[20, 0]] * 2 + [[0, 20]] * 2 + [[20, 20]] * 2
    assert [game.participants for game in games[::2]] == [("members 1 and 2",) * 2] * 2 + [("member 3",) * 2]
    assert games[0].players == ("member 1", "member 2") and games[2].players == ("member 2", "member 1")
    samples = collect_samples(games)
    assert len(set(samples.clusters.tolist())) == 2 and len(samples.clusters) == 12
    assert measure_coverage(games, games, seed=0).members == 6, "three members in two seats"
    with pytest.raises(UserError, match="no members yet"):
        count_members(Kitchen(pairs=()), 2, 0)  # type: ignore[arg-type]


def test_a_report_that_cannot_be_written_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        write_conventions([PlayersReport("people", 0, [], [], {})], tmp_path / "file")
