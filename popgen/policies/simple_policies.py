"""Policies that learn nothing: uniform-random and idle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from popgen.envs.contract import EnvSpec
from popgen.types import check_reset

if TYPE_CHECKING:
    from popgen.policies.portable_program import Program


def _no_weights(weights: Mapping[str, np.ndarray]) -> None:
    if weights:
        raise ValueError(f"expected no tensors, got {', '.join(sorted(weights))}")


class RandomPolicy:
    """Draws every action independently, uniformly or with given probabilities.

    Args:
        num_actions: A.
        probabilities: A numbers that are not negative and sum to 1; None for uniform.

    Raises:
        ValueError: probabilities of a wrong length, negative or not summing to 1.
    """

    kind: ClassVar[str] = "random"

    def __init__(self, num_actions: int, probabilities: Sequence[float] | None = None) -> None:
        self.view = "features"
        self.num_actions = int(num_actions)
        self.probabilities = None if probabilities is None else [float(p) for p in probabilities]
        if self.probabilities is not None:
            given = np.asarray(self.probabilities)
            if given.shape != (self.num_actions,) or not (given >= 0).all() or abs(given.sum() - 1.0) > 1e-6:
                raise ValueError(f"probabilities must be {self.num_actions} non-negative numbers that sum to 1")
        self._rng = np.random.default_rng(0)
        self._batch: int | None = None

    def reset(self, batch: int, seed: int) -> None:
        """Restart the generator; there is no memory."""
        self._rng, self._batch = np.random.default_rng(seed), batch

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """Draw (B, P) actions; the observation counts for its batch size only."""
        size = obs.shape[:2]
        check_reset(self._batch, len(obs))
        if self.probabilities is None:
            return self._rng.integers(0, self.num_actions, size, dtype=np.uint8)
        bounds = np.cumsum(self.probabilities)[:-1]  # the last bound may round to below 1
        return np.searchsorted(bounds, self._rng.random(size), side="right").astype(np.uint8)

    def memory(self) -> dict[str, Any]:
        """The generator; see `popgen.play.policy.Remembering`."""
        return {"generator": self._rng.bit_generator.state, "batch": self._batch}

    def load_memory(self, memory: dict[str, Any]) -> None:
        """Draw on from `memory()`."""
        self._rng.bit_generator.state, self._batch = memory["generator"], memory["batch"]

    def to_program(self) -> Program:
        """See `popgen.policies.portable_program.Portable`."""
        from popgen.policies.portable_program import write_constant  # needs torch, which random play does not

        shares = np.array(self.probabilities or [1.0] * self.num_actions)
        with np.errstate(divide="ignore"):
            return write_constant(np.log(shares).tolist())

    def config(self) -> dict[str, Any]:
        """The action probabilities, None for uniform."""
        return {"probabilities": self.probabilities}

    def weights(self) -> dict[str, np.ndarray]:
        """Nothing is learned."""
        return {}

    @classmethod
    def from_parts(cls, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec) -> Self:
        """See `Policy.from_parts`."""
        _no_weights(weights)
        return cls(spec.num_actions, **config)


class IdlePolicy:
    """Always plays one action, by default the environment's `stay`.

    Raises:
        ValueError: the environment has no action of that name.
    """

    kind: ClassVar[str] = "idle"

    def __init__(self, action_names: Sequence[str], action: str = "stay") -> None:
        if action not in action_names:
            raise ValueError(f"no action {action!r} among {', '.join(action_names)}")
        self.view = "features"
        self.action = action
        self._index, self._num_actions = list(action_names).index(action), len(action_names)
        self._batch: int | None = None

    def reset(self, batch: int, seed: int) -> None:
        """There is nothing to forget."""
        self._batch = batch

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """(B, P) times the same action."""
        check_reset(self._batch, len(obs))
        return np.full(obs.shape[:2], self._index, np.uint8)

    def to_program(self) -> Program:
        """See `popgen.policies.portable_program.Portable`."""
        from popgen.policies.portable_program import write_constant  # needs torch, which random play does not

        return write_constant([0.0 if action == self._index else -np.inf for action in range(self._num_actions)])

    def config(self) -> dict[str, Any]:
        """The name of the action."""
        return {"action": self.action}

    def weights(self) -> dict[str, np.ndarray]:
        """Nothing is learned."""
        return {}

    @classmethod
    def from_parts(cls, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec) -> Self:
        """See `Policy.from_parts`."""
        _no_weights(weights)
        return cls(spec.action_names, **config)
