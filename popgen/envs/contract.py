"""The one protocol of popgen's environments: batched, exact, restartable from any state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from popgen.types import StepBatch


@dataclass(frozen=True)
class ViewSpec:
    """One way to look at a state, as every player sees it.

    Attributes:
        shape: of one player's observation.
        dtype: numpy dtype name.
        binary: all entries are 0 or 1 (Bernoulli reconstruction is then exact).
        scale: largest value an entry can take, to bring counts into [0, 1].
        maxima: for a view of channels (last dimension) that are counts of different size, the largest value of each;
            those of maximum 1 hold 0 and 1 only. None where `scale` serves all.
        swap: for a flat view, index array with obs_of_player_1 == obs_of_player_0[swap]; else None.
        own: for a flat view, the entries that describe the looking player alone, in parts (where it stands, where it
            looks, what it holds); else empty.
    """

    shape: tuple[int, ...]
    dtype: str
    binary: bool
    scale: float = 1.0
    swap: tuple[int, ...] | None = field(default=None, repr=False)
    maxima: tuple[float, ...] | None = field(default=None, repr=False)
    own: tuple[tuple[int, ...], ...] = ()


@dataclass(frozen=True)
class EnvSpec:
    """Everything the rest of popgen knows about an environment.

    Attributes:
        name: registry name, such as `overcooked/cramped_room`.
        horizon: steps after which an episode is truncated.
        num_actions, action_names: the discrete actions of each player.
        state_size, state_dtype: a state is one row of S numbers of this dtype.
        views: name -> ViewSpec; `features` always exists and is flat.
        event_names, event_weights: the event vector per player and its linear reward.
        score_name: unit of `StepBatch.score`, such as `dishes`.
        params: JSON-able parameters that make the same environment again through the registry.
        fingerprint: sha256 over name-independent rules (grid and parameters): two environments
            with the same fingerprint behave the same.
        notes: what a user should know before training here, a sentence each; no part of what the environment is.
    """

    name: str
    horizon: int
    num_actions: int
    action_names: tuple[str, ...]
    state_size: int
    state_dtype: str
    views: dict[str, ViewSpec]
    event_names: tuple[str, ...]
    event_weights: tuple[float, ...]
    score_name: str
    params: dict[str, Any] = field(default_factory=dict)
    fingerprint: str = ""
    num_players: int = 2
    notes: tuple[str, ...] = field(default=(), compare=False)

    @property
    def num_events(self) -> int:
        return len(self.event_names)


class BatchedEnv(ABC):
    """B copies of one environment stepped together by one seeded generator.

    Nothing resets by itself: after a step with `done`, call `reset(indices=...)` for those rows. An environment can be
    used in a `with` statement, which closes it.
    """

    spec: EnvSpec
    num_envs: int

    def __repr__(self) -> str:
        views = ", ".join(f"{name} {view.shape} {view.dtype}" for name, view in self.spec.views.items())
        copies = f"{self.num_envs} environment{'s' if self.num_envs > 1 else ''}"
        return (
            f"<{type(self).__name__} {self.spec.name}: {copies}, {self.spec.horizon} steps an episode, views {views}>"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:  # noqa: B027 (nothing to do is the rule)
        """Give back what the environment holds; those of popgen hold memory alone."""

    @abstractmethod
    def reset(self, seed: int | None = None, indices: np.ndarray | None = None) -> None:
        """Start new episodes in all (or the given) environments; `seed` restarts the generator."""

    @abstractmethod
    def step(self, actions: np.ndarray) -> StepBatch:
        """Play joint `actions` (B, P); raises ValueError on a wrong shape or an unknown action."""

    @abstractmethod
    def simulate(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, StepBatch]:
        """The exact dynamics F as a pure function: the environment's own states do not change.

        Args:
            states: (..., S), with any leading shape.
            actions: (..., P).

        Returns:
            The next states (..., S), and what the step gave, with the leading shape in place of B.

        Raises:
            ValueError: wrong shape or dtype, or an unknown action.
        """

    @abstractmethod
    def get_state(self, indices: np.ndarray | None = None) -> np.ndarray:
        """Copy of the states, (B, S): all that determines the future, the time step included."""

    @abstractmethod
    def set_state(self, states: np.ndarray, indices: np.ndarray | None = None) -> None:
        """Continue from the given states; raises ValueError on a wrong shape or dtype."""

    @abstractmethod
    def encode(self, states: np.ndarray, view: str = "features") -> np.ndarray:
        """Observations (..., P, *view.shape) of any states (..., S) of this environment."""

    @abstractmethod
    def time(self, states: np.ndarray) -> np.ndarray:
        """Time step within the episode of any states (..., S) -> (...) int64."""

    @abstractmethod
    def set_time(self, time: np.ndarray) -> None:
        """Overwrite the time steps (B,), to stagger the ends of a batch's episodes."""

    @abstractmethod
    def render_text(self, index: int = 0) -> str:
        """The state of one environment as text."""

    @abstractmethod
    def render_rgb(self, index: int = 0) -> np.ndarray:
        """The state of one environment as an (H, W, 3) uint8 picture."""

    def generator_state(self) -> dict[str, Any]:
        """What, beside the states, decides how these environments go on (JSON-able); empty where nothing is drawn."""
        return {}

    def load_generator_state(self, state: dict[str, Any]) -> None:
        """Draw on from `generator_state()`; raises ValueError for a state that is not of this environment."""
        if state:
            raise ValueError("this environment draws nothing")

    def observe(self, view: str = "features", out: np.ndarray | None = None) -> np.ndarray:
        """Observations (B, P, *view.shape) of the current states, in `out` if it is given."""
        seen = self.encode(self.get_state(), view)
        if out is None:
            return seen
        out[...] = seen
        return out
