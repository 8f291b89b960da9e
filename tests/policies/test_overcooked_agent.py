"""A popgen policy inside overcooked_ai's own game plays as in our simulator."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from overcooked_ai_py.agents.agent import Agent, AgentPair
from overcooked_ai_py.mdp.actions import Action
from overcooked_ai_py.mdp.overcooked_mdp import OvercookedGridworld

from popgen.envs import BatchedEnv, make_env
from popgen.envs.overcooked.bridge import from_overcooked_ai, to_overcooked_mdp
from popgen.envs.overcooked.kernels import TIME
from popgen.errors import UserError
from popgen.play.rollout import Transition, play
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.overcooked_agent import OvercookedAgent
from popgen.policies.simple_policies import IdlePolicy
from popgen.population import load_population
from tests.envs.cooks import Cook, Kitchen

STEPS = 200


@pytest.fixture(scope="module", params=["interact", "auto"])
def env(request: pytest.FixtureRequest) -> BatchedEnv:
    return make_env("overcooked/cramped_room", 1, cooking=request.param, horizon=STEPS)


@pytest.fixture
def mdp(env: BatchedEnv) -> OvercookedGridworld:
    return to_overcooked_mdp(env)


class Recorder(FeedForwardPolicy):
    """Keeps the previous actions it was told and draws its actions from the network."""

    def __init__(self, env: BatchedEnv, seed: int) -> None:
        super().__init__(env.spec.views["features"], env.spec.num_actions, units=16, seed=seed)
        self.net[-1].weight.data *= 20  # decided, and different from state to state
        self.told: list[tuple[np.ndarray, bool]] = []

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        self.told.append((previous_actions[0].copy(), bool(is_first[0])))
        return super().act(obs, previous_actions, is_first)


class Hashed(IdlePolicy):
    """A deterministic player whose actions depend on all it sees and on how often it was asked."""

    def __init__(self, salt: int) -> None:
        super().__init__(["stay"])
        self.salt, self.asked = salt, 0

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        self.asked += 1
        joint = np.ascontiguousarray(obs[0]).tobytes()
        keys = (bytes([self.salt, self.asked % 256, seat]) for seat in (0, 1))
        return np.array([[hashlib.sha256(key + joint).digest()[0] % 6 for key in keys]], np.uint8)


class Recorded(IdlePolicy):
    """Plays joint actions (T, 2) that were chosen before, from the start again after a reset."""

    def __init__(self, actions: np.ndarray) -> None:
        super().__init__(["stay"])
        self.actions, self.asked = actions, 0

    def reset(self, batch: int, seed: int) -> None:
        self.asked = 0

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        self.asked += 1
        return self.actions[None, self.asked - 1]


def cooked_game(env: BatchedEnv) -> tuple[np.ndarray, np.ndarray, float]:
    """States (T, S), joint actions (T, 2) and reward of one game of two cooks in our simulator."""
    kitchen = Kitchen(env)
    cooks = [Cook(kitchen, seat, np.random.default_rng(seat), 0.05) for seat in (0, 1)]
    env.reset(seed=0)
    rows, actions, reward = [], [], 0.0
    for _ in range(env.spec.horizon):
        rows.append(env.get_state()[0])
        actions.append([cook.act(rows[-1]) for cook in cooks])
        reward += float(env.step(np.array(actions[-1:], np.uint8)).reward[0])
    return np.stack(rows), np.array(actions, np.uint8), reward


def drive(pair: AgentPair, mdp: OvercookedGridworld, env: BatchedEnv) -> tuple[np.ndarray, np.ndarray]:
    """States (T + 1, S) and joint actions (T, 2) of one game in overcooked_ai."""
    pair.reset()
    pair.set_mdp(mdp)
    state = mdp.get_standard_start_state()
    rows, actions = [from_overcooked_ai(env, state)], []
    for _ in range(STEPS):
        joint = [action for action, _ in pair.joint_action(state)]
        actions.append([Action.ACTION_TO_INDEX[action] for action in joint])
        state, _ = mdp.get_state_transition(state, tuple(joint))
        rows.append(from_overcooked_ai(env, state))
    return np.stack(rows), np.array(actions)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_same_trajectory_as_in_our_simulator(env: BatchedEnv, mdp: OvercookedGridworld, seed: int) -> None:
    agents = [OvercookedAgent(Hashed(seed + seat), env) for seat in (0, 10)]
    assert all(isinstance(agent, Agent) for agent in agents)
    rows, actions = drive(AgentPair(*agents), mdp, env)
    seen: list[Transition] = []
    play(env, [Hashed(seed), Hashed(seed + 10)], np.array([[0, 1]]), seed=0, record=seen.append)
    np.testing.assert_array_equal(actions, np.concatenate([step.actions for step in seen]))
    np.testing.assert_array_equal(rows[1:], np.concatenate([step.next_states for step in seen]))
    assert len(np.unique(actions)) == 6 and len(np.unique(np.delete(rows, [TIME, TIME + 1], 1), axis=0)) > 100


def test_previous_actions_are_the_own_ones_and_the_partners_effects(env: BatchedEnv, mdp: OvercookedGridworld) -> None:
    policies = [Recorder(env, 4), Recorder(env, 5)]
    agents = [OvercookedAgent(policy, env, seed=seat) for seat, policy in enumerate(policies)]
    for game in (0, 1):
        for policy in policies:
            policy.told.clear()
        rows, actions = drive(AgentPair(*agents), mdp, env)
        assert len(np.unique(actions)) == 6 and len(np.unique(rows, axis=0)) > 20, game
        for seat, policy in enumerate(policies):
            told = np.stack([previous for previous, _ in policy.told])
            assert [first for _, first in policy.told] == [True] + [False] * (STEPS - 1)
            np.testing.assert_array_equal(told[1:, seat], actions[:-1, seat])
            explained, _ = env.simulate(rows[:-2], told[1:].astype(np.uint8))
            np.testing.assert_array_equal(explained, rows[1:-1])


def test_episodes_differ_and_repeat_with_the_seed(env: BatchedEnv, mdp: OvercookedGridworld) -> None:
    def games(seed: int) -> list[np.ndarray]:
        pair = AgentPair(*(OvercookedAgent(Recorder(env, 4 + s), env, seed=seed + s) for s in (0, 1)))
        return [drive(pair, mdp, env)[1] for _ in range(2)]

    first, again = games(0), games(0)
    np.testing.assert_array_equal(first, again)
    assert (first[0] != first[1]).any()


def test_another_game_is_refused(env: BatchedEnv, mdp: OvercookedGridworld) -> None:
    agent = OvercookedAgent(IdlePolicy(env.spec.action_names), env, 1)
    with pytest.raises(UserError, match="layout is not that of overcooked/cramped_room"):
        agent.set_mdp(OvercookedGridworld.from_layout_name("coordination_ring"))
    agent.set_mdp(mdp)
    other = make_env("overcooked/cramped_room", 1, cooking="auto" if env.cooking == "interact" else "interact")
    with pytest.raises(UserError, match=f"cooking mode is {other.cooking}, the environment's is {env.cooking}"):
        agent.set_mdp(to_overcooked_mdp(other))
    with pytest.raises(ValueError, match="seat"):
        OvercookedAgent(IdlePolicy(env.spec.action_names), env, 2)


def test_a_state_is_answered_once_however_often_it_is_shown(env: BatchedEnv, mdp: OvercookedGridworld) -> None:
    policy = Recorder(env, 4)
    agent, state = OvercookedAgent(policy, env, 0), mdp.get_standard_start_state()
    agent.reset()
    for asked in (1, 2, 3):
        answers = {agent.action(state)[0] for _ in range(3)}
        assert len(answers) == 1 and len(policy.told) == asked
        state, _ = mdp.get_state_transition(state, (answers.pop(), Action.STAY))


@pytest.mark.parametrize("played", ["another action", "four ticks"])
def test_a_game_that_goes_otherwise_goes_on(env: BatchedEnv, mdp: OvercookedGridworld, played: str) -> None:
    """The own action that was really played is found from its effect; of states left out nothing is made up."""
    policy = Recorder(env, 4)
    agent, state = OvercookedAgent(policy, env, 0), mdp.get_standard_start_state()
    agent.reset()
    answer, _ = agent.action(state)
    west, east = (-1, 0), (1, 0)
    other = west if answer != west else east
    for joint in [(other, Action.STAY)] if played == "another action" else [(west, east), (east, west)] * 2:
        state, _ = mdp.get_state_transition(state, joint)
    agent.action(state)
    told, first = policy.told[-1]
    assert not first
    if played == "another action":
        assert told.tolist() == [Action.ACTION_TO_INDEX[other], Action.ACTION_TO_INDEX[Action.STAY]]


def test_an_earlier_state_without_reset_is_told(env: BatchedEnv, mdp: OvercookedGridworld) -> None:
    agent = OvercookedAgent(IdlePolicy(env.spec.action_names), env, 0)
    start = mdp.get_standard_start_state()
    agent.action(mdp.get_state_transition(start, ((0, 1), (-1, 0)))[0])
    with pytest.raises(ValueError, match="call reset"):
        agent.action(start)
    agent.reset()
    action, info = agent.action(start)
    assert action == Action.STAY and info["action_probs"].tolist() == [0, 0, 0, 0, 1, 0]


def test_a_copy_of_the_game_and_the_evaluator_keep_its_rules(
    env: BatchedEnv, mdp: OvercookedGridworld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the form that docs/evaluation.md names."""
    monkeypatch.setattr(np, "Inf", np.inf, raising=False)
    from overcooked_ai_py.agents.benchmarking import AgentEvaluator

    made = mdp.copy()
    assert type(made) is type(mdp) and getattr(made, "old_dynamics", False) == (env.cooking == "auto")
    _, actions, reward = cooked_game(env)
    pair = AgentPair(*(OvercookedAgent(Recorded(actions), env) for _ in (0, 1)))
    played = AgentEvaluator({"horizon": STEPS}, lambda _: mdp).evaluate_agent_pair(pair, num_games=1, info=False)
    assert played["ep_returns"].tolist() == [reward] and reward >= 60


