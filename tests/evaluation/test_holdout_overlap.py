"""What egos and hold-out partners may not have in common, and what may pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from support.scripted import ONE, Script

from popgen.actors.ego_workers import describe_partners, read_partner
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.evaluation.holdout_lineages import (
    NO_WEIGHTS,
    Lineage,
    People,
    identify_member,
    is_on_record,
    read_partners,
    read_people,
)
from popgen.evaluation.holdout_overlap import check_disjoint, check_met
from popgen.evaluation.holdout_players import EGO, Group, Player, open_sides, seat_mates
from popgen.methods.mappo.config import MappoRun
from popgen.methods.mappo.method import MAPPO
from popgen.methods.registry import METHODS
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.population import PopulationWriter, load_population
from popgen.reports.reproduction.run_lists import list_egos, list_generators
from popgen.reports.reproduction.target_records import Budget, WantedRun
from popgen.reports.reproduction.target_registry import BUDGETS

HALF_A = People("cramped_room", "A", frozenset({1, 3, 4}))
HALF_B = People("cramped_room", "B", frozenset({2, 13, 14}))

MAPPO_LEARNER = ("mappo", "lipo", "comedi", "fcp", "mep", "trajedi", "hsp", "bp", "brdiv", "e3t")
WORLD_MODEL = ("xpm_wm", "fcp_wm", "mep_wm")


def trained(
    label: str,
    method: str,
    seed: int,
    digests: set[str],
    *partners: Lineage,
    config: str = "c",
    people: People | None = None,
) -> Group:
    """A group of members with these weights, who were trained with `partners`."""
    own = Lineage(method, seed, config, frozenset(digests), people=frozenset([people] if people else []))
    players = tuple(
        Player(label, label, number, digest, lambda: Script([ONE]))  # type: ignore[arg-type, return-value]
        for number, digest in enumerate(sorted(digests), 1)
    )
    return Group(label, method, players, (own,), partners)


def met(method: str, seed: int, digests: str = "", config: str = "c", people: People | None = None) -> Lineage:
    return Lineage(method, seed, config, frozenset(digests), people=frozenset([people] if people else []))


def refused(ego: Group, partner: Group, told: str) -> None:
    with pytest.raises(UserError) as caught:
        check_disjoint([ego], [partner])
    assert told in str(caught.value), caught.value


# --- members and teachers


def test_shared_members_training_partners_and_seeds_are_refused() -> None:
    ego = trained("ego", "ego_fcp", 7, {"e"}, met("lipo", 1, "ab"))
    check_disjoint([ego], [trained("held", "lipo", 2, {"x"}), trained("other", "xpm_wm", 1, {"y"})])
    refused(ego, trained("held", "lipo", 2, {"b"}), "member 1 is a training partner of the ego ego")
    refused(ego, trained("held", "lipo", 2, {"e"}), "member 1 is the ego ego itself")
    refused(ego, trained("held", "lipo", 1, {"z"}), "held: has seed 1 of lipo, which the ego ego is trained with; hold")
    refused(trained("own", "lipo", 3, {"m"}), trained("held", "lipo", 3, {"z"}), "which the ego own is itself of")


def test_only_who_taught_an_ego_is_a_training_partner() -> None:
    ego = trained("ego", "ego_fcp", 7, {"e"}, met("lipo", 1, "ab"))
    check_met([trained("none", "ego_fcp", 8, {"n"}), ego], [trained("taught", "lipo", 1, {"a", "b"})])
    with pytest.raises(UserError, match="--met.*some has members that trained none of the egos"):
        check_met([ego], [trained("some", "lipo", 1, {"a", "c"})])


def test_what_a_partner_was_trained_with_counts_as_well() -> None:
    teachers = met("lipo", 1, "ab")
    ego = trained("ego", "ego_fcp", 7, {"e"}, teachers)
    refused(ego, trained("pupil", "hipt", 8, {"x"}, met("mep_wm", 9, "bz")), "pupil: was trained with members that")
    refused(ego, trained("response", "br", 8, {"x"}, met("hipt", 9, "e")), "was trained with the ego ego itself")
    refused(
        ego, trained("pupil", "hipt", 8, {"x"}, met("lipo", 1, "z")), "pupil: was trained with seed 1 of lipo, which"
    )
    refused(ego, trained("pupil", "hipt", 8, {"x"}, met("hipt", 7, "z")), "from the same weights as seed 7 of ego_fcp")
    check_disjoint([ego], [trained("pupil", "hipt", 8, {"x"}, met("lipo", 2, "z"))])


def test_members_beside_whom_a_teacher_learned_count_too() -> None:
    """A population that continues another one holds its members, whatever its seed."""
    teacher = Lineage("xpm_wm", 2, "c", frozenset("d"), population=frozenset("abcd"))
    ego = trained("ego", "ego_fcp", 7, {"e"}, teacher)
    refused(ego, trained("held", "xpm_wm", 1, {"a"}), "member 1 is of a population that trained the ego ego")
    refused(ego, trained("pupil", "hipt", 8, {"x"}, met("xpm_wm", 1, "b")), "was trained with members that trained the")


def test_those_without_weights_have_learned_nothing_from_each_other() -> None:
    ego = trained("ego", "ego_fcp", 7, {NO_WEIGHTS}, met("lipo", 1))
    without = Lineage("by_hand", 3, "c", frozenset())
    group = trained("held", "by_hand", 3, {NO_WEIGHTS})
    check_disjoint([Group("ego", None, ego.players)], [Group("held", "by_hand", group.players, (without,))])


# --- learners that start from the same weights


def test_families_follow_from_the_schemas_of_the_registry() -> None:
    families: dict[str, list[str]] = {}
    for name, method in METHODS.items():
        families.setdefault(method.family, []).append(name)
    assert set(map(frozenset, families.values())) >= {frozenset(MAPPO_LEARNER), frozenset(WORLD_MODEL)}
    assert set(families) >= {"popgen.methods.xpm_sim", "popgen.methods.ego"}


def test_a_method_of_others_on_our_learner_is_of_its_family() -> None:
    class Mixin:
        pass

    class TheirRun(MappoRun, Mixin):
        pass

    theirs = replace(MAPPO, name="of_others", config=TheirRun)
    assert theirs.family == METHODS["lipo"].family == "popgen.methods.mappo"


@pytest.mark.parametrize("family", [MAPPO_LEARNER, WORLD_MODEL])
def test_one_seed_of_one_learner_is_refused_whatever_the_method(family: tuple[str, ...]) -> None:
    for teacher in family:
        ego = trained("ego", "ego_fcp", 7, {"e"}, met(teacher, 1, "ab"))
        for method in family:
            told = f"held: has seed 1 of {method}"
            if method != teacher:
                told += f", which starts from the same weights as seed 1 of {teacher}"
            refused(
                ego, trained("held", method, 1, {"x"}), f"{told}, which the ego ego is trained with; hold out another"
            )
            check_disjoint([ego], [trained("held", method, 2, {"x"})])


def test_learners_that_share_nothing_may_have_one_seed() -> None:
    ego = trained("ego", "ego_fcp", 1, {"e"}, met("xpm_sim", 1, "ab"))
    check_disjoint([ego], [trained("wm", "xpm_wm", 1, {"x"}), trained("lipo", "lipo", 1, {"y"})])
    refused(
        ego, trained("other", "hipt", 1, {"x"}), "seed 1 of hipt, which starts from the same weights as seed 1 of ego_"
    )


def test_methods_that_nobody_knows_are_told_apart_by_their_configuration() -> None:
    ego = trained("ego", "ego_fcp", 7, {"e"}, met("of_others", 1, config="c"))
    check_disjoint([ego], [trained("held", "of_others", 1, {"x"}, config="d"), trained("b", "of_others", 2, {"x"})])
    refused(ego, trained("held", "of_others", 1, {"x"}), "has seed 1 of of_others")


# --- clones of people


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("config", ["c", "of another search"])
def test_clones_of_the_same_games_are_refused_whatever_seed_and_search(seed: int, config: str) -> None:
    ego = trained("ego", "ego_fcp", 7, {"e"}, met("human_clone", 0, "a", people=HALF_A))
    told = "people: has clones of people (half A of cramped_room) of whom the ego ego or its teachers are clones too"
    refused(ego, trained("people", "human_clone", seed, {"b"}, config=config, people=HALF_A), told)
    some = People("cramped_room", "A", frozenset({4, 9}))
    refused(ego, trained("people", "human_clone", seed, {"b"}, config=config, people=some), told)
    refused(
        ego, trained("pupil", "hipt", 3, {"x"}, met("human_clone", seed, "b", config, HALF_A)), "was trained with clo"
    )
    for others in (HALF_B, People("cramped_room", "A", frozenset({9})), People("forced", "A", HALF_A.games)):
        check_disjoint([ego], [trained("people", "human_clone", 0, {"b"}, people=others)])


def test_clones_on_a_record_without_games_are_known_by_their_configuration() -> None:
    ego = trained("ego", "ego_fcp", 7, {"e"}, met("human_clone", 0, "a", "half A"))
    refused(ego, trained("people", "human_clone", 5, {"b"}, config="half A", people=HALF_A), "half A of cramped_room")
    check_disjoint([ego], [trained("people", "human_clone", 0, {"b"}, config="half B", people=HALF_B)])


def test_people_are_read_from_a_record() -> None:
    extra = {"layout": "cramped_room", "half": "A", "games": [4, 1, 3], "search": {"drawn": 2}}
    assert read_people("place", extra) == HALF_A and read_people("place", {"layout": "x"}) is None
    assert read_people("place", HALF_A.as_dict()) == HALF_A
    for wrong in (3, ["first"], None):
        with pytest.raises(UserError, match="layout, half, games"):
            read_people("place", {**extra, "games": wrong})


# --- records


def test_what_an_ego_was_trained_with_is_read_from_its_record() -> None:
    record = {"method": "lipo", "seed": 1, "config_digest": "c", "members": [1, 2], "policy_sha256": ["a", "b"]}
    assert read_partners("place", {"trained_with": [record]}) == [Lineage("lipo", 1, "c", frozenset("ab"))]
    assert read_partners("place", {}) == []
    clone = {**record, "method": "human_clone", "people": [HALF_A.as_dict()], "population_sha256": ["a", "b", "z"]}
    ego = {**record, "method": "hipt", "seed": 4, "policy_sha256": ["h"], "trained_with": [record, clone]}
    assert read_partners("place", {"trained_with": [ego]}) == [
        Lineage("hipt", 4, "c", frozenset("h")),
        Lineage("lipo", 1, "c", frozenset("ab")),
        Lineage("human_clone", 1, "c", frozenset("ab"), frozenset("abz"), frozenset([HALF_A])),
    ]


@pytest.mark.parametrize(
    "wrong",
    [
        "text",
        [{"method": "lipo"}],
        [3],
        7,
        [{"method": "hipt", "seed": 1, "config_digest": "c", "policy_sha256": ["a"], "trained_with": [3]}],
        [{"method": "hipt", "seed": 1, "config_digest": "c", "policy_sha256": ["a"], "people": 3}],
        [{"method": "hipt", "seed": 1, "config_digest": "c", "policy_sha256": ["a"], "population_sha256": 3}],
    ],
)
def test_a_record_of_another_form_is_told_in_one_line(wrong: object) -> None:
    with pytest.raises(UserError, match="place: .*cannot be read"):
        read_partners("place", {"trained_with": wrong})


def test_what_is_not_on_record_is_known() -> None:
    lipo = {"method": "lipo"}
    assert not is_on_record({}) and is_on_record({"trained_with": []}) and is_on_record({"trained_with": [lipo]})
    old_ego, old_clone = {"method": "hipt"}, {"method": "human_clone"}
    assert not is_on_record({"trained_with": [lipo, old_ego]}) and not is_on_record({"trained_with": [old_clone]})
    assert is_on_record({"trained_with": [{**old_ego, "trained_with": [lipo]}, {**old_clone, "people": [{}]}]})
    assert not is_on_record({"trained_with": [{**old_ego, "trained_with": [old_ego]}]})


Make = Callable[..., Path]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """(name, method, seed, weights' seeds, extra of all members) -> a population of untrained members."""
    spec = make_env("overcooked/cramped_room", 1, horizon=20).spec

    def make_population(name: str, method: str, seed: int, weights: tuple[int, ...], **extra: object) -> Path:
        writer = PopulationWriter(tmp_path / name, spec, method=method, config_digest="0" * 64, seed=seed)
        for number in weights:
            policy = FeedForwardPolicy(spec.views["features"], spec.num_actions, units=8, seed=number)
            writer.add_member(policy, seed=number, steps={"SP": 1}, extra=extra)
        return tmp_path / name

    return make_population


def teach(*teachers: str) -> list[dict[str, object]]:
    """As an ego's record lists these populations (or some members of them)."""
    return [source.as_dict() for source in describe_partners([read_partner(text) for text in teachers])]


def open_both(ego: Path | str, held: Path | str) -> tuple[tuple[Group, ...], tuple[Group, ...]]:
    opened = open_sides({EGO: [("ego", str(ego))], "partner": [("held", str(held))]}, str)
    return opened.sides[EGO], opened.sides["partner"]


def test_an_egos_record_tells_of_its_teachers_teachers_and_of_all_their_population(make: Make) -> None:
    """An ego of member 3 of a population, and an ego of that ego: held against members 1 and 2, or clones."""
    lipo = make("lipo", "lipo", 1, (1, 2, 3))
    first = make("first", "hipt", 5, (10,), trained_with=teach(f"{lipo}:3"))
    second = make("second", "hipt", 6, (11,), trained_with=teach(str(first)))
    for ego in (first, second):
        with pytest.raises(UserError, match="held|lipo"):
            check_disjoint(*open_both(ego, lipo))
    with pytest.raises(UserError, match="member 1 is a training partner of the ego ego"):
        check_disjoint(*open_both(second, first))
    with pytest.raises(UserError, match="held: was trained with the ego ego itself"):
        check_disjoint(*open_both(first, second))
    continued = make("continued", "lipo", 2, (1, 2, 7))
    with pytest.raises(UserError, match="member 1 is of a population that trained the ego ego"):
        check_disjoint(*open_both(second, continued))
    check_disjoint(*open_both(second, make("other", "lipo", 2, (20, 21))))
    (group,) = open_both(second, lipo)[0]
    assert group.on_record and group.taught_by == {"hipt", "lipo"}


def test_of_chosen_members_the_whole_population_counts(make: Make) -> None:
    """Members 1 and 2 of an ego's teachers go on in another population, whose member 3 is new."""
    lipo = make("lipo", "lipo", 1, (1, 2))
    ego = make("ego", "hipt", 5, (10, 11), trained_with=teach(f"{lipo}:1"))
    continued = make("continued", "lipo", 2, (1, 2, 7))
    with pytest.raises(UserError, match="held: is of a population that holds members of the ego ego or of those that"):
        check_disjoint(*open_both(f"{ego}:2", f"{continued}:3"))
    with pytest.raises(UserError, match="held: has seed 1 of lipo"):
        check_disjoint(*open_both(f"{ego}:2", f"{make('seed', 'lipo', 1, (8, 9))}:2"))
    egos, partners = open_both(f"{ego}:2", f"{make('other', 'lipo', 2, (20, 21, 22))}:3,1")
    check_disjoint(egos, partners)
    assert [one.member for one in egos[0].players] == [2] and [one.member for one in partners[0].players] == [3, 1]
    check_met(egos, open_both(ego, f"{lipo}:1")[1])
    with pytest.raises(UserError, match="trained none of the egos"):
        check_met(egos, open_both(ego, lipo)[1])


def test_members_of_one_population_may_have_several_names_and_each_counts_once(make: Make) -> None:
    ego, held = make("ego", "hipt", 5, (10,)), make("held", "lipo", 2, (1, 2, 3))

    def open_partners(*named: tuple[str, str]) -> list[tuple[str, list[int], int]]:
        groups = open_sides({EGO: [("ego", str(ego))], "partner": named}, str).sides["partner"]
        return [(one.label, [player.member for player in one.players], len(one.lineages)) for one in groups]

    assert open_partners(("a", f"{held}:1"), ("b", f"{held}:3,2")) == [("a", [1], 1), ("b", [3, 2], 1)]
    assert open_partners(("a", f"{held}:1"), ("a", f"{held}:3")) == [("a", [1, 3], 1)]
    for other in ("a", "b"):
        with pytest.raises(UserError, match="held: member 1 is given twice"):
            open_partners(("a", f"{held}:1"), (other, str(held)))


def test_the_mate_of_a_chosen_member_stays_its_mate(make: Make, tmp_path: Path) -> None:
    """Two pairs of HSP: of members 1 and 4 both mates are not chosen, of 1 and 2 each is the other's."""
    spec = make_env("overcooked/cramped_room", 1, horizon=20).spec
    writer = PopulationWriter(tmp_path / "pairs", spec, method="hsp", config_digest="0" * 64, seed=3)
    for number in range(4):
        policy = FeedForwardPolicy(spec.views["features"], spec.num_actions, units=8, seed=number)
        extra = {"pair": 1 + number // 2, "role": ("biased", "partner")[number % 2]}
        writer.add_member(policy, seed=number, steps={}, extra=extra)
    ego = make("ego", "hipt", 5, (10,))
    for chosen, mates, beside in (("1,4", [2, 3], [2, 3]), ("1,2", [1, 0], []), ("2", [1], [1])):
        (group,) = open_both(ego, f"{tmp_path / 'pairs'}:{chosen}")[1]
        everybody, places = seat_mates(group.players)
        assert (places, [one.member for one in everybody[len(group.players) :]]) == (mates, beside)


def test_a_clones_games_reach_an_egos_record(make: Make) -> None:
    people = HALF_A.as_dict()
    clones = make("A", "human_clone", 0, (1,), **people)
    ego = make("ego_A", "hipt", 5, (10,), trained_with=teach(str(clones)))
    with pytest.raises(UserError, match="has clones of people .half A of cramped_room."):
        check_disjoint(*open_both(ego, make("A1", "human_clone", 1, (2,), **people)))
    check_disjoint(*open_both(ego, make("B", "human_clone", 0, (2,), **HALF_B.as_dict())))
    assert open_both(ego, clones)[0][0].on_record


def test_an_egos_record_of_an_earlier_version_is_loaded(make: Make) -> None:
    new = ("identity", "population_sha256", "people", "trained_with")
    lipo = make("lipo", "lipo", 1, (1, 2, 3))
    old = [{name: value for name, value in one.items() if name not in new} for one in teach(f"{lipo}:1")]
    ego = make("ego", "hipt", 5, (10,), trained_with=old)
    with pytest.raises(UserError, match="member 1 is a training partner"):
        check_disjoint(*open_both(ego, lipo))
    check_disjoint(*open_both(ego, make("next", "lipo", 2, (4, 5))))
    assert open_both(ego, lipo)[0][0].on_record
    pupil = [{name: value for name, value in one.items() if name not in new} for one in teach(str(ego))]
    assert not open_both(make("pupil", "hipt", 6, (11,), trained_with=pupil), lipo)[0][0].on_record


def test_whom_ordinary_members_have_met_is_known(make: Make) -> None:
    lipo, clones = make("lipo", "lipo", 1, (1, 2)), make("A", "human_clone", 0, (3,), **HALF_A.as_dict())
    silent = make("silent", "human_clone", 0, (4,))
    assert open_both(lipo, make("next", "lipo", 2, (5,)))[0][0].on_record
    assert open_both(clones, lipo)[0][0].on_record and not open_both(silent, lipo)[0][0].on_record


def test_a_members_identity_is_all_that_decides_how_it_acts(make: Make) -> None:
    info = load_population(make("some", "lipo", 1, (1,))).info(1)
    same = identify_member(info.model_copy(update={"seed": 9, "extra": {"a": 1}}), "rules")
    assert identify_member(info, "rules") == same
    changed = [
        identify_member(info, "other rules"),
        identify_member(info.model_copy(update={"config": {**info.config, "greedy": True}}), "rules"),
        identify_member(info.model_copy(update={"kind": "other"}), "rules"),
        identify_member(info.model_copy(update={"policy_sha256": "0" * 64}), "rules"),
    ]
    assert len({same, *changed}) == 5


# --- what is published


def describe_wanted(run: WantedRun) -> Lineage:
    return Lineage(run.method, run.seed, "c", frozenset({f"{run.words}{run.seed}"}))


@pytest.mark.parametrize("budget", BUDGETS.values(), ids=BUDGETS.keys())
@pytest.mark.parametrize("seeds", [(1,), (1, 2, 3)])
def test_the_egos_of_popgen_reproduce_have_met_none_of_their_holdouts(budget: Budget, seeds: tuple[int, ...]) -> None:
    egos = [run for listed in (list_egos, list_generators) for run in listed(budget, seeds) if run.holdouts]
    assert egos
    people = trained("people", "human_clone", 0, {"p"}, people=HALF_B)
    for run in egos:
        ego = trained("ego", run.method, run.seed, {"e"}, *map(describe_wanted, run.teachers))
        held = [trained(one.row, one.method, one.seed, {f"{one.words}{one.seed}"}) for one in run.holdouts]
        check_disjoint([ego], [*held, people])
