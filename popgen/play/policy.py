"""The policy contract: reset and act on batches, and the parts that saving needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, Self, runtime_checkable

import numpy as np

from popgen.envs.contract import EnvSpec


@runtime_checkable
class Remembering(Protocol):
    """A policy that keeps something from step to step, which a checkpoint of running episodes must hold."""

    def memory(self) -> dict[str, Any]:
        """Everything since `reset` that the next actions depend on, the generator included: arrays and plain values."""
        ...

    def load_memory(self, memory: dict[str, Any]) -> None:
        """Continue from `memory()` of a policy with the same weights and batch."""


@runtime_checkable
class Policy(Protocol):
    """A player that looks at the joint observation and answers for every seat.

    The tasks are fully observed, so one recurrent filter over the joint observation serves both seats. A team
    is one policy per seat, each contributing its own seat's column of `act`.

    Attributes:
        kind: key of `popgen.policies.policy_registry.POLICIES`, stored with a saved policy.
        view: name of the view of the environment that `act` wants, such as `features`.
    """

    kind: ClassVar[str]
    view: str

    def reset(self, batch: int, seed: int) -> None:
        """Forget everything: `batch` fresh episodes, drawn from by a generator of its own seeded with `seed`."""

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """Choose actions.

        Args:
            obs: (B, P, *view.shape) current joint observation.
            previous_actions: (B, P) uint8, what was really played in the last step; ignored where `is_first`.
            is_first: (B,) bool, the row starts a new episode: its memory must be forgotten.

        Returns:
            (B, P) uint8: column p is the action this policy would take in seat p.

        Raises:
            RuntimeError: `reset` was never called, or for another number of rows.
        """
        ...

    def config(self) -> dict[str, Any]:
        """JSON-able settings, with the weights enough to build the policy again."""
        ...

    def weights(self) -> dict[str, np.ndarray]:
        """Name -> array of everything learned that `act` needs; empty if nothing is."""
        ...

    @classmethod
    def from_parts(cls, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec) -> Self:
        """Build the policy that `config()` and `weights()` came from, for environments like `spec`.

        Raises:
            ValueError: the parts do not fit each other or the environment.
        """
        ...
