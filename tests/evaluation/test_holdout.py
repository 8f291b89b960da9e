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
from popgen.evaluation.holdout_lineages import Lineage
from popgen.evaluation.holdout_players import Group, Player, Response
from popgen.population.manifest import EnvironmentInfo
from popgen.reports.holdout_report import to_csv_text, to_dict, write_report
from popgen.reports.holdout_tables import list_lines, to_sheets


def group(label: str, method: str | None, *scripts: list[int]) -> Group:
    players = tuple(
        Player(label, label, n, f"{label}{n}", lambda script=script: Script(script), identity=f"{label}{n}")  # type: ignore[misc]
        for n, script in enumerate(scripts, start=1)
    )
    return Group(label, method, players)


def respond(script: list[int]) -> Response:
    player = Player("response", "here", 1, "r", lambda: Script(script))  # type: ignore[arg-type, return-value]
    return Response(player, "demo", {"ego.steps": 9}, 12_000)


def pair_up(one: Group, *pairs: int) -> Group:
    """The same players, trained in these pairs; 0 for none."""
    return replace(one, players=tuple(replace(p, pair=n) for p, n in zip(one.players, pairs, strict=True)))


def played(casting: Casting, episodes: int = 3) -> HoldoutResult:
    info = EnvironmentInfo.of(TallyEnv.spec)
    return evaluate_holdout(casting, info, TallyEnv, episodes, 0)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def result() -> HoldoutResult:
    """The score of a step is a_0 + 10 a_1, so that a seat 1 player is worth ten times as much; 6 steps."""
    egos = (group("ego", "lipo", [ONE], [STAY]), group("base", "mappo", [STAY]))
    partners = (group("L", "lipo", [TWO]), group("W", "xpm_wm", [ONE], [STAY]), group("people", "human_clone", [TWO]))
    return played(Casting(egos, partners, {"L1": respond([TWO])}, frozenset({"people"})))


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


def test_teachers_stand_apart_beside_whom_they_taught(result: HoldoutResult) -> None:
    """L taught the first ego alone: its row is none of the other's, and it counts in no average."""
    ego, base = result.casting.egos
    taught = replace(ego, partners=(Lineage("lipo", 5, "d", frozenset({"L1"})),))
    casting = replace(result.casting, egos=(taught, base), met=frozenset({"L"}))
    own = replace(result, casting=casting)
    assert {one.label: one.columns for one in list_sets(own, taught)} == {"L": (0,), "W": (1, 2), "people": (3,)}
    assert {one.label: one.columns for one in list_sets(own, base)} == {"W": (1, 2), "people": (3,)}
    report = to_dict(own)
    (row,) = [one for one in report["standings"] if one["partners"] == "L"]
    # The means beside L of the seeds ONE and STAY, of the reference's 132: (126 + 72 + 120 + 12) / 4 = 82.5.
    assert row["br_prox_unclipped"] == row["br_prox_least"] == pytest.approx(82.5 / 132)
    told = "ego beside its training partners L: 0.62 of the best known with each on average, 0.62 with the least"
    assert told in list_lines(report) and not any(line.startswith("worst of ego: 12.00") for line in list_lines(report))
    both = describe_standing(result, ego, PartnerSet("both", (0, 1)))
    assert both.br_prox_least == pytest.approx(0.625)  # beside W's first (66 + 66 + 60 + 6) / 4 of 66 are 0.75
    assert both.br_prox_unclipped == pytest.approx((0.625 + 0.75) / 2)


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
    beside_one = to_dict(
        played(Casting((group("e", None, [ONE]), group("c", None, [STAY])), (group("p", None, [TWO]),))), "c"
    )
    (margin,) = list(to_sheets(beside_one))[3].frame.to_dict("records")
    assert margin["95 %"] == "-" and beside_one["margins"][0]["resampled"] == []


def test_one_episode_of_one_player_has_no_error_of_nothing() -> None:
    single = played(Casting((group("e", None, [ONE]),), (group("p", None, [TWO]),)), episodes=1)
    controls = list(to_sheets(to_dict(single)))[2].frame
    assert controls["with itself"].tolist() == ["66.00", "132.00"]


def test_partners_of_one_label_keep_their_own_references() -> None:
    first, second = group("P", "lipo", [TWO]), group("P", "lipo", [ONE])
    other = replace(second.players[0], source="elsewhere", digest="x", identity="x")
    joined = replace(first, players=(first.players[0], other))
    report = to_dict(played(Casting((group("e", None, [ONE]),), (joined,))))
    rows = [line.split(",") for line in to_csv_text(report).splitlines()]
    assert rows[0][9] == "reference" and [row[9] for row in rows[1:]] == ["132.0", "132.0", "66.0", "66.0"]
    assert [row[-1] for row in rows[1:]] == ["P", "P", "elsewhere", "elsewhere"]


