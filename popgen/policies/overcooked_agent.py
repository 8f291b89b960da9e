"""A popgen policy as an `Agent` of overcooked_ai, for its AgentPair, its environment and its tools.

Needs overcooked_ai; nothing else in popgen imports this module.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from overcooked_ai_py.agents.agent import Agent
from overcooked_ai_py.mdp.actions import Action

from popgen.envs.overcooked import OvercookedEnv
from popgen.envs.overcooked.bridge import from_overcooked_ai, infer_joint_action
from popgen.envs.overcooked.kernels import NUM_ACTIONS, STAY
from popgen.errors import UserError
from popgen.play.policy import Policy


class OvercookedAgent(Agent):
    """Plays one seat from overcooked_ai's own states.

    overcooked_ai shows an agent only states, so the partner's last action is inferred from its effect; where several
    actions have the same effect, such as steps against a wall, `stay` stands for them. The own actions are those
    that were answered, unless the new state tells otherwise.

    Args:
        policy: for this agent alone: it keeps the memory of one episode.
        env: an environment of the layout and cooking mode that will be played; used for its rules only.
        seat: 0 or 1, until `set_agent_index` says otherwise.
        seed: of the policy's draws; each reset goes on to the next episode's.

    Raises:
        ValueError: a seat other than 0 and 1.
    """

    def __init__(self, policy: Policy, env: OvercookedEnv, seat: int = 0, *, seed: int = 0) -> None:
        if seat not in (0, 1):
            raise ValueError(f"seat must be 0 or 1, got {seat!r}")
        self._policy, self._env, self._seat = policy, env, seat
        self._seeds = np.random.default_rng(seed)
        self._previous: tuple[np.ndarray, int] | None = None
        self.agent_index: int | None = seat
        super().__init__()

    def reset(self) -> None:
        """Start a new episode; the seat stays."""
        super().reset()
        self.agent_index = self._seat
        self._previous = None
        self._policy.reset(1, int(self._seeds.integers(2**31)))

    def set_agent_index(self, agent_index: int | None) -> None:
        """Sit in seat 0 or 1."""
        if agent_index is not None:
            self._seat = int(agent_index)
        super().set_agent_index(agent_index)

    def set_mdp(self, mdp: Any) -> None:
        """Accept the game that will be played; `to_overcooked_mdp` makes the one of an environment.

        Raises:
            UserError: another layout or cooking mode than the environment's.
        """
        grid = ["".join(row) for row in mdp.terrain_mtx]
        own = ["".join(cell if cell not in "12" else " " for cell in row) for row in self._env.layout.rows]
        if grid != own:
            problem = f"its layout is not that of {self._env.spec.name}"
            raise UserError("mdp", problem, "build it from the layout that the population was trained in")
        cooking = "auto" if getattr(mdp, "old_dynamics", False) else "interact"
        if cooking != self._env.cooking:
            problem = f"its cooking mode is {cooking}, the environment's is {self._env.cooking}"
            raise UserError("mdp", problem, "make it with popgen.envs.overcooked.bridge.to_overcooked_mdp")
        super().set_mdp(mdp)

    def action(self, state: Any) -> tuple[Any, dict[str, Any]]:
        """Answer an `OvercookedState` with one of overcooked_ai's actions and its one-hot probabilities.

        A state that is shown again gets the same answer.

        Raises:
            ValueError: the state is of an earlier time than the last one: `reset` was not called for a new episode.
        """
        row = from_overcooked_ai(self._env, state)
        if self._previous is None or not np.array_equal(row, self._previous[0]):
            joint = np.zeros((1, 2), np.uint8) if self._previous is None else self._guess_joint_action(row)[None]
            obs = self._env.encode(row[None], self._policy.view)
            first = np.array([self._previous is None])
            self._previous = row, int(self._policy.act(obs, joint, first)[0, self._seat])
        chosen = self._previous[1]
        action = Action.INDEX_TO_ACTION[chosen]
        return action, {"action_probs": self.a_probs_from_action(action)}

    def _guess_joint_action(self, row: np.ndarray) -> np.ndarray:
        """What was played since the last state, (2,) uint8: with the own answer if that explains the new state, else
        with another own action, else `stay` beside the own answer."""
        assert self._previous is not None
        before, own = self._previous
        if self._env.time(row) < self._env.time(before):
            raise ValueError("this state is earlier than the last one: call reset at the beginning of a game")
        joint = np.full(2, STAY, np.uint8)
        for played in (own, *(action for action in range(NUM_ACTIONS) if action != own)):
            with suppress(ValueError):
                joint[1 - self._seat] = infer_joint_action(self._env, before, row, self._seat, played)
                joint[self._seat] = played
                return joint
        joint[self._seat] = own
        return joint
