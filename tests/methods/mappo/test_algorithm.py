"""RLlib's algorithm on a small Ray: counting, choosing partners, runners that die, going on."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import ray
from ray.train.constants import DEFAULT_STORAGE_PATH

from popgen.config.run_config import RunConfig
from popgen.config.sections import ClusterConfig, EnvConfig
from popgen.envs import make_env
from popgen.methods.mappo import algorithm as module
from popgen.methods.mappo.algorithm import Mappo, MappoConfig
from popgen.methods.mappo.brdiv import BrdivTraining
from popgen.methods.mappo.config import DiversityConfig, PpoConfig
from popgen.methods.mappo.play_record import PlayRecord
from popgen.methods.mappo.pooling import Plan
from popgen.methods.mappo.slots import Rollout
from popgen.methods.mappo.training_job import Job
from popgen.play.rollout import Match
from popgen.types import Kind

HORIZON = 20
ENV = EnvConfig(params={"horizon": HORIZON})
PPO = PpoConfig(
    units=16, layers=1, envs=4, steps=10, epochs=1, minibatches=2, max_steps=400, window=4, target_score=1e9
)
CROSS = DiversityConfig(xp_envs=4, mp_envs=2, warmup=4, select_every=2, select_episodes=3, partner_random=0.0)
SPEC = make_env(ENV.name, 1, **ENV.params).spec
SOLO = Job(ENV, PPO, None, (1,), seed=1)
pytestmark = pytest.mark.usefixtures("cluster")


def build(job: Job, **cluster: Any) -> Mappo:
    return MappoConfig.of(job, SPEC, ClusterConfig(sampler_cpus=0.1, **cluster)).build_algo()


def later(algorithm: Mappo, **options: Any) -> Job:
    """Member 3 after two frozen ones, both with the weights of the algorithm's only member."""
    weights = algorithm.actors()[1]
    other = {name: -array for name, array in weights.items()}
    values = {"mixed": True, "fresh": True, "frozen": {1: weights, 2: other}} | options
    return Job(ENV, PPO, CROSS, (3,), seed=2, **values)


@pytest.fixture(scope="module")
def solo(cluster: None) -> Iterator[Mappo]:
    algorithm = build(SOLO)
    yield algorithm
    algorithm.stop()


@pytest.fixture(scope="module")
def comedi(solo: Mappo) -> Iterator[Mappo]:
    algorithm = build(later(solo))
    yield algorithm
    algorithm.stop()


def test_rllib_takes_the_largest_seed_of_a_run_and_small_ones_as_they_are(solo: Mappo) -> None:
    assert solo.config.seed == 1
    large = build(Job(ENV, PPO, None, (1,), seed=(2**31 - 1) * 1000 + 1000))
    large.train()
    assert totals(large) == {(1, "SP"): 40}
    large.stop()


def test_brdiv_without_weight_has_the_ledger_of_pairs_alone() -> None:
    sections = {"population": {"size": 4}, "ppo": PPO.model_dump(), "brdiv": {"alpha": 0.0}, "run": {"seed": 3}}
    config: Any = RunConfig.parse({"method": "brdiv", "env": ENV.model_dump(), **sections})
    brdiv = BrdivTraining(config, SPEC, "test.1").make_job()
    pairs = Job(ENV, PPO, None, (1, 2, 3, 4), seed=3001, pairs={1: 3, 2: 4})
    counted = []
    for job in (brdiv, pairs):
        algorithm = build(job)
        for _ in range(3):
            algorithm.train()
        counted.append(algorithm.report.counted)
        assert totals(algorithm) == {(1, "SP"): 40, (2, "SP"): 40}
        algorithm.stop()
    assert counted[0] == counted[1] and sum(one.episodes for one in counted[0])


def totals(algorithm: Mappo) -> dict[tuple[int, str], int]:
    found: Counter[tuple[int, str]] = Counter()
    for counted in algorithm.report.counted:
        found[counted.owner, str(counted.kind)] += counted.steps
    return dict(found)


