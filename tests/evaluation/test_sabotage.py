from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from popgen.envs import make_env
from popgen.envs.rendezvous import worst_reward
from popgen.errors import UserError
from popgen.evaluation.sabotage import SabotageResult, leave_event, measure_sabotage, to_dict
from popgen.population.manifest import EnvironmentInfo
from popgen.reports import sabotage_report
from popgen.reports.charts.path_charts import PathSample, path_grid, path_samples
from popgen.reports.paper_figures import SABOTAGE
from popgen.reports.sabotage_report import PENALTY, PLAIN, TERMINATIONS, build_report

STAY, LEFT, RIGHT, DOWN, UP = range(5)
Rule = Callable[[np.ndarray, int], np.ndarray]


class Mover:
    """Plays `rule(own features (B, 25), seat)` in each seat."""

    kind, view = "mover", "features"

    def __init__(self, rule: Rule) -> None:
        self.rule = rule

    def reset(self, batch: int, seed: int) -> None:
        pass

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        return np.stack([self.rule(obs[:, seat], seat) for seat in (0, 1)], 1).astype(np.uint8)


def always(first: int, second: int | None = None) -> Mover:
    """The same action in every step, another one in seat 1 if given."""
    return Mover(lambda obs, seat: np.full(len(obs), first if seat == 0 or second is None else second))


def seeker(x: float, y: float) -> Mover:
    """Goes to (x, y) in pushes of 0.2 length units, by where it would come to rest (v (0.75 + 0.75^2 + ...) / 10)."""

    def rule(obs: np.ndarray, seat: int) -> np.ndarray:
        away = np.array([x, y]) - (obs[:, :2] + 0.3 * obs[:, 2:4])
        along = np.abs(away[:, 0]) > np.abs(away[:, 1])
        push = np.where(along, np.where(away[:, 0] > 0, RIGHT, LEFT), np.where(away[:, 1] > 0, UP, DOWN))
        return np.where(np.abs(away).max(-1) > 0.12, push, STAY)

    return Mover(rule)


class Cast:
    """As much of a population as the measurement needs."""

    path = Path("cast")

    def __init__(self, *members: Mover, pairs: Sequence[int] = (), **params: Any) -> None:
        self._members = members
        extras = [{"role": "partner", "pair": pair} if pair else {} for pair in pairs or [0] * len(members)]
        self.members = tuple(type("MemberInfo", (), {"extra": extra})() for extra in extras)
        self.spec = make_env("rendezvous/mppmr", 1, **params).spec
        self.env_info = EnvironmentInfo.of(self.spec)

    def __len__(self) -> int:
        return len(self._members)

    def __getitem__(self, member: int) -> Mover:
        return self._members[member - 1]


def measured(*members: Mover, episodes: int = 2, params: Any = None, **environment: Any) -> SabotageResult:
    return measure_sabotage(Cast(*members, **environment), episodes, 0, params)  # type: ignore[arg-type]


def exit_step(x: float) -> int:
    """Steps of pushing right from `x` at rest to beyond the boundary at 1.5: v' = 0.75 v + 0.5, x' = x + v' / 10."""
    speed, steps = 0.0, 0
    while x <= 1.5:
        speed = 0.75 * speed + 0.5
        x += 0.1 * speed
        steps += 1
    return steps


@pytest.fixture(scope="module")
def trio() -> SabotageResult:
    """Member 1 stays, 2 runs to the right, 3 does so in seat 1 only (from -0.3, so that 2 in seat 0 is out first)."""
    return measured(always(STAY), always(RIGHT), always(STAY, RIGHT))


def test_only_a_leavers_own_exits_count_and_only_beside_earlier_members(trio: SabotageResult) -> None:
    assert trio.self_sabotage(1) == 0.0 and trio.self_sabotage(2) == 1.0
    # Member 3 with 1 and 2, in seat 0: it stays, 2 leaves; in seat 1: it leaves beside 1, beside 2 it is too late.
    assert trio.self_sabotage(3) == 1 / 4 and trio.ended_early(3) == 3 / 4
    assert trio.average == pytest.approx(1.25 / 3) and trio.average_ended_early == pytest.approx(1.75 / 3)


@pytest.mark.parametrize("ending", ["terminal", "truncated"])
def test_an_episode_that_runs_to_the_horizon_did_not_end_early(ending: str) -> None:
    result = measured(always(STAY), always(STAY), always(RIGHT), ending=ending)
    assert not result.ended[:2, :2].any() and result.ended[2].all()
    assert (result.ended_early(2), result.ended_early(3)) == (0.0, 1.0)


def test_both_leave_in_the_same_step() -> None:
    result = measured(always(STAY), always(RIGHT, LEFT), always(RIGHT, LEFT))
    assert result.exits[1, 2].all() and result.self_sabotage(3) == 1.0


