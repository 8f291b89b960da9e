from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.scripted import HORIZON, ONE, STAY, TWO, Script, TallyEnv

from popgen.errors import UserError
from popgen.evaluation.holdout import Casting, HoldoutResult, evaluate_holdout
from popgen.evaluation.holdout_figures import (
    ALL,
    CROSS,
    OWN,
    PartnerSet,
    describe_standing,
    find_references,
    list_sets,
    measure_margins,
)
from popgen.evaluation.holdout_players import Group, Lineage, Player, check_disjoint, read_partners
from popgen.population.manifest import EnvironmentInfo
from popgen.reports.holdout_report import to_csv_text, to_dict, write_report
from popgen.reports.holdout_tables import list_lines, to_sheets


def group(label: str, method: str | None, *scripts: list[int]) -> Group:
    players = tuple(
        Player(label, label, n, f"{label}{n}", lambda script=script: Script(script))  # type: ignore[misc]
        for n, script in enumerate(scripts, start=1)
    )
    return Group(label, method, players)


def played(casting: Casting, episodes: int = 3) -> HoldoutResult:
    info = EnvironmentInfo.of(TallyEnv.spec)
    return evaluate_holdout(casting, info, TallyEnv, episodes, 0)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def result() -> HoldoutResult:
    """The score of a step is a_0 + 10 a_1, so that a seat 1 player is worth ten times as much; 6 steps."""
    egos = (group("ego", "lipo", [ONE], [STAY]), group("base", "mappo", [STAY]))
    partners = (group("L", "lipo", [TWO]), group("W", "xpm_wm", [ONE], [STAY]), group("people", "human_clone", [TWO]))
    best = {"L1": Player("response", "here", 1, "r", lambda: Script([TWO]))}
    return played(Casting(egos, partners, best, frozenset({"people"})))


def test_every_ego_plays_every_partner_in_both_seats(result: HoldoutResult) -> None:
    assert result.scores.shape == (3, 4, 2, 3)
    assert result.scores[0, 0].tolist() == [[6 * 21] * 3, [6 * 12] * 3]  # ONE beside TWO
    assert result.scores[1, 0].tolist() == [[6 * 20] * 3, [6 * 2] * 3]  # STAY beside TWO
    assert result.scores[0, 2].tolist() == [[6] * 3, [60] * 3]  # ONE beside STAY


def test_controls_stand_beside(result: HoldoutResult) -> None:
    assert result.ego_alone[:, 0].tolist() == [66, 0, 0] and result.partner_alone[:, 0].tolist() == [132, 66, 0, 132]
    assert result.ego_beside["idle"][0, :, 0].tolist() == [6, 60]
    assert result.partner_beside["idle"][0, :, 0].tolist() == [120, 12]  # the idle player in seat 0, in seat 1
    assert 0 < result.partner_beside["random"].mean() < 200
    assert result.responses[0, :, 0].tolist() == [132, 132] and np.isnan(result.responses[1:]).all()
    pairs = 4 + 4 * 2 * (3 + 2) + 2 + 3 + 3 * 2 * 2
    assert result.steps == pairs * 3 * HORIZON


def test_the_reference_is_the_better_of_self_play_and_best_response(result: HoldoutResult) -> None:
    assert find_references(result).tolist() == [[132, 132], [66, 66], [0, 0], [132, 132]]
    better = replace(result, responses=np.where(np.isnan(result.responses), np.nan, 200.0))
    assert find_references(better)[0].tolist() == [200, 200]


def test_own_and_other_methods_stand_apart_and_people_count_in_no_average(result: HoldoutResult) -> None:
    ego, base = result.casting.egos
    sets = {one.label: one.columns for one in list_sets(result, ego)}
    assert sets == {"L": (0,), "W": (1, 2), "people": (3,), ALL: (0, 1, 2), OWN: (0,), CROSS: (1, 2)}
    taught = replace(base, partners=(Lineage("xpm_wm", 5, "d"),))
    sets = {one.label: one.columns for one in list_sets(result, taught)}
    assert sets[OWN] == (1, 2) and sets[CROSS] == (0,)


