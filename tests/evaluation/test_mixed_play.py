from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.scripted import HORIZON, ONE, QUIT, STAY, TWO, Cast, Script, TallyEnv

from popgen.evaluation.crossplay import CrossPlayResult, evaluate_population
from popgen.evaluation.estimates import Estimate, adjust_by_holm
from popgen.evaluation.mixed_play import MixedPlay, Switch, play_mixed, play_switches
from popgen.reports.crossplay_report import list_warnings, mixed_play_sheet, summary, to_dict


class Offended(Script):
    """Plays ONE in both seats until somebody in seat `by` has played something else; stays from then on."""

    def __init__(self, by: int) -> None:
        super().__init__([ONE])
        self.by, self.angry = by, np.zeros(0, bool)

    def reset(self, batch: int, seed: int) -> None:
        super().reset(batch, seed)
        self.angry = np.zeros(batch, bool)

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        self.angry = ~is_first & (self.angry | (previous_actions[:, self.by] != ONE))
        return np.where(self.angry[:, None], STAY, super().act(obs, previous_actions, is_first)).astype(np.uint8)

    def memory(self) -> dict[str, Any]:
        return {"angry": self.angry.copy()}

    def load_memory(self, memory: dict[str, Any]) -> None:
        self.angry = np.array(memory["angry"])


def evaluated(*members: Script, episodes: int = 4) -> CrossPlayResult:
    return evaluate_population(Cast(*members), episodes, 0)  # type: ignore[arg-type]


def test_an_episode_changes_hands_at_its_step() -> None:
    """ONE in seat 0 and TWO in seat 1 make 21 a step; ONE in both 11."""
    switches = [Switch((0, 1), (0, 0), step, False) for step in (1, 4)] + [Switch((0, 1), (1, 1), 2, True)]
    played = play_switches(TallyEnv(3), [Script([ONE]), Script([TWO])], switches, 0)
    assert played.scores.tolist() == [5 * 11, 2 * 11, 4 * 22] and played.steps == 3 * HORIZON
    # as many steps as the switch leaves, from the first on: the first of the three changes hands within them
    assert played.openings.tolist() == [21 + 4 * 11, 2 * 21, 2 * 21 + 2 * 22]


def test_a_new_game_tells_what_begun_work_is_worth() -> None:
    """A member that earns nothing in its first two steps earns less in a new game than after any switch."""
    late = Script([STAY, STAY, ONE, ONE, ONE, ONE])
    got = evaluated(late, Script([ONE]), episodes=8)
    first, steady = (next(one for one in got.mixed if one.member == member) for member in (1, 2))
    assert first.fresh.mean < first.ordinary.mean and got.fresh_share(1).mean < 1.0
    assert steady.fresh == steady.ordinary and got.fresh_share(2).mean == 1.0
    report = to_dict(got)
    assert report["mixed_play"]["members"][1]["fresh"]["mean"] == 1.0
    sheet = mixed_play_sheet(report)
    assert sheet is not None and sheet.frame["new game"].tolist()[1].startswith("1.00 ")
    del report["mixed_play"]["members"][0]["fresh"], report["mixed_play"]["members"][1]["fresh"]
    sheet = mixed_play_sheet(report)
    assert sheet is not None and "new game" not in sheet.frame


def test_a_member_without_memory_goes_on_as_ever() -> None:
    got = evaluated(Script([ONE]), Script([TWO]))
    assert len(got.mixed) == 4 and {one.share().mean for one in got.mixed} == {1.0}
    assert [got.share(member, seat).mean for member in (1, 2) for seat in (0, 1)] == [1.0] * 4
    assert got.count_episodes() == 12 * 4 + (2 + 4) * 2 and got.steps == got.count_episodes() * HORIZON


def test_offence_taken_in_one_seat_shows_in_that_seat_and_goes_with_the_memory() -> None:
    """Member 1 is offended by who sits in seat 1, so that it has seat 0 itself; forgetting makes up."""
    got = evaluated(Offended(by=1), Script([TWO]))
    assert got.share(1, 0).mean == 0.0 and got.share(1, 1).mean == 1.0
    assert got.share(1, 0, reset=True).mean == 1.0 and got.share(1, 1, reset=True).mean == 1.0
    assert got.share(2, 0).mean == got.share(2, 1).mean == 1.0


def test_the_share_is_the_mean_over_partners() -> None:
    """Member 1 is offended by member 2 (TWO), not by member 3, who plays ONE like itself."""
    got = evaluated(Offended(by=1), Script([TWO]), Script([ONE]))
    assert got.share(1, 0).mean == 0.5
    report = to_dict(got)
    assert report["mixed_play"]["members"][0]["seat_0"]["least"] == 0.0
    assert (
        list_warnings(report)[-1] == "members with less than 0.9 of their self-play after cross-play: 1 (seat 0: 0.50)"
    )


def test_a_game_that_is_over_leaves_nothing() -> None:
    quits = Script([QUIT], [ONE])  # in seat 0 alone
    got = evaluated(Script([ONE]), quits)
    assert got.share(1, 1).mean == 0.0 and got.share(1, 0).mean == 1.0
    # Its own self-play is over before any switch: there is nothing to take a share of.
    assert math.isnan(got.share(2, 0).mean)
    assert to_dict(got)["mixed_play"]["members"][1]["seat_0"] == {
        "kept": {"mean": None, "standard_error": None},
        "reset": {"mean": None, "standard_error": None},
        "least": None,
    }