def test_scores_by_hand_under_both_rules(trio: SabotageResult) -> None:
    still = 1 - 0.75 * math.sqrt(2) - 0.6
    assert trio.scores[0, 0] == pytest.approx([50 * still] * 2, abs=1e-4)
    assert trio.sp.mean == pytest.approx(np.mean([trio.scores[m, m].mean() for m in range(3)]))
    assert trio.xp.mean == pytest.approx(
        np.mean([trio.scores[i, j].mean() for i in range(3) for j in range(3) if i != j])
    )
    members = (always(STAY), always(RIGHT), always(STAY, RIGHT))
    plain = measured(*members, params=TERMINATIONS[PLAIN])
    assert (plain.exits == trio.exits).all() and plain.steps == trio.steps
    left = 50 - exit_step(0.3)
    assert trio.scores[1, 0, 0] - plain.scores[1, 0, 0] == pytest.approx(left * worst_reward(1.5, 0.75), abs=1e-3)
    trained_plain = measured(*members, exit_penalty="none")
    assert (trained_plain.scores == plain.scores).all()
    paid = measured(*members, exit_penalty="none", params=TERMINATIONS[PENALTY])
    assert (paid.scores == trio.scores).all()


def test_steps_are_all_that_the_environments_took(trio: SabotageResult) -> None:
    # All rows play until the longest episode is over, which is the horizon's 50 steps: those of the 9 pairs, and of 3
    # members in both seats beside a random and an idle partner.
    assert trio.steps == (3 * 3 + 3 * 2 * 2) * 2 * 50


def test_landmarks_of_self_play_that_arrives() -> None:
    result = measured(seeker(0.75, 0.75), seeker(-0.75, 0.75), seeker(0.0, 0.0), always(RIGHT), episodes=3)
    corner = make_env("rendezvous/mppmr", 1).landmarks.tolist()  # type: ignore[attr-defined]
    assert result.landmark(1) == 1 + corner.index([0.75, 0.75])
    assert result.landmark(2) == 1 + corner.index([-0.75, 0.75])
    assert result.landmark(3) is None and result.landmark(4) is None
    assert result.used == sorted([result.landmark(1), result.landmark(2)])
    assert result.landmarks is not None and result.landmarks.sum(1).tolist() == [3, 3, 0, 0]


def test_pairs_at_one_landmark_stand_apart_from_the_others() -> None:
    """Four members that hold to their landmark, two of them to the same: none leaves, and cross-play tells why."""
    places = ((0.75, 0.75), (-0.75, 0.75), (0.75, 0.75), (-0.75, -0.75))
    result = measured(*(seeker(*place) for place in places))
    assert result.sharing == [(1, 3)] and result.average_ended_early == 0.0
    scores = result.scores.mean(-1)
    apart = [scores[seats] for i, j in ((0, 1), (0, 3), (1, 2), (1, 3), (2, 3)) for seats in ((i, j), (j, i))]
    assert result.xp_apart.mean == pytest.approx(np.mean(apart)) and result.xp_apart.mean < -40
    assert scores[0, 2] > 30 and result.xp.mean > result.xp_apart.mean
    told = to_dict(result)
    assert told["pairs"] == {"all": 6, "sharing": [[1, 3]]}
    assert math.isnan(measured(seeker(0.75, 0.75)).xp_apart.mean)


def test_the_two_of_a_pair_are_no_strangers_to_each_other() -> None:
    """Members 1 and 2 are a pair that meets at a landmark, 3 and 4 one whose second member runs to the right."""
    result = measured(seeker(0.75, 0.75), seeker(0.75, 0.75), always(STAY), always(RIGHT), pairs=(1, 1, 2, 2))
    scores = result.scores.mean(-1)
    assert result.sp.mean == pytest.approx(np.mean([scores[0, 1], scores[1, 0], scores[2, 3], scores[3, 2]]))
    across = [scores[seats] for i in (0, 1) for j in (2, 3) for seats in ((i, j), (j, i))]
    assert result.xp.mean == pytest.approx(np.mean(across))
    assert result.self_sabotage(4) == 1.0 and result.self_sabotage(2) == 0.0, "3 is the mate of 4, 1 that of 2"
    assert result.sharing == [] and result.landmark(1) == result.landmark(2) is not None
    assert result.landmark(3) is None, "its mate leaves"
    assert to_dict(result)["pairs"]["all"] == 4


def test_members_beside_an_idle_and_a_random_partner() -> None:
    result = measured(always(STAY), always(RIGHT), episodes=20)
    still = 50 * (1 - 0.75 * math.sqrt(2) - 0.6)
    left = (
        measured(always(STAY), always(RIGHT)).scores[0, 1].mean(),
        measured(always(STAY), always(RIGHT)).scores[1, 0].mean(),
    )
    # Member 1 beside an idle partner is two that stay; member 2 leaves from either start.
    assert result.beside["idle"].mean == pytest.approx((2 * still + sum(left)) / 4, abs=1e-3)
    assert result.beside["random"].mean < 0 and result.beside["random"].error > 0


def test_paths_end_where_the_episode_ends(trio: SabotageResult) -> None:
    paths = trio.paths
    assert paths is not None and paths.positions.shape == (3, 3, 51, 2, 2)
    assert paths.positions[1, 0, 0].tolist() == [[0.3, 0.0], [-0.3, 0.0]]
    finite = np.isfinite(paths.positions[1, 0]).all((-1, -2))
    assert finite.sum() == exit_step(0.3) + 1 and finite[: exit_step(0.3) + 1].all()
    assert paths.positions[1, 0, exit_step(0.3), 0, 0] > 1.5
    assert paths.left[1, 0].tolist() == [True, False] and not paths.left[0, 0].any()
    assert np.isfinite(paths.positions[0, 0]).all()


