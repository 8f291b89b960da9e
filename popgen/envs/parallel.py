"""PettingZoo ParallelEnv view of any environment of the registry."""

from __future__ import annotations

import operator
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from popgen.envs.contract import BatchedEnv, ViewSpec
from popgen.envs.env_registry import make_env
from popgen.errors import UserError
from popgen.types import StepBatch

REWARDS = ("environment", "events")
RENDER_MODES = ("rgb_array", "ansi")


class PopgenParallelEnv(ParallelEnv[str, np.ndarray, int]):
    """One environment as `player_0` and `player_1`.

    Observations are those of one view, of its shape and dtype. Both players get the same reward; infos hold the
    player's own `events` (name -> count) and the team's `score`. Like every ParallelEnv it must be reset after the
    agents have left (`agents` is empty).

    Args:
        env: batched environment with one copy.
        view: `features`, or another view of the environment such as `lossless`.
        reward: `environment`, the environment's own joint reward, or `events`, the weighted events of both players.
        render_mode: `rgb_array`, `ansi` or None.
        dtype: of observations, such as `float32` for networks that take no bytes (RLlib's default one); None for the
            view's own. Values stay the same.

    Raises:
        UserError: more than one copy, an unknown view, reward or render mode, or a dtype that cannot hold the values.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "popgen",
        "render_modes": list(RENDER_MODES),
        "render_fps": 5,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        env: BatchedEnv,
        *,
        view: str = "features",
        reward: str = "environment",
        render_mode: str | None = None,
        dtype: str | None = None,
    ) -> None:
        if env.num_envs != 1:
            raise UserError("num_envs", f"a ParallelEnv shows one environment, got {env.num_envs}", "use num_envs=1")
        _check_choice("view", view, tuple(env.spec.views))
        _check_choice("reward", reward, REWARDS)
        _check_choice("render_mode", render_mode, (None, *RENDER_MODES))
        self.env, self.view, self.reward, self.render_mode = env, view, reward, render_mode
        # PettingZoo declares a variable of the class; the name is known here first.
        vars(self)["metadata"] = {**type(self).metadata, "name": env.spec.name}
        self.possible_agents = [f"player_{player}" for player in range(env.spec.num_players)]
        self.agents: list[str] = []
        seen = env.spec.views[view]
        if dtype is not None:
            seen = replace(seen, dtype=_check_dtype(dtype, seen))
        self.dtype = np.dtype(seen.dtype)
        self.observation_spaces = {agent: _make_space(seen, seen.shape) for agent in self.possible_agents}
        self.action_spaces = {agent: spaces.Discrete(env.spec.num_actions) for agent in self.possible_agents}
        self.state_space = _make_space(seen, (env.spec.num_players, *seen.shape))
        self._weights = np.asarray(env.spec.event_weights, dtype=np.float64)

    def observation_space(self, agent: str) -> spaces.Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Start an episode, or continue from the state row `options["state"]` (S,); other options are ignored.

        Raises:
            ValueError: `options["state"]` is not a state of this environment.
        """
        self.env.reset(seed=seed)
        if options and options.get("state") is not None:
            row = options["state"]
            row = row if isinstance(row, np.ndarray) else np.asarray(row, dtype=self.env.spec.state_dtype)
            self.env.set_state(row[None])
        self.agents = list(self.possible_agents)
        nothing = np.zeros((len(self.agents), self.env.spec.num_events), dtype=np.uint8)
        return self._split_observations(), self._make_infos(nothing, 0.0)

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Play one action per player.

        Raises:
            RuntimeError: the episode is over.
            ValueError: a player's action is missing or unknown.
        """
        if not self.agents:
            raise RuntimeError("the episode is over: call reset before step")
        if missing := [agent for agent in self.agents if agent not in actions]:
            raise ValueError(f"actions: none given for {', '.join(missing)}")
        batch = self.env.step(np.array([[_check_action(agent, actions[agent]) for agent in self.agents]]))
        players = self.agents
        reward = self._pay_team(batch)
        terminated, truncated = bool(batch.terminated[0]), bool(batch.truncated[0])
        self.agents = [] if terminated or truncated else list(self.possible_agents)
        return (
            self._split_observations(),
            dict.fromkeys(players, reward),
            dict.fromkeys(players, terminated),
            dict.fromkeys(players, truncated),
            self._make_infos(batch.events[0], float(batch.score[0])),
        )

    def state(self) -> np.ndarray:
        """The joint observation (P, *view.shape)."""
        return self.env.observe(self.view)[0].astype(self.dtype, copy=False)

    def render(self) -> np.ndarray | str | None:
        """A picture (H, W, 3) uint8 or text, as `render_mode` says; None without a render mode."""
        if self.render_mode == "rgb_array":
            return self.env.render_rgb(0)
        return self.env.render_text(0) if self.render_mode == "ansi" else None

    def _split_observations(self) -> dict[str, np.ndarray]:
        return dict(zip(self.possible_agents, self.state(), strict=True))

    def _pay_team(self, batch: StepBatch) -> float:
        if self.reward == "environment":
            return float(batch.reward[0])
        return float((batch.events[0] * self._weights).sum())

    def _make_infos(self, events: np.ndarray, score: float) -> dict[str, dict[str, Any]]:
        names = self.env.spec.event_names
        return {
            agent: {"events": dict(zip(names, map(int, row), strict=True)), "score": score}
            for agent, row in zip(self.possible_agents, events, strict=True)
        }


def parallel_env(
    name: str,
    *,
    view: str = "features",
    reward: str = "environment",
    render_mode: str | None = None,
    dtype: str | None = None,
    seed: int = 0,
    **params: Any,
) -> PopgenParallelEnv:
    """A registered environment as a ParallelEnv; `params` go to the environment (see `make_env`).

    Raises:
        UserError: unknown environment, parameter, view, reward, render mode or dtype.
    """
    env = make_env(name, 1, seed=seed, **params)
    return PopgenParallelEnv(env, view=view, reward=reward, render_mode=render_mode, dtype=dtype)


def _check_action(agent: str, action: Any) -> int:
    """A whole number, of whatever integer type.

    Raises:
        ValueError: it is something else, which a cast would change.
    """
    try:
        return operator.index(action.item() if isinstance(action, np.ndarray) and action.size == 1 else action)
    except TypeError:
        raise ValueError(f"actions: {agent} plays {action!r}, which is no whole number") from None


def _check_dtype(dtype: str, view: ViewSpec) -> str:
    """The dtype's name, if it holds the view's values as they are.

    Raises:
        UserError: it does not.
    """
    try:
        wanted = np.dtype(dtype)
    except TypeError:
        raise UserError("dtype", f"{dtype!r} is unknown", "choose one such as float32") from None
    # Half the bits of a view of floats are a choice; counts must stay whole, and signs must stay.
    if wanted.kind not in "iuf" or not np.can_cast(view.dtype, wanted, "same_kind"):
        raise UserError("dtype", f"{wanted.name} does not hold {view.dtype}", "choose one such as float32")
    return wanted.name


def _make_space(view: ViewSpec, shape: tuple[int, ...]) -> spaces.Box:
    dtype = np.dtype(view.dtype)
    high = 1.0 if view.binary else view.scale
    low = -high if np.issubdtype(dtype, np.floating) and not view.binary else 0.0
    return spaces.Box(low=dtype.type(low), high=dtype.type(high), shape=shape, dtype=dtype.type)


def _check_choice(field: str, value: Any, choices: tuple[Any, ...]) -> None:
    if value not in choices:
        raise UserError(field, f"{value!r} is unknown", f"choose one of {', '.join(map(str, choices))}")