def test_a_partner_without_a_reference_is_left_out_of_br_prox(result: HoldoutResult) -> None:
    """W 2 stays, so that with itself it scores nothing: whoever plays beside it, a share of that says nothing."""
    ego = result.casting.egos[0]
    alone = describe_standing(result, ego, PartnerSet("idle", (2,)))
    assert (alone.count, alone.referenced) == (1, 0)
    assert math.isnan(alone.br_prox.value) and math.isnan(alone.br_prox.low) and math.isnan(alone.br_prox_unclipped)
    assert alone.normalised == pytest.approx(0.5)  # the best that anybody reached is the first seed's
    both, without = (describe_standing(result, ego, PartnerSet("W", columns)) for columns in ((1, 2), (1,)))
    assert (both.count, both.referenced) == (2, 1) and both.br_prox == without.br_prox
    report = to_dict(result)
    told = {row["partners"]: row["referenced"] for row in report["standings"] if row["ego"] == "ego"}
    assert told == {"L": 1, "W": 1, "people": 1, ALL: 2, OWN: 1, CROSS: 1}
    assert "1 of 4 partners have no reference that scores in either seat: left out of BR-Prox there." in report["notes"]
    lines = [line.split(",") for line in to_csv_text(report).splitlines()]
    clipped = {(row[2], row[3]): row[11] for row in lines[1:] if row[0] == "ego"}
    assert clipped["W", "2"] == "" and clipped["W", "1"] != ""


def test_a_partner_with_a_reference_in_one_seat_counts_there(result: HoldoutResult) -> None:
    """W 2's response scores 50 in seat 1 and nothing in seat 0; the egos have 6 and 60, and nothing."""
    responses = result.responses.copy()
    responses[2] = np.array([0.0, 50.0])[:, None]
    changed = replace(result, responses=responses)
    one = describe_standing(changed, result.casting.egos[0], PartnerSet("idle", (2,)))
    assert one.referenced == 1 and one.br_prox.value == pytest.approx((1.0 + 0.0) / 2)
    assert one.br_prox_unclipped == pytest.approx((60 / 50 + 0.0) / 2)
    assert any(
        "1 of 4 partners have no reference that scores in one of the seats" in note for note in list_notes(changed)
    )


def list_notes(result: HoldoutResult) -> list[str]:
    return to_dict(result)["notes"]


def test_the_mate_of_a_pair_is_a_reference_in_its_seat() -> None:
    """Of a pair STAY and TWO, which with themselves have 0 and 132: beside STAY its mate has 12 in seat 0 and 120 in
    seat 1; beside TWO the mate has 120 and 12, less than TWO with itself. An idle ego has 0 beside STAY."""
    pair = pair_up(group("H", "hsp", [STAY], [TWO], [ONE]), 3, 3, 0)
    result = played(Casting((group("e", None, [STAY]),), (pair,)))
    assert result.partner_mates[:, :, 0].tolist()[:2] == [[12, 120], [120, 12]]
    assert np.isnan(result.partner_mates[2]).all() and np.isnan(result.ego_mates).all()
    assert find_references(result).tolist() == [[12, 120], [132, 132], [66, 66]]
    report = to_dict(result)
    assert [one["of"] for one in report["reference"]] == [["mate"] * 2, ["self-play"] * 2, ["self-play"] * 2]
    assert [player["mate"] for player in report["partners"][0]["players"]] == [2, 1, None]
    one = describe_standing(result, result.casting.egos[0], PartnerSet("H", (0,)))
    assert one.referenced == 1 and one.br_prox.value == 0.0 and one.regret == pytest.approx(66.0)
    rows = list(to_sheets(report))[2].frame.to_dict("records")
    assert rows[0]["with its mate"] == "-" and rows[1]["with its mate"].startswith("66.00")  # of 12, 120, 120 and 12
    assert any("the mate that it was trained in a pair with (2)" in note for note in report["notes"])


def test_of_equal_references_a_trained_one_is_named_first_and_mates_need_one_population() -> None:
    casting = Casting((group("e", None, [STAY]),), (pair_up(group("H", "hsp", [STAY], [TWO]), 3, 3),))
    trained = played(replace(casting, responses={"H1": respond([TWO])}))
    assert to_dict(trained)["reference"][0]["of"] == ["best response"] * 2
    both = casting.partners[0]
    apart = replace(both, players=(both.players[0], replace(both.players[1], source="elsewhere")))
    assert np.isnan(played(replace(casting, partners=(apart,))).partner_mates).all()


