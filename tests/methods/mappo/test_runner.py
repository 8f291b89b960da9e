"""One runner without Ray: its share of the environments, and fresh episodes."""

from __future__ import annotations

from collections import Counter

import pytest

from popgen.config.sections import ClusterConfig, EnvConfig
from popgen.envs import make_env
from popgen.methods.mappo.algorithm import MappoConfig
from popgen.methods.mappo.batched_runner import BatchedRunner, Failure
from popgen.methods.mappo.config import DiversityConfig, PpoConfig
from popgen.methods.mappo.rl_module import module_spec
from popgen.methods.mappo.slots import Rollout
from popgen.methods.mappo.training_job import Job
from popgen.nets.weights import weights_of
from popgen.play.rollout import Match
from popgen.types import Kind, Weights

# A small arena, which players soon leave: an episode's end.
ENV = EnvConfig(name="rendezvous/mppmr", params={"horizon": 30, "bounds": 0.8, "start_noise": 0.2, "sensitivity": 8.0})
SPEC = make_env(ENV.name, 1, **ENV.params).spec
PPO = PpoConfig(units=16, layers=1, envs=8, steps=10)
CROSS = DiversityConfig(order="sequential", xp_envs=4, mp_envs=4)


def actor(seed: int) -> Weights:
    modules = module_spec(Job(ENV, PPO, None, (1,), seed=seed), SPEC, inference_only=True).build()
    return weights_of(modules["member_1"].actor)


def job(seed: int = 0) -> Job:
    return Job(ENV, PPO, CROSS, (2,), seed=seed, frozen={1: actor(5)}, mixed=True, fresh=True)


def runner(part: int, parts: int) -> BatchedRunner:
    config = MappoConfig.of(job(), SPEC, ClusterConfig())
    return BatchedRunner(config=config, worker_index=part, num_workers=parts)


def fresh(part: int, parts: int, episodes: int, seed: int = 3) -> Rollout | None:
    groups = [Match(Kind.XP, pair, episodes, 2) for pair in ((2, 1), (1, 2))]
    found = runner(part, parts).episodes(weights={2: actor(9)}, matches=groups, seed=seed)
    assert found is None or isinstance(found, Rollout), found
    return found


@pytest.mark.parametrize("parts", [1, 3, 7])
def test_runners_share_the_fresh_episodes_and_some_may_have_none(parts: int) -> None:
    found = [fresh(part, parts, episodes=2) for part in range(1, parts + 1)]
    played = [rollout for rollout in found if rollout is not None]
    assert sum(group.envs for rollout in played for group in rollout.matches) == 4
    assert sum(rollout.steps for rollout in played) == 4 * SPEC.horizon
    assert (None in found) == (parts == 7)


def test_every_environment_has_one_fresh_episode_however_short() -> None:
    """Counting all that end in time would count short ones more often."""
    rollout = fresh(1, 1, episodes=40)
    assert rollout is not None
    done = rollout.terminated | rollout.truncated
    assert done.sum() > 2 * done.shape[1]
    assert Counter(episode.members for episode in rollout.episodes) == {(2, 1): 40, (1, 2): 40}
    first = done.argmax(0)
    by_hand = [rollout.reward[: first[column] + 1, column].sum() for column in range(80)]
    assert sorted(e.shaped for e in rollout.episodes) == pytest.approx(sorted(by_hand), rel=1e-5)


def test_runners_draw_differently_and_the_same_again() -> None:
    one, other, again = fresh(1, 2, 20), fresh(2, 2, 20), fresh(1, 2, 20)
    assert one is not None and other is not None and again is not None
    assert (one.actions == again.actions).all() and (one.actions != other.actions).any()
    later = fresh(1, 2, 20, seed=4)
    assert later is not None and (one.actions != later.actions).any()


@pytest.mark.parametrize("mate", [-1, 2], ids=["e3t", "pair"])
def test_a_runner_without_environments_of_its_own_plays_nothing(mate: int) -> None:
    learning = (1,) if mate < 0 else (1, 2)
    small = Job(ENV, PPO, None, learning, seed=0, pairs={1: mate}, noise=0.25 if mate < 0 else 0.0)
    config, active = MappoConfig.of(small, SPEC, ClusterConfig()), range(len(small.matches()))
    weights = {member: actor(member) for member in learning}
    runners = [BatchedRunner(config=config, worker_index=part, num_workers=8) for part in range(1, 9)]
    played = [one.sample(weights=weights, active=active, steps=10) for one in runners]
    assert [one for one in played if one is not None and not isinstance(one, Rollout)] == []
    assert None in played and sum(one.steps for one in played if one is not None) == 10 * PPO.envs
    idle = runners[played.index(None)]
    assert not isinstance(saved := idle.snapshot(), Failure)
    assert idle.restore(state=saved) is None


def test_beside_remote_runners_the_local_one_has_nothing_to_step() -> None:
    assert sum(group.envs for group in runner(0, 2).pool.matches) == 0
    assert sum(group.envs for part in (1, 2) for group in runner(part, 2).pool.matches) == 8 + 4 + 4
    assert sum(group.envs for group in runner(0, 0).pool.matches) == 8 + 4 + 4