def test_figures_by_hand(result: HoldoutResult) -> None:
    one = describe_standing(result, result.casting.egos[0], PartnerSet("L", (0,)))
    means = np.array([126.0, 72.0, 120.0, 12.0])
    assert one.score.mean == pytest.approx(means.mean()) and one.score.count == 12
    assert one.score.sd == pytest.approx(np.repeat(means, 3).std(ddof=1))
    assert one.score.se == pytest.approx(one.score.sd / math.sqrt(12))
    assert one.seats == (123.0, 42.0)
    assert (one.worst.score, one.worst.ego, one.worst.partner, one.worst.seat) == (12.0, "ego 2", "L 1", 1)
    assert one.cvar == 12.0 and one.regret == pytest.approx(132 - means.mean())
    assert one.br_prox.value == pytest.approx((72 + 120) / 2 / 132)  # the middle half of four
    assert one.br_prox_unclipped == pytest.approx(means.mean() / 132)
    assert one.br_prox.low <= one.br_prox.value <= one.br_prox.high
    assert (one.interval.low, one.interval.high) == (66.0, 99.0)  # of two seeds, whose means they are


def test_one_seed_and_one_partner_have_no_interval(result: HoldoutResult, tmp_path: Path) -> None:
    one = describe_standing(result, result.casting.egos[1], PartnerSet("L", (0,)))
    assert one.interval.value == one.score.mean and math.isnan(one.interval.low) and math.isnan(one.br_prox.high)
    report = to_dict(result, "base")
    (told,) = [row for row in report["standings"] if (row["ego"], row["partners"]) == ("base", "L")]
    assert told["interval"] == {"low": None, "high": None}
    assert write_report(report, tmp_path)["png"].stat().st_size
    margins = {row["beside"]: row["95 %"] for row in list(to_sheets(report))[3].frame.to_dict("records")}
    assert margins["L"] == "-" and " to " in margins["W"]


def test_one_episode_of_one_player_has_no_error_of_nothing() -> None:
    single = played(Casting((group("e", None, [ONE]),), (group("p", None, [TWO]),)), episodes=1)
    controls = list(to_sheets(to_dict(single)))[2].frame
    assert controls["with itself"].tolist() == ["66.00", "132.00"]


def test_partners_of_one_label_keep_their_own_references() -> None:
    first, second = group("P", "lipo", [TWO]), group("P", "lipo", [ONE])
    joined = replace(first, players=(first.players[0], replace(second.players[0], source="elsewhere", digest="x")))
    report = to_dict(played(Casting((group("e", None, [ONE]),), (joined,))))
    rows = [line.split(",") for line in to_csv_text(report).splitlines()]
    assert rows[0][9] == "reference" and [row[9] for row in rows[1:]] == ["132.0", "132.0", "66.0", "66.0"]
    assert [row[-1] for row in rows[1:]] == ["P", "P", "elsewhere", "elsewhere"]


def test_a_partner_whose_reference_scores_nothing_has_a_ratio_of_one(result: HoldoutResult) -> None:
    one = describe_standing(result, result.casting.egos[0], PartnerSet("idle", (2,)))
    assert one.br_prox.value == 1.0 and math.isnan(one.br_prox_unclipped)
    assert one.normalised == pytest.approx(0.5)  # the best that anybody reached is the first seed's


def test_margins_are_over_the_control_with_the_same_partners(result: HoldoutResult) -> None:
    (first, *_) = measure_margins(result, "base")
    # ego's mean over its seeds is 123 and 42, the control's 120 and 12: gains of 3 and 30.
    assert (first.ego, first.partners, first.gain.value) == ("ego", "L", pytest.approx(16.5))
    assert math.isnan(first.gain.low)  # beside one partner
    with pytest.raises(UserError, match="no ego nobody"):
        measure_margins(result, "nobody")


def test_the_report_holds_every_pair_and_is_the_same_twice(result: HoldoutResult, tmp_path: Path) -> None:
    report = to_dict(result, "base")
    files = write_report(report, tmp_path / "a")
    write_report(to_dict(result, "base"), tmp_path / "b")
    for path in files.values():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path
    assert json.loads(files["json"].read_text())["standings"] == report["standings"]
    lines = to_csv_text(report).splitlines()
    assert len(lines) == 1 + 3 * 4 * 2
    assert lines[1] == "ego,1,L,1,0,126.0,0.0,0.0,3,132.0,0.9545454545454546,0.9545454545454546,6.0,ego,L"
    assert "worst of ego: 0.00 points, ego 2 in seat 0 beside W 2" in list_lines(report)
    assert any("1 of 4 partners scores nothing" in line for line in list_lines(report))
    assert [len(sheet.frame) for sheet in to_sheets(report)] == [11, 11, 5, 4]


