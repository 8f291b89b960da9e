"""What a member of the method `guess` acts with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np

from popgen.envs import EnvSpec
from popgen.policies.simple_policies import RandomPolicy


class HabitPolicy(RandomPolicy):
    """Draws each action with a probability of its own, whatever it sees."""

    kind: ClassVar[str] = "habit"

    def config(self) -> dict[str, Any]:
        """Nothing decides how it acts but its weights."""
        return {}

    def weights(self) -> dict[str, np.ndarray]:
        """The probabilities."""
        return {"probabilities": np.asarray(self.probabilities)}

    @classmethod
    def from_parts(cls, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec) -> Self:
        """See `popgen.play.policy.Policy`."""
        return cls(spec.num_actions, weights["probabilities"].tolist())