def test_a_game_with_many_soups_is_the_same_in_either_game(env: BatchedEnv, mdp: OvercookedGridworld) -> None:
    rows, actions, reward = cooked_game(env)
    assert reward >= 60
    played, answered = drive(AgentPair(*(OvercookedAgent(Recorded(actions), env) for _ in (0, 1))), mdp, env)
    np.testing.assert_array_equal(answered, actions)
    np.testing.assert_array_equal(played[:-1], rows)


def test_members_of_a_population_play_in_overcooked_ais_own_environment(
    random_population: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With automatic cooking; version 1.1.0 asks NumPy 2 for a name that it no longer has."""
    monkeypatch.setattr(np, "Inf", np.inf, raising=False)
    from overcooked_ai_py.mdp.overcooked_env import OvercookedEnv

    population = load_population(random_population)
    env = population.make_env()
    mdp = to_overcooked_mdp(env)
    assert population.env_info.cooking == "auto" and mdp.old_dynamics
    game = OvercookedEnv.from_mdp(mdp, horizon=env.spec.horizon, info_level=0)
    pair = AgentPair(*(OvercookedAgent(population[member], env, seed=member) for member in (1, 2)))
    pair.set_mdp(mdp)
    trajectory, steps, *_ = game.run_agents(pair)
    assert steps == env.spec.horizon and len({joint for _, joint, *_ in trajectory}) > 5

    cooks = make_env("overcooked/cramped_room", 1, cooking="auto", horizon=STEPS)
    _, actions, reward = cooked_game(cooks)
    game = OvercookedEnv.from_mdp(to_overcooked_mdp(cooks), horizon=STEPS, info_level=0)
    _, steps, score, _ = game.run_agents(AgentPair(*(OvercookedAgent(Recorded(actions), cooks) for _ in (0, 1))))
    assert (steps, score) == (STEPS, reward) and reward >= 60