def test_one_member_has_no_mixed_play() -> None:
    got = evaluated(Script([ONE]))
    assert got.mixed == () and mixed_play_sheet(to_dict(got)) is None
    assert play_mixed(TallyEnv, {1: Script([ONE])}, 3, 0).steps == 0  # type: ignore[arg-type, dict-item]


def test_shares_are_printed_by_seat() -> None:
    report = to_dict(evaluated(Offended(by=1), Script([TWO])))
    sheet = mixed_play_sheet(report)
    assert sheet is not None
    assert sheet.frame.iloc[0].tolist()[:3] == ["1", "0.00 ± 0.00", "1.00 ± 0.00"]
    line = next(line for line in summary(report) if line.startswith("self-play that remains"))
    assert "seat 0, memory kept 0.00 to 1.00" in line and "seat 0, memory reset 1.00 to 1.00" in line


# --- the correction


def test_holm_by_hand() -> None:
    assert adjust_by_holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert adjust_by_holm([0.5, 0.9]) == pytest.approx([1.0, 1.0]) and adjust_by_holm([]) == []
    first, missing = adjust_by_holm([0.02, math.nan])
    assert first == pytest.approx(0.04) and math.isnan(missing)


def test_chances_by_hand() -> None:
    # A difference of 1.96 errors has 0.025 below it; of few samples more (t of 2 degrees below -4.303: 0.025).
    assert Estimate(0.0, 3.0).chance_below(Estimate(1.96 * 5, 4.0), 10_000) == pytest.approx(0.025, abs=1e-4)
    assert Estimate(0.0, 0.0).chance_below(Estimate(4.3027, 1.0), 3) == pytest.approx(1 / 20)  # 20 ways to deal six
    assert Estimate(0.0, 1.0).chance_below(Estimate(2.2281 * 2**0.5, 1.0), 6) == pytest.approx(0.025, abs=1e-4)
    assert Estimate(1.0, 0.0).chance_below(Estimate(2.0, 0.0), 2) == pytest.approx(1 / 6)  # {1, 1} of {1, 1, 2, 2}
    assert Estimate(2.0, 0.0).chance_below(Estimate(2.0, 0.0), 2) == 1.0
    assert math.isnan(Estimate(1.0, math.nan).chance_below(Estimate(2.0, 0.1), 1))


@pytest.mark.parametrize("samples", [2, 4, 20])
def test_chance_below_is_rarely_small_where_nothing_is(samples: int) -> None:
    """Scores that are few and whole numbers are often equal by chance; two errors are no proof then."""
    rng = np.random.default_rng(samples)
    draws = rng.binomial(4, 0.6, (4000, 2, samples)).astype(float)
    chances = np.array([Estimate.of(a).chance_below(Estimate.of(b), samples) for a, b in draws])
    for level in (0.01, 0.05):
        assert (chances <= level).mean() <= 1.3 * level


def test_shares_of_one_self_play_do_not_average_its_error_out() -> None:
    """Ten partners after whom exactly 5 of 10 +- 1 remain: a share of 0.5, whose error is that of the 10."""
    exact, ordinary = Estimate(5.0, 0.0), Estimate(10.0, 1.0)
    plays = tuple(MixedPlay(1, partner, 0, exact, exact, ordinary, ordinary) for partner in range(2, 12))
    got = replace(evaluated(Script([ONE])), mixed=plays).share(1, 0)
    assert got.mean == 0.5 and got.error == pytest.approx(0.05)


def test_a_ratio_has_the_error_of_both() -> None:
    ratio = Estimate(3.0, 0.3).divide(Estimate(4.0, 0.4))
    assert ratio.mean == 0.75 and ratio.error == pytest.approx(0.75 * math.hypot(0.1, 0.1))
    assert math.isnan(Estimate(3.0, 0.3).divide(Estimate(0.0, 0.1)).mean)


def test_few_episodes_of_equal_players_prove_no_obstruction() -> None:
    from popgen.policies.simple_policies import RandomPolicy

    for episodes in (2, 3):
        members = [RandomPolicy(4, [0.25, 0.375, 0.375, 0.0]) for _ in range(6)]
        assert evaluated(*members, episodes=episodes).obstructions == ()  # type: ignore[arg-type]


def test_eight_equal_players_obstruct_nobody_and_one_episode_judges_nothing() -> None:
    """224 comparisons of random play with random play: two errors alone would find some five."""
    from popgen.policies.simple_policies import RandomPolicy

    members = [RandomPolicy(4, [0.25, 0.375, 0.375, 0.0]) for _ in range(8)]
    got = evaluated(*members, episodes=20)  # type: ignore[arg-type]
    assert len(got.comparisons) == 8 * 7 * 4
    assert got.obstructions == ()
    quits = Script([QUIT])
    single = evaluated(Script([TWO]), quits, episodes=1)
    assert single.score(1, 2).mean < single.score(1, "idle").mean
    assert single.obstructions == () and single.obstruction == {"random": False, "idle": False}
    assert not any("obstruction" in line for line in list_warnings(to_dict(single)))
