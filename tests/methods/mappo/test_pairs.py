"""Pairs and mixture partners: who plays with whom, who is paid what, and what is left where nothing is hidden."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.rollouts import VIEW, reads_observation, rollout

from popgen.config.run_config import RunConfig
from popgen.config.sections import EnvConfig
from popgen.envs import make_env
from popgen.envs.overcooked.transition_events import HSP_EVENTS
from popgen.envs.player_events import count_player_events, name_player_events
from popgen.errors import UserError
from popgen.methods.mappo.config import PpoConfig
from popgen.methods.mappo.hidden_utility import STEP_SHARE, Utility, draw_utility
from popgen.methods.mappo.needs import check_hsp, estimate_hsp
from popgen.methods.mappo.noisy_actor import mix_with_random
from popgen.methods.mappo.play_record import HABIT_DECAY, Counted, PlayRecord, rate_self_play
from popgen.methods.mappo.pooling import Plan, PooledBatch, gather, pool
from popgen.methods.mappo.slots import SlotPool
from popgen.methods.mappo.training_job import Job
from popgen.methods.registry import METHODS
from popgen.play.episodes import Episode
from popgen.play.rollout import Match
from popgen.types import Kind

OPTIONS: dict[str, Any] = {"discount": 0.5, "lam": 0.5, "value_decay": 0.0}
PPO = PpoConfig(envs=5, steps=10)
UTILITY = Utility((2.0, -1.0))


def pair_job() -> Job:
    """Partners 1 and 2, and 3, the biased agent beside 1."""
    return Job(EnvConfig(), PPO, None, (1, 2, 3), seed=0, pairs={1: 3}, utilities={3: UTILITY})


def pair_rollout(**given: Any) -> Any:
    """Ten steps of the pair 1 and 3 in both seatings, with events of two kinds."""
    events = np.random.default_rng(4).integers(0, 2, (10, 4, 2, 2)).astype(np.uint8)
    matches = Match(Kind.SP, (1, 3), 2, 1), Match(Kind.SP, (3, 1), 2, 1)
    return rollout(10, *matches, **({"events": events} | given))


def batch(member: int, plan: Plan, played: Any, **given: Any) -> PooledBatch:
    found = pool([played], member, plan, {"SP": reads_observation()}, VIEW, **OPTIONS, **given)
    assert found is not None
    return found


def test_a_pair_plays_in_both_seatings_and_counts_for_its_partner() -> None:
    job = pair_job()
    assert [(m.kind, m.members, m.envs, m.owner) for m in job.matches()] == [
        (Kind.SP, (1, 3), 3, 1),
        (Kind.SP, (3, 1), 2, 1),
        (Kind.SP, (2, 2), 5, 2),
    ]
    assert job.owners == [1, 2] and [job.mate_of(m) for m in job.learning] == [3, 2, 1]
    record = PlayRecord(job)
    assert [record.plan(m, 0).mate for m in job.learning] == [3, None, 1]


def test_each_of_a_pair_learns_from_its_own_seat_under_its_own_reward() -> None:
    """The biased agent: 2 and -1 for its events, and the reward; its partner: the reward alone."""
    played = pair_rollout()
    seats = {1: (slice(0, 2), slice(2, 4)), 3: (slice(2, 4), slice(0, 2))}  # columns of seat 0, of seat 1
    for member, (first, second) in seats.items():
        found = gather([played], Kind.SP, member, 4 - member)
        assert found is not None and found.trained.sum() == 10 * 4
        own = np.empty((10, 4, 2))
        own[:, first], own[:, second] = played.events[:, first, 0], played.events[:, second, 1]
        assert found.events.tolist() == own.tolist()
    paid = played.reward + 2.0 * own[..., 0] - own[..., 1]
    hidden = batch(3, Plan(mate=1), played, utility=UTILITY)
    richer = batch(3, Plan(mate=1), pair_rollout(reward=paid.astype(np.float32)))
    torch.testing.assert_close(hidden.advantage, richer.advantage)
    assert hidden.figures["utility"] == pytest.approx(float(paid.mean()), abs=1e-6)
    assert hidden.figures["sp_reward"] == pytest.approx(float(played.reward.mean()), abs=1e-6)


def test_the_true_reward_as_utility_changes_no_bit() -> None:
    played = pair_rollout()
    plain, paid = batch(3, Plan(mate=1), played), batch(3, Plan(mate=1), played, utility=Utility((0.0, 0.0)))
    assert torch.equal(plain.advantage, paid.advantage)
    assert torch.equal(plain.critics["SP"].target, paid.critics["SP"].target)
    assert Utility((0.0, 0.0)).is_true and not UTILITY.is_true and not Utility((0.0,), reward=0.5).is_true


def test_utilities_are_drawn_by_seed_and_pair() -> None:
    names = tuple(HSP_EVENTS)
    drawn = [draw_utility(names, spread=10.0, biases=3, reward=1.0, seed=(1, pair)) for pair in range(40)]
    assert drawn[5] == draw_utility(names, spread=10.0, biases=3, reward=1.0, seed=(1, 5))
    weights = np.array([one.events for one in drawn])
    assert ((weights != 0).sum(1) == 3).all() and len({one.events for one in drawn}) == 40
    slow = np.array(["MOVEMENT" in name or name == "STAY" or name.startswith("IDLE") for name in names])
    assert 5.0 < np.abs(weights[:, ~slow]).max() <= 10.0 and 0 < np.abs(weights[:, slow]).max() <= 10.0 * STEP_SHARE
    assert draw_utility(names, spread=0.0, biases=3, reward=1.0, seed=(1, 5)).is_true
    described = drawn[5].describe(names)
    assert len(described) == 4 and described["reward"] == 1.0


def test_events_are_counted_while_playing_and_averaged_over_iterations() -> None:
    """The pool's events are those of its own recorded actions; habits are a moving mean of them."""
    generator = torch.Generator().manual_seed(0)
    actors = {m: lambda obs, seats: torch.rand(len(obs), 6, generator=generator) for m in (1, 2, 3)}

    def make(count: int, seed: int) -> Any:
        return make_env("overcooked/cramped_room", count, seed=seed)

    pool_of_slots = SlotPool(make, pair_job().matches(), "features", seed=0, events=True)
    first, second = (pool_of_slots.play((0, 1, 2), 10, actors) for _ in range(2))
    env = make(10, 0)
    env.set_time(pool_of_slots.age - 20)
    names = name_player_events(env)
    assert first.events.shape == (10, 10, 2, len(names)) and names == tuple(HSP_EVENTS)
    for t in range(10):
        states = env.get_state()
        result = env.step(first.actions[t])
        assert (first.events[t] == count_player_events(env, states, first.actions[t], result)).all()
    record = PlayRecord(pair_job())
    record.add_habits([first])
    record.add_habits([second])
    before, now = (one.events[one.seats == 3].mean(0) for one in (first, second))
    np.testing.assert_allclose(record.habits[3], HABIT_DECAY * before + (1 - HABIT_DECAY) * now)
    again = PlayRecord(pair_job())
    again.load_state(record.state())
    np.testing.assert_array_equal(again.habits[1], record.habits[1])


