"""Somebody else's policy, checked at every call: an action counts only as what it says it is."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from pathlib import Path
from textwrap import shorten
from typing import Any, ClassVar, Self

import numpy as np

from popgen.envs.contract import EnvSpec
from popgen.errors import UserError

SIGNATURES = {"reset": "as reset(self, batch, seed)", "act": "as act(self, obs, previous_actions, is_first)"}


class CheckedPolicy:
    """A user's policy whose faults are the user's errors.

    Args:
        name: `module:Agent`, for messages.
        policy: it, with `reset` and `act`.
        view: that it wants.
        spec: of the environment that it plays in.
        defined: how its methods are defined, for messages; without it as those of `Policy`.
    """

    kind: ClassVar[str] = "user_agent"

    def __init__(self, name: str, policy: Any, view: str, spec: EnvSpec, defined: str = "") -> None:
        self.view = view
        self._name, self._policy, self._actions, self._defined = name, policy, spec.num_actions, defined

    def reset(self, batch: int, seed: int) -> None:
        """See `Policy.reset`.

        Raises:
            UserError: it fails.
        """
        self._call_agent("reset", batch, seed)

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """See `Policy.act`.

        Raises:
            UserError: it fails, or what it gives is no action for each row and seat.
        """
        chosen = self._call_agent("act", obs, previous_actions, is_first)
        return self._read_actions(chosen, previous_actions.shape)

    def _call_agent(self, method: str, *values: Any) -> Any:
        try:
            return getattr(self._policy, method)(*values)
        except UserError:
            raise
        except (Exception, SystemExit) as error:  # of the user's own code
            problem = f"fails in {method} ({describe_fault(error)})"
            fix = _find_fault(error) or f"define it {self._defined or SIGNATURES[method]}"
            raise UserError(self._name, problem, fix) from error

    def _read_actions(self, chosen: Any, shape: tuple[int, ...]) -> np.ndarray:
        """As uint8, after all that a cast would change was refused."""
        fix = f"give a whole number from 0 to {self._actions - 1} for each row and seat"
        try:
            actions = np.asarray(chosen)
        except Exception as error:
            raise UserError(self._name, f"act gives no array ({describe_fault(error)})", fix) from error
        if actions.dtype.kind not in "iu":
            raise UserError(self._name, f"act gives actions of dtype {actions.dtype}", fix)
        if actions.shape != shape:
            raise UserError(self._name, f"act gives an array of shape {actions.shape}, not {shape}", fix)
        if (wrong := actions[(actions < 0) | (actions >= self._actions)]).size:
            raise UserError(self._name, f"act gives the action {wrong[0]}", fix)
        return actions.astype(np.uint8)

    def config(self) -> dict[str, Any]:
        """Nothing: the agent is the user's."""
        return {}

    def weights(self) -> dict[str, np.ndarray]:
        """Nothing: the agent is the user's."""
        return {}

    @classmethod
    def from_parts(cls, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec) -> Self:
        """Raises ValueError: it is not an artefact."""
        raise ValueError("a user's agent is not loaded from a population")


def describe_fault(error: BaseException) -> str:
    """Kind of an error in somebody else's code, and what it says, cut where that is long."""
    said = str(error)
    return shorten(f"{type(error).__name__}: {said}" if said else type(error).__name__, 300, placeholder="...")


def _find_fault(error: BaseException) -> str:
    """Where the user's code failed; empty where it was not reached."""
    own = Path(__file__).parent
    frames = [one for one in traceback.extract_tb(error.__traceback__) if Path(one.filename).parent != own]
    if not frames:
        return ""
    last = [one for one in frames if one.filename == frames[0].filename][-1]
    return f"correct {Path(last.filename).name}, line {last.lineno}"
