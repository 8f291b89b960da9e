"""HSP and BP: which pairs of the pool become members, and for whom the pool's steps count."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from support.stand_in_mappo import StandInMappo

from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.envs.player_events import BR_DIV_EVENTS, SPARSE_REWARD
from popgen.methods.mappo import train as module
from popgen.methods.mappo.hsp import HspTraining, level_totals
from popgen.methods.mappo.play_record import Counted
from popgen.methods.registry import recipe
from popgen.methods.training import Checkpoint, Progress, Round, TrainedMember
from popgen.types import Kind

SPEC = make_env("overcooked/cramped_room", 1, horizon=40).spec
ROUNDS = 3


def count_pairs(pool: int, runners: int = 1) -> list[Counted]:
    """An iteration of all pairs: 101 steps and 3 episodes of each in every runner."""
    return [
        Counted(runner, pair, Kind.SP, 101, 3, float(pair)) for runner in range(runners) for pair in range(1, pool + 1)
    ]


def make_training(
    monkeypatch: pytest.MonkeyPatch, size: int, scores: dict[int, float], *, runners: int = 1, **given: Any
) -> HspTraining:
    """A run of pairs with these scores; pair p, and its biased agent, do p times event 0 and something of event p."""
    pool, hsp = len(scores), {key: value for key, value in given.items() if key != "method"}
    sections = {"population": {"size": size}, "ppo": {"units": 8, "layers": 1}, "hsp": {"pool": pool, **hsp}}
    config: Any = RunConfig.parse({"method": given.get("method", "hsp"), **sections})
    training = HspTraining(config, SPEC, "test.1")
    habits = {}
    for pair in scores:
        habits[pair] = habits[pair + pool] = np.eye(len(training.names))[pair % len(training.names)] * pair
    iterations, trained = [count_pairs(pool, runners)] * ROUNDS, range(1, 2 * pool + 1)
    told = {pair: (score,) for pair, score in scores.items()}
    stand_in = StandInMappo(SPEC, config.ppo, trained, iterations, told, habits)
    monkeypatch.setattr(module, "build_algorithm", lambda *given: stand_in)
    training.begin(1)
    return training


def chosen_of(training: HspTraining) -> list[int]:
    training.algorithm.rounds = ROUNDS
    return training.choose_pairs()


@pytest.mark.parametrize("method", ["hsp", "bp"])
def test_pairs_that_deliver_nothing_are_dropped_however_different_they_are(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pairs 5 and 6 do the most: without the filter they are chosen. A score at the limit is too little."""
    scores = {1: 9.0, 2: 0.2, 3: 11.0, 4: 8.0, 5: 0.1, 6: 0.0}
    select = {"hsp": "events", "bp": "responses"}[method]
    given: dict[str, Any] = {"method": method, "select": select}
    free = chosen_of(make_training(monkeypatch, 4, scores, least_score=None, **given))
    assert set(free) & {5, 6}
    training = make_training(monkeypatch, 4, scores, least_score=0.1, **given)
    found = chosen_of(training)
    assert len(found) == 2 and set(found) <= {1, 2, 3, 4}
    assert training.rank_pairs() == ([1, 2, 3, 4], [5, 6])
    assert chosen_of(make_training(monkeypatch, 8, scores, **given)) == [1, 2, 3, 4]


def test_without_pairs_to_drop_the_choice_is_as_without_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    scores = {pair: 5.0 + pair for pair in range(1, 7)}
    free, limited = (make_training(monkeypatch, 6, scores, least_score=least) for least in (None, 0.1))
    assert chosen_of(free) == chosen_of(limited)


def test_where_too_few_deliver_the_best_of_the_rest_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """One pair delivers, three are wanted; pair 4 has ended no episode and is the last choice."""
    training = make_training(monkeypatch, 6, {1: 0.0, 2: 0.05, 3: 9.0, 4: 0.0, 5: 0.04})
    training.algorithm.told = {**training.algorithm.told, 4: ()}  # type: ignore[attr-defined]
    assert chosen_of(training) == [2, 3, 5] and training.rank_pairs() == ([3], [2, 5, 1, 4])


def test_responses_are_compared_by_the_kinds_of_br_div(monkeypatch: pytest.MonkeyPatch) -> None:
    """Moves and idle interacts are none of them; deliveries stand for the reward beside themselves."""
    training = make_training(monkeypatch, 4, {1: 9.0, 2: 8.0, 3: 11.0}, method="bp", select="responses")
    counts = dict.fromkeys(training.names, 1.0) | {"delivery": 7.0, "MOVEMENT": 300.0, "IDLE_MOVEMENT": 40.0}
    monkeypatch.setattr(training, "count_events", lambda pair: np.array(list(counts.values())))
    found = dict(zip(BR_DIV_EVENTS, training.count_response(1), strict=True))
    assert found == dict.fromkeys(BR_DIV_EVENTS, 1.0) | {"delivery": 7.0, SPARSE_REWARD: 7.0}


