"""A popgen policy inside overcooked_ai's own game plays as in our simulator."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from overcooked_ai_py.agents.agent import Agent, AgentPair
from overcooked_ai_py.mdp.actions import Action
from overcooked_ai_py.mdp.overcooked_mdp import OvercookedGridworld

from popgen.envs import BatchedEnv, make_env
from popgen.envs.overcooked.bridge import from_overcooked_ai
from popgen.envs.overcooked.kernels import TIME
from popgen.errors import UserError
from popgen.evaluation.rollout import Transition, play
from popgen.policies import FeedForwardPolicy, IdlePolicy
from popgen.policies.overcooked_agent import OvercookedAgent

STEPS = 200


@pytest.fixture(scope="module")
def env() -> BatchedEnv:
    return make_env("overcooked/cramped_room", 1, cooking="interact", horizon=STEPS)


@pytest.fixture(scope="module")
def mdp() -> OvercookedGridworld:
    return OvercookedGridworld.from_layout_name("cramped_room")


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
    automatic = OvercookedAgent(IdlePolicy(env.spec.action_names), make_env("overcooked/cramped_room", 1), 1)
    with pytest.raises(UserError, match="cooking mode is interact, the environment's is auto"):
        automatic.set_mdp(mdp)
    with pytest.raises(ValueError, match="seat"):
        OvercookedAgent(IdlePolicy(env.spec.action_names), env, 2)


def test_a_jump_without_reset_is_told(env: BatchedEnv, mdp: OvercookedGridworld) -> None:
    agent = OvercookedAgent(IdlePolicy(env.spec.action_names), env, 0)
    state = mdp.get_standard_start_state()
    agent.action(state)
    for _ in range(2):
        state, _ = mdp.get_state_transition(state, ((0, 1), (-1, 0)))
    with pytest.raises(ValueError, match="explains"):
        agent.action(state)
    agent.reset()
    action, info = agent.action(state)
    assert action == Action.STAY and info["action_probs"].tolist() == [0, 0, 0, 0, 1, 0]