def seen(algorithm: Mappo, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Rollout]]:
    """What the local runner returns from now on."""
    rollouts: list[tuple[str, Rollout]] = []
    runner = algorithm.env_runner_group.local_env_runner

    def listened(name: str, method: Any) -> Any:
        def listen(**request: Any) -> Rollout:
            rollouts.append((name, method(**request)))
            return rollouts[-1][1]

        return listen

    for name in ("sample", "episodes"):
        monkeypatch.setattr(runner, name, listened(name, getattr(runner, name)))
    return rollouts


def test_self_play_counts_what_it_steps(solo: Mappo) -> None:
    for _ in range(3):
        solo.train()
        assert totals(solo) == {(1, "SP"): 40}
    figures = solo.report.figures[1]
    assert figures["sp"] == 0.0 and "xp" not in figures and np.isfinite(list(figures.values())).all()
    seconds = solo.report.seconds
    assert 0 < seconds["pooling"] + seconds["gradients"] <= seconds["learning"] and seconds["sampling"] > 0
    assert solo.progress == pytest.approx(3 * 40 / 400) and not solo.finished


def test_counts_are_those_of_the_runners(comedi: Mappo, monkeypatch: pytest.MonkeyPatch) -> None:
    rollouts = seen(comedi, monkeypatch)
    for iteration in range(4):
        rollouts.clear()
        comedi.train()
        by_kind: Counter[tuple[int, str]] = Counter()
        for _, rollout in rollouts:
            for group in rollout.matches:
                by_kind[group.owner, str(group.kind)] += len(rollout.reward) * group.envs
        assert totals(comedi) == dict(by_kind)
        fresh = [rollout.steps for name, rollout in rollouts if name == "episodes"]
        # Every second iteration three episodes with two partners in two seatings; both kinds with one partner then.
        assert fresh == ([3 * 2 * 2 * HORIZON] if iteration % 2 == 0 else [])
        assert totals(comedi) == {(3, "SP"): 40, (3, "XP"): 40 + sum(fresh), (3, "MP"): 20}


def test_fresh_episodes_choose_the_strongest_partner(comedi: Mappo, monkeypatch: pytest.MonkeyPatch) -> None:
    rollouts, plans = seen(comedi, monkeypatch), []
    update = comedi.learner_group.update
    monkeypatch.setattr(
        comedi.learner_group, "update", lambda **given: (plans.append(given["plans"][3]), update(**given))
    )
    comedi.rounds = 0
    comedi.train()
    rewards: dict[int, list[float]] = {1: [], 2: []}
    for episode in rollouts[0][1].episodes:
        rewards[episode.partner_of(3)].append(episode.shaped)
    assert [len(found) for found in rewards.values()] == [6, 6]
    strongest = max(rewards, key=lambda partner: float(np.mean(rewards[partner])))
    assert plans == [Plan(strongest, pytest.approx(0.25 / 4), 0.25)]
    met = {group.partner_of(3) for group in rollouts[1][1].matches if group.kind is not Kind.SP}
    assert met == {strongest}


def test_all_fresh_episodes_decide_however_many(comedi: Mappo) -> None:
    assert CROSS.window == 32
    for _ in range(40):
        comedi.played.partners[3].add(1, [1.0], [0.0])
    assert len(comedi.played.partners[3].returns[1]) >= 40


def test_a_runner_without_a_share_of_the_fresh_episodes_is_left_out(
    comedi: Mappo, monkeypatch: pytest.MonkeyPatch
) -> None:
    rollouts = seen(comedi, monkeypatch)
    counted: list[module.Counted] = []
    weights = comedi.actors()
    ask = comedi._ask_runners
    monkeypatch.setattr(comedi, "_ask_runners", lambda what, request: [(1, None), *ask(what, request)])
    comedi.rounds = 0
    comedi._select_partners(weights, counted)
    assert [c.steps for c in counted] == [rollouts[0][1].steps] and rollouts[0][0] == "episodes"


def test_lambda_rises_and_stays(comedi: Mappo) -> None:
    found = []
    for comedi.rounds in range(6):
        found.append(comedi.played.plan(3, comedi.rounds).lambda_xp)
    assert found == pytest.approx([0.0625, 0.125, 0.1875, 0.25, 0.25, 0.25])


