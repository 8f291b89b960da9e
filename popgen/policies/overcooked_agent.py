"""A popgen policy as an `Agent` of overcooked_ai, for its AgentPair, its environment and its tools.

Needs overcooked_ai; nothing else in popgen imports this module.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from overcooked_ai_py.agents.agent import Agent
from overcooked_ai_py.mdp.actions import Action

from popgen.envs.overcooked import OvercookedEnv
from popgen.envs.overcooked.bridge import from_overcooked_ai, infer_joint_action
from popgen.errors import UserError
from popgen.play.policy import Policy


class OvercookedAgent(Agent):
    """Plays one seat from overcooked_ai's own states.

    overcooked_ai shows an agent only states, so the partner's last action is inferred from its effect; where several
    actions have the same effect, such as steps against a wall, `stay` stands for them. The own actions are those
    that were answered.

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

        Raises:
            ValueError: the state does not follow from the last one: `reset` was not called for a new episode.
        """
        row = from_overcooked_ai(self._env, state)
        joint = np.zeros((1, 2), np.uint8)
        if self._previous is not None:
            before, own = self._previous
            joint[0, self._seat] = own
            joint[0, 1 - self._seat] = infer_joint_action(self._env, before, row, self._seat, own)
        obs = self._env.encode(row[None], self._policy.view)
        first = np.array([self._previous is None])
        chosen = int(self._policy.act(obs, joint, first)[0, self._seat])
        self._previous = row, chosen
        action = Action.INDEX_TO_ACTION[chosen]
        return action, {"action_probs": self.a_probs_from_action(action)}