def test_what_was_dropped_is_said_and_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    def end(scores: dict[int, float]) -> tuple[str, list[TrainedMember]]:
        records = list(make_training(monkeypatch, 4, scores).train())
        members = [one for one in records if isinstance(one, TrainedMember)]
        notes = [one.note for one in records if isinstance(one, Progress) and one.note]
        assert records.index(members[0]) > max(n for n, one in enumerate(records) if isinstance(one, Progress))
        return " ".join(notes), members

    said, members = end({1: 9.0, 2: 0.0, 3: 11.0, 4: 8.0})
    assert said == "1 of 4 pairs with a score of at most 0.1 dishes: dropped"
    assert [one.extra["dropped"] for one in members] == [1] * 4 and {one.extra["pair"] for one in members} <= {1, 3, 4}
    said, members = end({1: 0.0, 2: 0.0, 3: 11.0, 4: 0.0})
    kept = "too few others for 2 pairs, so the best of them are kept (pair 1)"
    assert said == f"3 of 4 pairs with a score of at most 0.1 dishes: {kept}"
    assert [(one.extra["pair"], one.extra["dropped"]) for one in members] == [(1, 2), (1, 2), (3, 2), (3, 2)]
    said, members = end({1: 9.0, 2: 8.0, 3: 11.0, 4: 8.0})
    assert not said and members[0].extra["dropped"] == 0


def test_recipes_drop_what_zsc_eval_drops() -> None:
    """Nothing delivered for HSP, ten points of twenty a dish for the responses."""
    room, limits = "overcooked/cramped_room", {"hsp": 0.1, "bp": 0.5}
    assert {name: recipe(name, room, "laptop").hsp.least_score for name in limits} == limits  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("amount", "before", "parts"),
    [
        (12, [0, 0, 0], [4, 4, 4]),
        (5, [0, 0, 0], [2, 2, 1]),
        (5, [2, 2, 1], [1, 1, 3]),
        (0, [2, 2, 1], [0, 0, 0]),
        (3, [9, 0, 1], [0, 2, 1]),  # whoever has too much gets nothing until the others have it too
    ],
)
def test_totals_are_levelled(amount: int, before: list[int], parts: list[int]) -> None:
    assert level_totals(amount, dict(enumerate(before))) == parts


def test_totals_stay_level_and_exact() -> None:
    rng, totals = np.random.default_rng(0), dict.fromkeys(range(7), 0)
    for amount in map(int, rng.integers(0, 50, 60)):
        before = sum(totals.values())
        parts = level_totals(amount, totals)
        assert min(parts) >= 0
        totals = {name: had + part for (name, had), part in zip(totals.items(), parts, strict=True)}
        assert sum(totals.values()) == before + amount and np.ptp(list(totals.values())) <= 1


@pytest.mark.parametrize(("pool", "size"), [(12, 8), (6, 8), (3, 2), (1, 1)])
@pytest.mark.parametrize("runners", [1, 2])
def test_a_pools_steps_are_shared_evenly_and_counted_once(
    pool: int, size: int, runners: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever pool and size: totals differ by one step at most, and steps, episodes and scores add up."""
    training = make_training(monkeypatch, size, dict.fromkeys(range(1, pool + 1), 5.0), runners=runners, biases=1)
    monkeypatch.setattr(training, "finish_members", lambda: iter(()))
    counts = [one for record in training.train() if isinstance(record, Progress) for one in record.counted]
    steps, episodes = Counter[int](), Counter[int]()
    for one in counts:
        steps[one.member] += one.steps
        episodes[one.member] += one.episodes
    played = runners * ROUNDS * pool
    assert sum(steps.values()) == 101 * played and sum(episodes.values()) == 3 * played
    assert set(steps) == set(range(1, size + 1)) and max(steps.values()) - min(steps.values()) <= 1
    assert max(episodes.values()) - min(episodes[member] for member in steps) <= 1
    assert sum(one.score for one in counts) == pytest.approx(runners * ROUNDS * sum(range(1, pool + 1)))
    assert len({(one.member, one.kind, one.sampler, one.sequence) for one in counts}) == len(counts)
    assert dict(steps) == training.progress.steps


def test_shares_go_on_from_a_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same counts as without an interruption after the first iteration."""

    def counts_of(training: HspTraining) -> list[Any]:
        monkeypatch.setattr(training, "finish_members", lambda: iter(()))
        return [one for record in training.train() if isinstance(record, Progress) for one in record.counted]

    scores = dict.fromkeys(range(1, 4), 5.0)
    whole, early, again = (make_training(monkeypatch, 2, scores) for _ in range(3))
    expected = counts_of(whole)
    next(record for record in early.train() if isinstance(record, Round))
    again.restore(Checkpoint(early.checkpoint()))
    assert again.episodes == early.episodes and counts_of(again) == expected[-4:]


def test_shares_of_an_earlier_version_are_levelled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its checkpoint has no episodes, and gave the first of two members the steps of two of three pairs."""
    before, training = (make_training(monkeypatch, 2, dict.fromkeys(range(1, 4), 5.0)) for _ in range(2))
    before.algorithm.train()
    before.progress.steps = {1: 202, 2: 101}
    state = before.checkpoint()
    del state["episodes"]
    training.restore(Checkpoint(state))
    monkeypatch.setattr(training, "finish_members", lambda: iter(()))
    list(training.train())
    assert sorted(training.progress.steps.values()) == [454, 455] and sum(training.episodes.values()) == 2 * 9


def test_curves_are_those_of_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """No member has a score before the end, when it is known which pair it is of."""
    training = make_training(monkeypatch, 4, {1: 9.0, 2: 0.0, 3: 11.0})
    rows = [one for one in training.train() if isinstance(one, Progress) and one.figures]
    points = [row for row in rows if "pair_1/sp" in row.figures]
    assert len(points) == ROUNDS and {row.member for row in points} == {1}
    last = points[-1].figures
    by_pair = {name: value for name, value in last.items() if name.startswith("pair")}
    assert by_pair == {"pair_1/sp": 9.0, "pair_2/sp": 0.0, "pair_3/sp": 11.0}
    assert last["ppo/entropy"] == 2.0 and not any("real_sp" in row.figures for row in rows)
    assert points[-1].steps == ROUNDS * 3 * 101 // 4