@pytest.mark.parametrize(("full", "shares"), [(0.0, [1.0] * 4), (8.0, [0.0, 0.25, 0.75, 1.0])])
def test_a_bonus_rises_with_the_members_score(full: float, shares: list[float]) -> None:
    """Without an episode, and after mean scores of 2, 6 and 10; another member's score does not count."""
    played, found = PlayRecord(Job(ENV, PPO, None, (1, 2), seed=0, bonus_score=full)), []
    played.own[2].append(100.0)
    for score in (None, 2.0, 10.0, 18.0):
        played.own[1].extend([] if score is None else [score])
        found.append(played.plan(1, 0).bonus)
    assert found == pytest.approx(shares)


def test_all_members_meet_all_others(solo: Mappo) -> None:
    algorithm = build(Job(ENV, PPO, CROSS, (1, 2, 3), seed=4))
    try:
        before = algorithm.actors()
        for _ in range(2):
            algorithm.train()
        assert totals(algorithm) == {(m, "SP"): 40 for m in (1, 2, 3)} | {(2, "XP"): 40, (3, "XP"): 80}
        after = algorithm.actors()
        assert all((before[m]["0.weight"] != after[m]["0.weight"]).any() for m in (1, 2, 3))
        for member, known in algorithm.played.partners.items():
            assert set(known.returns) == {1, 2, 3} - {member} and all(known.returns.values())
        assert list(algorithm.played.partners[1].returns[2]) == list(algorithm.played.partners[2].returns[1])
        for strongest in (2, 3):  # the only one that member 1 is trained against, while all are sampled
            algorithm.played.partners[1].add(strongest, [1e6 * strongest], [0.0])
            plan = algorithm.played.plan(1, algorithm.rounds)
            assert plan == Plan(strongest, pytest.approx(0.25 * 3 / 4))
            plans = {1: plan, 2: Plan(1), 3: Plan(1)}
            assert all(algorithm.played.is_played(match, plans) for match in algorithm.matches)
    finally:
        algorithm.stop()


def test_frozen_partners_do_not_move(comedi: Mappo) -> None:
    runner = comedi.env_runner_group.local_env_runner
    before = {k: [p.detach().clone() for p in net.parameters()] for k, net in runner.frozen.items()}
    comedi.train()
    assert set(comedi.actors()) == {3}
    for k, net in runner.frozen.items():
        assert all((a == b).all() for a, b in zip(before[k], net.parameters(), strict=True))


def ends(**values: Any) -> tuple[bool, ...]:
    """Whether a member with two partners is at its end, with these scores."""
    diversity = CROSS.model_copy(update={"target_xp": values.get("target_xp", 0.0)})
    ppo = PPO.model_copy(update={"target_score": values.get("target", 1e9)})
    played = PlayRecord(Job(ENV, ppo, diversity, (3,), seed=0, frozen={1: {}, 2: {}}))
    played.taken[3] = values.get("taken", 40)
    played.own[3].extend(values.get("own", []))
    for partner, score in values.get("cross", ()):
        played.partners[3].add(partner, [0.0], [score])
    return played.finished


def test_training_ends_with_its_budget_or_its_targets() -> None:
    done = {"target": 5.0, "target_xp": 1.0, "own": [5.0] * 4, "cross": [(1, 1.0), (2, 0.5)]}
    assert ends(taken=400) and not ends(taken=399)
    assert ends(**done)
    for change in ({"own": [5.0] * 3}, {"own": [4.9] * 4}, {"cross": [(1, 1.1), (2, 0.5)]}, {"cross": [(1, 1.0)]}):
        assert not ends(**(done | change))
    assert not ends(**(done | {"target_xp": 0.9})) and not ends(**(done | {"target": 5.1}))