def test_habits_are_those_of_an_iteration_however_many_runners_play_it() -> None:
    """Two iterations, by one runner and by two with two and one of the three environments."""
    rng = np.random.default_rng(3)
    whole, divided = PlayRecord(pair_job()), PlayRecord(pair_job())
    for _ in range(2):
        events = rng.integers(0, 2, (10, 3, 2, 2)).astype(np.uint8)
        whole.add_habits([rollout(10, Match(Kind.SP, (1, 3), 3, 1), events=events)])
        parts = [
            rollout(10, Match(Kind.SP, (1, 3), count, 1), events=part)
            for count, part in ((2, events[:, :2]), (1, events[:, 2:]))
        ]
        divided.add_habits(parts)
    assert whole.habits.keys() == {1, 3}
    assert all((whole.habits[member] == divided.habits[member]).all() for member in (1, 3))
    assert (whole.habits[3] == whole.habits[3].clip(0.3, 0.7)).all()
    whole.add_habits([rollout(10, Match(Kind.SP, (1, 3), 3, 1), events=np.zeros_like(events))])
    np.testing.assert_allclose(whole.habits[3], HABIT_DECAY * divided.habits[3])


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_a_mixture_partner_has_the_mixed_probabilities(share: float) -> None:
    logits = torch.tensor([[1.0, -2.0, 0.5]])
    mixed = mix_with_random(lambda obs, seats: logits, share)(torch.zeros(1), torch.zeros(1))
    expected = (1 - share) * torch.softmax(logits, -1) + share / 3
    torch.testing.assert_close(mixed.exp(), expected)


def mixture_job(**ppo: Any) -> Job:
    """Member 2 beside itself with random actions."""
    return Job(EnvConfig(), PPO.model_copy(update=ppo), None, (2,), seed=0, pairs={2: -2}, noise=0.25)


def test_beside_a_mixture_partner_only_the_members_own_seat_is_learned_from() -> None:
    """Of five environments one is plain self-play, which is not learned from at all; of 64 it is a quarter."""
    job = mixture_job()
    assert [(m.members, m.envs) for m in job.matches()] == [((2, -2), 2), ((-2, 2), 2), ((2, 2), 1)]
    assert [(m.members, m.envs) for m in mixture_job(envs=64).matches()] == [((2, -2), 24), ((-2, 2), 24), ((2, 2), 16)]
    assert {m.kind for m in job.matches()} == {Kind.SP} and {m.owner for m in job.matches()} == {2}
    assert job.owners == [2] and PlayRecord(job).plan(2, 0).mate == -2
    played = rollout(10, *job.matches())
    found = gather([played], Kind.SP, 2, -2)
    assert found is not None and found.trained.sum() == 10 * 4 and found.seat.tolist() == [0, 0, 1, 1]
    assert len(batch(2, Plan(mate=-2), played).action) == 10 * 4


