"""RLlib's algorithm without RLlib: iterations whose actors, counts and scores are given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from popgen.envs.contract import EnvSpec
from popgen.methods.mappo.algorithm import Report
from popgen.methods.mappo.config import PpoConfig
from popgen.methods.mappo.play_record import Counted
from popgen.methods.mappo.training_job import sizes_of
from popgen.nets.feed_forward import FeedForwardNet
from popgen.nets.weights import weights_of
from popgen.types import Weights

TIMES = {"learning": 1.0}


def actor_weights(spec: EnvSpec, ppo: PpoConfig, value: float) -> Weights:
    """An actor of the recipe's sizes, all of whose weights are `value`."""
    net = FeedForwardNet(spec.views[ppo.view], spec.num_actions, spec.num_players, sizes_of(ppo))
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.fill_(value)
    return weights_of(net)


@dataclass
class StandInMappo:
    """Plays what `iterations` say, one in each `train()`.

    Attributes:
        trained: the policies that RLlib would train.
        iterations: each one's counts.
        told: policy -> its scores, the same at all times, or one for each iteration.
        habits: policy -> what it does in a step.
    """

    spec: EnvSpec
    ppo: PpoConfig
    trained: Sequence[int]
    iterations: Sequence[Sequence[Counted]]
    told: Mapping[int, Sequence[float]]
    habits: Mapping[int, np.ndarray] = field(default_factory=dict)
    rounds: int = 0
    report: Report = field(default_factory=Report)

    @property
    def job(self) -> Any:
        """Whose play is counted."""
        return SimpleNamespace(owners=list(self.told))

    @property
    def played(self) -> Any:
        """What the policies do."""
        return SimpleNamespace(habits=self.habits)

    @property
    def progress(self) -> float:
        """Share of the iterations."""
        return self.rounds / len(self.iterations)

    @property
    def finished(self) -> bool:
        """All were played."""
        return self.rounds == len(self.iterations)

    def train(self) -> None:
        """The next iteration."""
        counted = list(self.iterations[self.rounds])
        self.rounds += 1
        figures = {member: {"entropy": float(member), **self.scores(member)} for member in self.trained}
        self.report = Report(counted, figures, TIMES)

    def scores(self, member: int) -> dict[str, float]:
        """Those of the latest iteration."""
        told = self.told.get(member, ())
        return {"sp": told[min(self.rounds, len(told)) - 1]} if told and self.rounds else {}

    def actors(self) -> dict[int, Weights]:
        """Each filled with the number of updates so far."""
        return {member: actor_weights(self.spec, self.ppo, float(self.rounds)) for member in self.trained}

    def critics(self, member: int) -> Weights:
        """None."""
        return {}

    def snapshot(self) -> dict[str, Any]:
        """The number of iterations."""
        return {"rounds": self.rounds}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Go on from `snapshot()`."""
        self.rounds = int(state["rounds"])

    def stop(self) -> None:
        """Nothing runs."""