def test_a_mate_that_was_not_chosen_is_a_reference_all_the_same() -> None:
    """Of the pair STAY and TWO only STAY is held out: beside it its mate has 12 in seat 0 and 120 in seat 1."""
    whole = pair_up(group("H", "hsp", [STAY], [TWO]), 3, 3)
    alone = replace(whole, players=(replace(whole.players[0], mate=whole.players[1]),))
    result = played(Casting((group("e", None, [STAY]),), (alone,)))
    assert result.partner_mates[:, :, 0].tolist() == [[12, 120]] and result.scores.shape[:2] == (1, 1)
    report = to_dict(result)
    assert report["reference"][0]["of"] == ["mate"] * 2
    assert [player["mate"] for player in report["partners"][0]["players"]] == [2]


def test_egos_of_a_pair_have_their_mate_as_a_control() -> None:
    egos = (pair_up(group("H", "hsp", [STAY], [TWO]), 1, 1),)
    result = played(Casting(egos, (group("p", None, [ONE]),)))
    assert result.ego_mates[:, :, 0].tolist() == [[12, 120], [120, 12]]
    assert to_dict(result)["controls"]["egos"][0]["mate"]["mean"] == 66.0


def test_copies_of_a_policy_are_played_once_and_count_once() -> None:
    """P holds ONE twice, Q holds it again and STAY: beside an ego that stays P 1 gives 60 and 6, Q 2 nothing."""
    first, second = group("P", "lipo", [ONE], [ONE]), group("Q", "mappo", [ONE], [STAY])
    copies = [replace(one, identity="same") for one in (*first.players, second.players[0])]
    partners = (replace(first, players=(*copies[:2],)), replace(second, players=(copies[2], second.players[1])))
    egos = group("e", None, [STAY], [STAY])
    egos = replace(egos, players=tuple(replace(one, identity="ego") for one in egos.players))
    result = played(Casting((egos,), partners), episodes=2)
    assert result.steps == (2 * (1 + 2 * 3) + 1 + 2 * 2) * 2 * HORIZON  # of two partners and one ego
    assert result.scores.shape == (2, 4, 2, 2) and np.array_equal(result.scores[0, 0], result.scores[1, 2])
    sets = {one.label: one.columns for one in list_sets(result, egos)}
    assert sets == {"P": (0,), "Q": (2, 3), ALL: (0, 3)}
    assert result.casting.rows("e") == [0]
    standing = describe_standing(result, egos, PartnerSet(ALL, (0, 3)))
    assert standing.count == 2 and standing.score.mean == (60 + 6 + 0 + 0) / 4 and standing.score.count == 8
    report = to_dict(result)
    assert "2 of 4 partners are copies of others, which count once in a set." in report["notes"]
    assert "1 of 2 players of egos are copies of others, which count once in a set." in report["notes"]
    assert report["controls"]["partners"][0]["alone"]["se"] == 0.0
    assert any("(0 of 2 partners)" in note for note in report["notes"])


def test_the_report_tells_how_best_responses_were_trained(result: HoldoutResult) -> None:
    report = to_dict(result)
    told = report["partners"][0]["players"][0]["response"]
    assert told == {"source": "here", "scale": "demo", "settings": {"ego.steps": 9}, "steps": 12_000}
    assert report["partners"][1]["players"][0]["response"] is None
    assert "Best responses (1) were trained with scale=demo, ego.steps=9: 12,000 steps each." in report["notes"]
    assert any("(1 of 4 partners)" in note for note in report["notes"])


def test_margins_are_over_the_control_with_the_same_partners(result: HoldoutResult) -> None:
    (first, *_) = measure_margins(result, "base")
    # ego's mean over its seeds is 123 and 42, the control's 120 and 12: gains of 3 and 30.
    assert (first.ego, first.partners, first.gain.value) == ("ego", "L", pytest.approx(16.5))
    # Beside one partner the ego's seeds alone are drawn, which gain 33 and 0: a quarter of the draws is of one alone.
    assert first.resampled == ("ego's seeds",) and (first.gain.low, first.gain.high) == (0.0, 33.0)
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
    assert any("1 of 4 partners have no reference" in line for line in list_lines(report))
    assert any(line.startswith("Intervals (95 %) of margins draw partners anew") for line in list_lines(report))
    assert not any("margins" in line for line in list_lines(to_dict(result)))
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