def played_by(*scores: tuple[tuple[int, int], float], **given: Any) -> Any:
    """Ten steps of the mixture's environments, with these episodes of member 2 at their end."""
    episodes = tuple(Episode(Kind.SP, members, score, 0.0, owner=2) for members, score in scores)
    return rollout(10, *mixture_job().matches(), episodes=episodes, **given)


def test_plain_self_play_alone_tells_whether_the_target_of_a_mixture_is_reached() -> None:
    """Beside the noisy partner two episodes of 9, plainly one of 12, then another: the target is 11, the window 2."""
    job = mixture_job(window=2, target_score=11.0, max_steps=10_000)
    record = PlayRecord(job)
    record.add(0, played_by(((2, -2), 8.0), ((-2, 2), 10.0), ((2, 2), 12.0)), judge_partners=True)
    assert record.scores(2) == {"sp": 12.0, "sp_noisy": 9.0} and not record.finished
    noisy = PlayRecord(job)
    noisy.add(0, played_by(((2, -2), 12.0), ((-2, 2), 12.0)), judge_partners=True)
    assert noisy.scores(2) == {"sp_noisy": 12.0} and not noisy.finished
    again = PlayRecord(job)
    again.load_state(record.state())
    for one in (record, again):
        one.add(0, played_by(((2, 2), 11.0)), judge_partners=True)
        assert one.scores(2) == {"sp": 11.5, "sp_noisy": 9.0} and one.finished


def test_all_play_of_a_mixture_is_counted_as_self_play() -> None:
    record = PlayRecord(mixture_job())
    counted = record.add(0, played_by(((2, -2), 8.0), ((2, 2), 12.0)), judge_partners=True)
    assert [(one.owner, one.kind, one.steps, one.episodes, one.score) for one in counted] == [(2, Kind.SP, 50, 2, 20.0)]
    assert record.taken == {2: 50}


def test_a_mixture_needs_an_environment_of_each_kind() -> None:
    def run(envs: int, epsilon: float) -> Any:
        small = {"envs": envs, "minibatches": 1}
        return RunConfig.parse({"method": "e3t", "ppo": small, "e3t": {"epsilon": epsilon}})

    spec = make_env("overcooked/cramped_room", 1).spec
    with pytest.raises(UserError, match=r"ppo.envs: .*plainly with itself.*set it to at least 3"):
        METHODS["e3t"].check(run(2, 0.25), spec)
    METHODS["e3t"].check(run(3, 0.25), spec)
    METHODS["e3t"].check(run(1, 0.0), spec)


def test_a_steps_score_belongs_to_the_policies_that_took_it() -> None:
    """Two environments, ten steps of an episode of 40, two dishes: eight an episode. An episode that ends early stands
    for the steps that it still had."""
    score = np.zeros((10, 2), np.float32)
    score[2, 0] = score[7, 1] = 1.0
    record = PlayRecord(Job(EnvConfig(), PPO, None, (1,), seed=0))
    sp = Match(Kind.SP, (1, 1), 2, 1)
    counted = record.add(0, rollout(10, sp, score=score), judge_partners=True)
    assert counted[0].earned == 2.0 and counted[0].covered == 20.0
    assert rate_self_play(counted, 40) == pytest.approx(2.0 / 20.0 * 40)
    covered = np.ones((10, 2), np.float32)
    covered[4, 0] = 31.0
    early = record.add(1, rollout(10, sp, score=score, covered=covered), judge_partners=True)
    assert rate_self_play([*counted, *early], 40) == pytest.approx(4.0 / 70.0 * 40)
    assert rate_self_play([], 40) is None
    crossed = Counted(0, 1, Kind.XP, 20, 0, 0.0, earned=9.0, covered=20.0)
    assert rate_self_play([*counted, crossed], 40) == rate_self_play(counted, 40)


def test_half_pairs_and_small_pools_are_refused() -> None:
    spec = make_env("overcooked/cramped_room", 1).spec

    def run(size: int, **hsp: Any) -> Any:
        return RunConfig.parse({"method": "hsp", "population": {"size": size}, "hsp": hsp})

    with pytest.raises(UserError, match=r"population.size: 5 is no multiple of 2.*set it to 6"):
        check_hsp(run(5), spec)
    with pytest.raises(UserError, match=r"hsp.pool: is 3, of which 4 are to be chosen"):
        check_hsp(run(8, pool=3), spec)
    check_hsp(run(5, members="partners"), spec)
    assert estimate_hsp(run(8, pool=8), spec).together == 16
