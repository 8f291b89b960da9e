"""Policies without a world model: uniform-random, idle, and a feed-forward network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import nn

from popgen.envs.base import EnvSpec, ViewSpec
from popgen.nets.weights import load_weights, weights_of
from popgen.shapes import check


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

    def reset(self, batch: int, seed: int) -> None:
        """Restart the generator; there is no memory."""
        self._rng = np.random.default_rng(seed)

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """Draw (B, P) actions; the observation counts for its batch size only."""
        size = obs.shape[:2]
        if self.probabilities is None:
            return self._rng.integers(0, self.num_actions, size, dtype=np.uint8)
        bounds = np.cumsum(self.probabilities)[:-1]  # the last bound may round to below 1
        return np.searchsorted(bounds, self._rng.random(size), side="right").astype(np.uint8)

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
        self._index = list(action_names).index(action)

    def reset(self, batch: int, seed: int) -> None:
        """There is nothing to forget."""

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """(B, P) times the same action."""
        return np.full(obs.shape[:2], self._index, np.uint8)

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


class FeedForwardPolicy:
    """One multi-layer perceptron for all seats, on the seat's own features and its one-hot number.

    Args:
        view: the flat view it reads; entries are divided by its scale.
        num_actions: A.
        num_players: P.
        units, layers: of the hidden layers (tanh).
        greedy: take the likeliest action instead of drawing one.
        seed: of the initial weights (PyTorch's default initialisation).
    """

    kind: ClassVar[str] = "feed_forward"

    def __init__(
        self,
        view: ViewSpec,
        num_actions: int,
        num_players: int = 2,
        *,
        units: int = 128,
        layers: int = 2,
        greedy: bool = False,
        seed: int = 0,
    ) -> None:
        if len(view.shape) != 1:
            raise ValueError(f"a feed-forward policy needs a flat view, got shape {view.shape}")
        self.view = "features"
        self.units, self.layers, self.greedy = int(units), int(layers), bool(greedy)
        self._players, self._features, self._scale = num_players, view.shape[0], view.scale
        sizes = [view.shape[0] + num_players] + [self.units] * self.layers
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            hidden = [part for i, o in pairwise(sizes) for part in (nn.Linear(i, o), nn.Tanh())]
            self.net = nn.Sequential(*hidden, nn.Linear(sizes[-1], num_actions))
        self._generator = torch.Generator().manual_seed(0)

    def reset(self, batch: int, seed: int) -> None:
        """Restart the generator; there is no memory."""
        self._generator.manual_seed(seed)

    def logits(self, obs: torch.Tensor) -> torch.Tensor:
        """Action logits (B, P, A) of joint observations (B, P, F)."""
        seats = torch.eye(self._players).expand(obs.shape[0], -1, -1)
        return self.net(torch.cat([obs.float() / self._scale, seats], -1))

    @torch.inference_mode()
    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """See `Policy.act`; obs is (B, P, F)."""
        check(obs, (None, self._players, self._features), "obs")
        logits = self.logits(torch.from_numpy(np.ascontiguousarray(obs)))
        if self.greedy:
            return logits.argmax(-1).numpy().astype(np.uint8)
        drawn = torch.multinomial(logits.flatten(0, 1).softmax(-1), 1, generator=self._generator)
        return drawn.view(logits.shape[:2]).numpy().astype(np.uint8)

    def config(self) -> dict[str, Any]:
        """Sizes and the way to pick an action."""
        return {"units": self.units, "layers": self.layers, "greedy": self.greedy}

    def weights(self) -> dict[str, np.ndarray]:
        """The network's parameters."""
        return weights_of(self.net)

    @classmethod
    def from_parts(cls, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec) -> Self:
        """See `Policy.from_parts`."""
        policy = cls(spec.views["features"], spec.num_actions, spec.num_players, **config)
        load_weights(policy.net, weights)
        return policy