def test_the_papers_table_stands_beside_ours(result: HoldoutResult) -> None:
    cramped = result.environment.model_copy(update={"name": "overcooked/cramped_room"})
    sheet = list(to_sheets(to_dict(replace(result, environment=cramped))))[-1]
    rows = {row["hold-out"]: row for row in sheet.frame.to_dict("records")}
    assert rows[ALL]["paper E-LIPO"] == "7.35" and rows[OWN]["paper E-XPM-WM"] == "8.75"
    assert rows[CROSS]["paper E-XPM-WM"] == "6.40"  # of 5.36 and 7.44


@pytest.mark.parametrize(
    ("egos", "partners", "told"), [([], [[ONE]], "an ego and a partner"), ([[ONE]], [], "an ego and a partner")]
)
def test_nobody_cannot_be_evaluated(egos: list[list[int]], partners: list[list[int]], told: str) -> None:
    with pytest.raises(UserError, match=told):
        sides = [tuple([group("g", None, *scripts)] if scripts else []) for scripts in (egos, partners)]
        played(Casting(*sides))
    with pytest.raises(UserError, match="at least 1"):
        played(Casting((group("e", None, [ONE]),), (group("p", None, [ONE]),)), episodes=0)


# --- what must not be shared


def trained(label: str, method: str, seed: int, digests: set[str], *partners: Lineage, config: str = "c") -> Group:
    own = Lineage(method, seed, config, frozenset(digests))
    players = tuple(Player(label, label, n, d, lambda: Script([ONE])) for n, d in enumerate(sorted(digests), 1))  # type: ignore[arg-type, return-value]
    return Group(label, method, players, (own,), partners)


def test_shared_members_training_partners_and_seeds_are_refused() -> None:
    met = Lineage("lipo", 1, "c", frozenset({"a", "b"}))
    ego = trained("ego", "fcp_ego", 7, {"e"}, met)
    check_disjoint([ego], [trained("held", "lipo", 2, {"x"}), trained("other", "comedi", 1, {"y"})])
    with pytest.raises(UserError, match="member 1 is a training partner of the ego ego"):
        check_disjoint([ego], [trained("held", "lipo", 2, {"b"})])
    with pytest.raises(UserError, match="member 1 is the ego ego itself"):
        check_disjoint([ego], [trained("held", "lipo", 2, {"e"})])
    with pytest.raises(UserError, match="held: has seed 1 of lipo, which the ego ego is trained with"):
        check_disjoint([ego], [trained("held", "lipo", 1, {"z"})])
    with pytest.raises(UserError, match="which the ego lipo is itself of"):
        check_disjoint([trained("lipo", "lipo", 3, {"m"})], [trained("held", "lipo", 3, {"z"})])


def test_clones_of_two_halves_of_people_are_no_relatives() -> None:
    ego = trained("ego", "any", 7, {"e"}, Lineage("human_clone", 0, "half A", frozenset({"a"})))
    check_disjoint([ego], [trained("people", "human_clone", 0, {"b"}, config="half B")])
    with pytest.raises(UserError, match="has seed 0 of human_clone"):
        check_disjoint([ego], [trained("people", "human_clone", 0, {"b"}, config="half A")])


def test_what_an_ego_was_trained_with_is_read_from_its_record() -> None:
    record = {"method": "lipo", "seed": 1, "config_digest": "c", "members": [1, 2], "policy_sha256": ["a", "b"]}
    assert read_partners("place", {"trained_with": [record]}) == [Lineage("lipo", 1, "c", frozenset("ab"))]
    assert read_partners("place", {}) == []
    for wrong in ("text", [{"method": "lipo"}], [3]):
        with pytest.raises(UserError, match="cannot be read"):
            read_partners("place", {"trained_with": wrong})