def test_refusals() -> None:
    with pytest.raises(UserError, match="has no event by which a player leaves"):
        leave_event(make_env("overcooked/cramped_room", 1).spec)
    with pytest.raises(UserError, match="no members"):
        measured()
    with pytest.raises(UserError, match="at least 1"):
        measured(always(STAY), episodes=0)


# --- the report


def row(result: SabotageResult, method: str, termination: str, seed: int) -> dict[str, Any]:
    told = to_dict(result)
    scored = {termination: {"sp": told["sp"], "xp": told["xp"]}}
    scored[PENALTY if termination == PLAIN else PLAIN] = {"sp": told["sp"], "xp": {"mean": -99.0}}
    names = ("members", "self_sabotage", "ended_early", "average", "average_ended_early", "sp", "xp")
    figures = {name: told[name] for name in (*names, "landmarks", "matrix", "exits", "xp_apart", "pairs", "beside")}
    head = {"method": method, "name": method.upper(), "termination": termination, "training_seed": seed}
    return head | {"population": "here", "training_steps": {"SP": 5}, "scored": scored} | figures


@pytest.fixture(scope="module")
def report(trio: SabotageResult) -> dict[str, Any]:
    alone = measured(always(STAY))
    rows = [row(trio, "lipo", PENALTY, 1), row(trio, "lipo", PLAIN, 1), row(alone, "lipo", PENALTY, 2)]
    return build_report("rendezvous/mppmr", 2, 0, 123, rows)


def test_json_holds_the_documented_keys(report: dict[str, Any]) -> None:
    documented = re.findall(r"^    (\w[\w, ]*?)  +\S", sabotage_report.__doc__ or "", re.M)
    assert set(report) == {key.strip() for line in documented for key in line.split(",")}
    assert json.loads(sabotage_report.to_json(report)) == report
    assert report["rows"][0]["self_sabotage"] == [0.0, 1.0, 0.25] and report["rows"][2]["xp"]["mean"] is None
    lipo = next(one for one in report["means"] if one["termination"] == PENALTY)
    assert lipo["populations"] == 2 and lipo["average"] == {
        "mean": pytest.approx(1.25 / 6),
        "low": 0.0,
        "high": 1.25 / 3,
    }
    assert report["paper"]["xpm_sim"]["average"] == 0.011 and report["steps"] == {"evaluation": 123}


def test_csv_has_a_row_a_member_and_the_papers(report: dict[str, Any]) -> None:
    rows = list(csv.DictReader(io.StringIO(sabotage_report.members_csv(report))))
    assert tuple(rows[0]) == sabotage_report.CSV_FIELDS and len(rows) == 4 + 4 + 2 + 3 * 9
    assert (rows[2]["member"], rows[2]["self_sabotage"], rows[2]["ended_early"]) == ("3", "0.25", "0.75")
    assert rows[3]["member"] == "average" and rows[7]["xp_penalty"] == "-99.0"
    theirs = [line for line in rows if line["source"] == "paper" and line["method"] == "lipo"]
    assert theirs[-1]["ended_early"] == "0.59" and theirs[-1]["xp"] == "-130.65" and theirs[0]["self_sabotage"] == ""


def test_tables_stand_beside_the_papers_for_each_rule(report: dict[str, Any], trio: SabotageResult) -> None:
    text = re.sub(" +", " ", sabotage_report.to_markdown(report))
    assert (
        text.count("| CoMeDi, paper | 0 | 0 | 0 | 0 | 0 | 0 | 0.175 | 0.57 | 0.09 | - | 30.67 | -114.01 | - | -") == 2
    )
    assert "| LIPO, seed 1 | 0.00 | 1.00 | 0.75 | | | | | | 0.583 | 0.417 |" in text  # any exit, as the paper counts
    assert f"{trio.xp.mean:.2f} (-99.00)" in text  # exits cost nothing there: what they would with the penalty
    assert "costs nothing" in text and "2 populations: any exit 0.292 (0.000 to 0.583), own 0.208" in text
    assert [len(sheet.to_rich().rows) for sheet in sabotage_report.to_sheets(report)] == [2 + 3, 1 + 3]
    assert len(SABOTAGE) == 3


def test_paths_are_drawn(trio: SabotageResult, tmp_path: Path) -> None:
    assert trio.paths is not None
    grid, sample = [tmp_path / "grid.png", tmp_path / "grid.svg"], [tmp_path / "one.png", tmp_path / "one.svg"]
    path_grid(trio.paths, grid, title="three members")
    path_samples([PathSample("LIPO", trio.paths, (2, 1))], sample)
    for files in (grid, sample):
        assert imread(files[0]).std() > 0.02
        assert "left bounds" in files[1].read_text() and "seat 1" in files[1].read_text()
    assert "rows: agent in seat 0" in grid[1].read_text()
