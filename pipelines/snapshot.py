"""What learners publish, and the policies that were seen to play well."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ray

from popgen.nets.weights import Weights


@dataclass(frozen=True)
class Published:
    """References to what the agent learner gave last, and to the world model it imagined with.

    acting: filter and actor; model: the whole world model, of the same filter; critics.
    """

    acting: Any
    model: Any
    critics: Any

    def weights(self) -> dict[str, Weights]:
        """The arrays themselves: acting, model, critics."""
        acting, model, critics = ray.get([self.acting, self.model, self.critics])
        return {"acting": acting, "model": model, "critics": critics}

    @staticmethod
    def of(weights: dict[str, Weights]) -> Published:
        """Publish saved `weights()` again."""
        return Published(*(ray.put(weights[name]) for name in ("acting", "model", "critics")))


@dataclass(frozen=True)
class Snapshot:
    """A policy as it played some real episodes, and what it scored in self-play and strongest cross-play."""

    published: Published
    sp: float
    xp: float

    @property
    def merit(self) -> float:
        """Self-play less the strongest cross-play: what a member is chosen by."""
        return self.sp - self.xp

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"published": self.published.weights(), "sp": self.sp, "xp": self.xp}

    @staticmethod
    def of(state: dict[str, Any] | None) -> Snapshot | None:
        """From `state()`; None stays None."""
        if state is None:
            return None
        return Snapshot(Published.of(state["published"]), float(state["sp"]), float(state["xp"]))