@pytest.mark.parametrize(("fresh", "weights"), [(False, [0.3, 0.2, 0.1]), (True, [0.3, 0.3, 0.2])])
def test_a_constraint_takes_the_pressure_from_a_partner_that_is_below_its_limit(fresh: bool, weights: list) -> None:
    """Self-play 3, cross-play 1, limit 2: a quarter of lambda_XP off with every iteration's, or choice's, scores."""
    change = {"xp_limit": 2.0, "multiplier_step": 0.25, "lambda_xp": 0.4, "warmup": 0, "select_every": 2}
    job = Job(ENV, PPO, CROSS.model_copy(update=change), (2,), seed=0, frozen={1: {}}, fresh=fresh)
    played = PlayRecord(job)
    played.own[2].append(3.0)
    played.partners[2].add(1, [0.0], [1.0])
    assert [played.plan(2, number).lambda_xp for number in range(3)] == pytest.approx(weights)
    again = PlayRecord(job)
    again.load_state(played.state())
    assert again.constraints[2].multipliers == played.constraints[2].multipliers


def test_a_training_leaves_nothing_in_the_users_home(solo: Mappo) -> None:
    def there() -> set[str]:
        return set(os.listdir(DEFAULT_STORAGE_PATH)) if os.path.isdir(DEFAULT_STORAGE_PATH) else set()

    before = there()
    algorithm = build(SOLO)
    algorithm.stop()
    assert there() == before


def test_the_budget_is_what_came_back(solo: Mappo, monkeypatch: pytest.MonkeyPatch) -> None:
    """A lost runner's share is not counted, and therefore sampled later."""
    before = solo.played.taken[1]
    request = solo._request_rollouts

    def half(what: str, counted: list[module.Counted], **given: Any) -> list[Rollout]:
        pool = solo.env_runner_group.local_env_runner.pool
        monkeypatch.setattr(pool, "matches", (Match(Kind.SP, (1, 1), 2, 1),))
        return request(what, counted, **given)

    monkeypatch.setattr(solo, "_request_rollouts", half)
    solo.train()
    assert solo.played.taken[1] == before + 20 and solo.progress == pytest.approx((before + 20) / 400)


def test_an_algorithm_goes_on_from_its_snapshot(solo: Mappo, comedi: Mappo) -> None:
    other = build(comedi.job)
    try:
        other.resume(comedi.snapshot())
        for algorithm in (comedi, other):
            algorithm.train()
        assert totals(comedi) == totals(other) and comedi.rounds == other.rounds
        ours, theirs = comedi.actors()[3], other.actors()[3]
        assert all((ours[name] == theirs[name]).all() for name in ours)
        assert comedi.report.figures == other.report.figures
    finally:
        other.stop()


def test_a_runners_error_ends_the_run(solo: Mappo, monkeypatch: pytest.MonkeyPatch) -> None:
    pool = solo.env_runner_group.local_env_runner.pool
    monkeypatch.setattr(pool, "play", lambda *given: 1 / 0)
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        solo.train()


def test_a_killed_runner_is_replaced_and_every_step_counted_once() -> None:
    """Two remote runners share the environments; one is killed. What the other brings goes on, then both."""
    algorithm = build(Job(ENV, PPO.model_copy(update={"runners": 2}), None, (1,), seed=6))
    try:
        algorithm.train()
        assert sorted((c.runner, c.steps) for c in algorithm.report.counted) == [(1, 20), (2, 20)]
        manager = algorithm.env_runner_group._worker_manager
        ray.kill(manager.actors()[1], no_restart=False)
        steps, deadline = [], time.monotonic() + 240
        while len(steps) < 2 or len(steps[-1]) < 2 and time.monotonic() < deadline:
            algorithm.train()  # with what there is, until Ray has started the runner again
            steps.append({c.runner: c.steps for c in algorithm.report.counted})
            assert set(algorithm.report.lost) == {1, 2} - set(steps[-1]), "the loss is told"
        assert steps[0] in ({2: 20}, {1: 20, 2: 20}) and steps[-1] == {1: 20, 2: 20}
        assert algorithm.played.taken[1] == 40 + sum(sum(one.values()) for one in steps)
        state = algorithm.snapshot()
        assert set(state["runners"]) == {"1", "2"}
        algorithm.resume(state)
        algorithm.train()
        assert sum(totals(algorithm).values()) == 40
        state["runners"]["2"]["states"] = state["runners"]["2"]["states"][:, :-1]
        with pytest.raises(ValueError):  # a remote runner's error is not passed over
            algorithm.resume(state)
    finally:
        algorithm.stop()
