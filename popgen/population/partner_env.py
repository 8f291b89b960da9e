"""One seat of an environment as a Gymnasium environment, the other taken by sampled members of populations.

Any code that trains one agent in one Gymnasium environment trains an ego with it (docs/examples).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from popgen.envs.reward import training_reward
from popgen.errors import UserError
from popgen.population.chosen_members import ChosenMembers, load_members
from popgen.population.store import Population, check_compatible

REWARDS = ("events", "environment")


class SeatStep(NamedTuple):
    """What Gymnasium's `step` gives, in its order."""

    observation: np.ndarray
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


class PartnerEnv(gymnasium.Env[np.ndarray, int]):
    """One agent beside a member that is drawn, with the seat, at every reset.

    The observation is the seat's flat view followed by its one-hot number; infos say who plays: `population`, `member`
    and `seat` (the agent's), and at every step the team's `score`.

    Args:
        populations: one or several of one environment, or members of them.
        view: a flat view of the environment.
        reward: `events`, what popgen's methods learn from, or `environment`, the environment's own joint reward.
        render_mode: `rgb_array` or None.

    Raises:
        UserError: no members, other environments, an unknown reward or a view that is not flat.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 5}

    def __init__(
        self,
        populations: Sequence[Population | ChosenMembers],
        *,
        view: str = "features",
        reward: str = "events",
        render_mode: str | None = None,
    ) -> None:
        chosen = [one if isinstance(one, ChosenMembers) else ChosenMembers.of_all(one) for one in populations]
        if not chosen or not all(one.members for one in chosen):
            raise UserError("populations", "hold no members", "give one that does")
        self._env = chosen[0].population.make_env()
        spec = self._env.spec
        for one in chosen:
            check_compatible(one.population, spec)
        if view not in spec.views or len(spec.views[view].shape) != 1:
            raise UserError("view", f"{view!r} is no flat view of {spec.name}", "choose features")
        if reward not in REWARDS:
            raise UserError("reward", f"{reward!r} is unknown", f"choose one of {', '.join(REWARDS)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserError("render_mode", f"{render_mode!r} is unknown", "choose rgb_array or None")
        self._view, self._reward, self.render_mode = view, reward, render_mode
        self._members = [(str(one.population.path), member) for one in chosen for member in one.members]
        self._partners = [one.population[member] for one in chosen for member in one.members]
        self._partner, self._seat = 0, 0
        self._previous = np.zeros((1, spec.num_players), np.uint8)
        self._first = np.ones(1, bool)
        seen = spec.views[view]
        dtype = np.dtype(seen.dtype)
        high = 1.0 if seen.binary else seen.scale
        low = -high if np.issubdtype(dtype, np.floating) and not seen.binary else 0.0
        shape = (seen.shape[0] + spec.num_players,)
        self.observation_space = spaces.Box(dtype.type(low), dtype.type(max(high, 1.0)), shape, dtype.type)
        self.action_space = spaces.Discrete(spec.num_actions)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode with another partner, or with `options["partner"]` (its place among all) and
        `options["seat"]`, the agent's."""
        super().reset(seed=seed)
        given = options or {}
        self._partner = int(given.get("partner", self.np_random.integers(len(self._partners))))
        self._seat = int(given.get("seat", self.np_random.integers(2)))
        if not 0 <= self._partner < len(self._partners) or self._seat not in (0, 1):
            raise ValueError(f"options: no partner {self._partner} of {len(self._partners)} or no seat {self._seat}")
        self._env.reset(seed=int(self.np_random.integers(2**31)))
        self._partners[self._partner].reset(1, int(self.np_random.integers(2**31)))
        self._previous[:], self._first[:] = 0, True
        return self._observe_seat(), self._describe_step(0.0)

    def step(self, action: int) -> SeatStep:
        """The agent's action beside its partner's; raises ValueError for an action that there is not."""
        if not self.action_space.contains(action):
            raise ValueError(f"action: need a whole number below {self._env.spec.num_actions}, got {action!r}")
        partner = self._partners[self._partner]
        joint = partner.act(self._env.observe(partner.view), self._previous, self._first).copy()
        joint[0, self._seat] = action
        result = self._env.step(joint)
        self._previous, self._first = joint, np.zeros(1, bool)
        paid = training_reward(self._env.spec, result) if self._reward == "events" else result.reward
        ends = bool(result.terminated[0]), bool(result.truncated[0])
        return SeatStep(self._observe_seat(), float(paid[0]), *ends, self._describe_step(float(result.score[0])))

    def render(self) -> np.ndarray | None:
        """A picture (H, W, 3) uint8; None without a render mode."""
        return self._env.render_rgb(0) if self.render_mode == "rgb_array" else None

    def _observe_seat(self) -> np.ndarray:
        seen = self._env.observe(self._view)[0, self._seat]
        return np.concatenate([seen, np.eye(2, dtype=seen.dtype)[self._seat]])

    def _describe_step(self, score: float) -> dict[str, Any]:
        population, member = self._members[self._partner]
        return {"population": population, "member": member, "seat": self._seat, "score": score}


def make_partner_env(
    *populations: str | Path | Population,
    view: str = "features",
    reward: str = "events",
    render_mode: str | None = None,
) -> PartnerEnv:
    """A Gymnasium environment with one seat taken by sampled members of one or several populations.

    Args:
        populations: folders, each with `:1,3` behind it for some members only, or what `load_population` gave; all of
            one environment.
        view, reward, render_mode: see `PartnerEnv`.

    Raises:
        UserError: what `load_members` and `PartnerEnv` refuse.
    """
    loaded = [one if isinstance(one, Population) else load_members(str(one)) for one in populations]
    return PartnerEnv(loaded, view=view, reward=reward, render_mode=render_mode)
