"""A clone of human players: a network of one player's features, and a rule against standing still for ever."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Self

import numpy as np
import torch

from popgen.envs.contract import EnvSpec, ViewSpec
from popgen.humans.clone_inputs import NearestTargets
from popgen.nets.feed_forward import FeedForwardNet, Sizes
from popgen.nets.weights import load_weights, weights_of
from popgen.types import check, check_reset


@dataclass(frozen=True)
class CloneSettings:
    """How a clone is built and how it acts.

    Attributes:
        units, layers: of the network.
        stay_bias: taken off the logit of `stay`.
        temperature: of the choice among the other actions; how often to stay does not depend on it.
        patience: times that an action is tried in vain, without any change of the player, before it is left out until
            the player changes (0: never). People do not press on for ever, and a network without memory would.
        longest_stay: steps without any change of the player after which `stay` is left out (0: never).
    """

    units: int = 64
    layers: int = 2
    stay_bias: float = 0.0
    temperature: float = 1.0
    patience: int = 0
    longest_stay: int = 0


class ClonePolicy:
    """Draws each seat's action from a network of the seat's own features, its one-hot number and the nearest things.

    The features' urgency bit is hidden from it: recorded games are three times as long as episodes.

    Args:
        spec: of the environment; its `features` tell the own part by the view's `swap`.
        settings: see CloneSettings.
        seed: of the initial weights.

    Raises:
        ValueError: settings out of range, or features without `swap`.
    """

    kind: ClassVar[str] = "human_clone"

    def __init__(self, spec: EnvSpec, settings: CloneSettings, *, seed: int = 0) -> None:
        view = spec.views["features"]
        if view.swap is None or "stay" not in spec.action_names:
            raise ValueError("a human clone needs features with a swap, and an action to stay")
        if not settings.temperature > 0 or min(settings.patience, settings.longest_stay) < 0:
            raise ValueError(f"temperature must be above 0, patience and longest_stay not below, got {settings}")
        self.view, self.settings = "features", settings
        self._stay, self._actions, self._players = spec.action_names.index("stay"), spec.num_actions, spec.num_players
        self._size = view.shape[0]
        self._own, self._targets = own_entries(view), NearestTargets(spec)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            sizes = Sizes(settings.units, settings.layers, "leaky_relu")
            extras = spec.num_players + self._targets.size
            self.net = FeedForwardNet(view, spec.num_actions, extras, sizes)
        self._rng = np.random.default_rng(0)
        self._last: np.ndarray | None = None
        self._tried = np.zeros((0, self._players, self._actions), np.int64)
        self._still = np.zeros((0, self._players), np.int64)

    def reset(self, batch: int, seed: int) -> None:
        """See `Policy.reset`."""
        self._rng = np.random.default_rng(seed)
        self._last = None
        self._tried = np.zeros((batch, self._players, self._actions), np.int64)
        self._still = np.zeros((batch, self._players), np.int64)

    def inputs(self, obs: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """What the network reads of joint observations (B, P, F): features (B * P, F) and extras (B * P, X)."""
        rows = np.ascontiguousarray(obs).reshape(-1, self._size)
        hidden = rows.copy()
        hidden[:, -1] = 0  # urgency
        seats = np.tile(np.eye(self._players, dtype=np.float32), (len(obs), 1))
        extras = np.concatenate([seats, self._targets.look(hidden)], -1)
        return torch.from_numpy(hidden), torch.from_numpy(extras)

    def probabilities(self, logits: np.ndarray, left_out: np.ndarray | None = None) -> np.ndarray:
        """Of actions, from the network's logits (..., A), by the settings; `left_out` (..., A) bool have none."""
        logits = np.asarray(logits, np.float64).copy()
        logits[..., self._stay] -= self.settings.stay_bias
        staying = _softmax(logits)[..., self._stay]
        moves = logits / self.settings.temperature
        moves[..., self._stay] = -np.inf
        if left_out is not None:
            staying = np.where(left_out[..., self._stay], 0.0, staying)
            moves[left_out] = -np.inf
            idle = np.isneginf(moves).all(-1)  # nothing else is left
            staying = np.where(idle, 1.0, staying)
            moves[idle] = 0.0
        result = _softmax(moves) * (1.0 - staying)[..., None]
        result[..., self._stay] = staying
        return result

    @torch.inference_mode()
    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """See `Policy.act`."""
        check(obs, (None, self._players, self._size), "obs")
        check_reset(len(self._tried) or None, len(obs))
        self._follow(obs, previous_actions, is_first)
        logits = self.net(*self.inputs(obs)).numpy().reshape(len(obs), self._players, self._actions)
        bounds = self.probabilities(logits, self._left_out()).cumsum(-1)
        drawn = self._rng.random(obs.shape[:2])[..., None] * bounds[..., -1:]
        return np.minimum((drawn >= bounds).sum(-1), self._actions - 1).astype(np.uint8)

    def _left_out(self) -> np.ndarray:
        """(B, P, A) bool: actions that were tried in vain."""
        settings = self.settings
        left_out = self._tried >= settings.patience if settings.patience else np.zeros_like(self._tried, bool)
        left_out[..., self._stay] = (self._still >= settings.longest_stay) if settings.longest_stay else False
        return left_out

    def _follow(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> None:
        """Count how long each player has been as it is, and remember what it tried since."""
        own = obs[..., self._own]
        if self._last is None:
            self._last = own.copy()
        same = (own == self._last).all(-1) & ~np.asarray(is_first, bool)[:, None]
        tried = self._tried + np.eye(self._actions, dtype=np.int64)[previous_actions]
        self._tried = np.where(same[..., None], tried, 0)
        self._still = np.where(same, self._still + 1, 0)
        self._last = own.copy()

    def memory(self) -> dict[str, Any]:
        """See `Remembering`."""
        last = np.zeros((len(self._still), self._players, len(self._own)), np.uint8)
        return {
            "generator": self._rng.bit_generator.state,
            "begun": self._last is not None,
            "last": last if self._last is None else self._last.copy(),
            "tried": self._tried.copy(),
            "still": self._still.copy(),
        }

    def load_memory(self, memory: dict[str, Any]) -> None:
        """See `Remembering`."""
        self._rng.bit_generator.state = memory["generator"]
        self._last = np.array(memory["last"], np.uint8) if memory["begun"] else None
        self._tried = np.array(memory["tried"], np.int64)
        self._still = np.array(memory["still"], np.int64)

    def config(self) -> dict[str, Any]:
        """The settings."""
        return asdict(self.settings)

    def weights(self) -> dict[str, np.ndarray]:
        """The network's parameters."""
        return weights_of(self.net)

    @classmethod
    def from_parts(cls, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec) -> Self:
        """See `Policy.from_parts`."""
        policy = cls(spec, CloneSettings(**config))
        load_weights(policy.net, weights)
        return policy


def _softmax(logits: np.ndarray) -> np.ndarray:
    weights = np.exp(logits - logits.max(-1, keepdims=True))
    return weights / weights.sum(-1, keepdims=True)


def own_entries(view: ViewSpec) -> np.ndarray:
    """Indices of the features that tell of the player itself: those that a swap moves to a later place."""
    assert view.swap is not None
    swap = np.asarray(view.swap)
    return np.flatnonzero(swap > np.arange(len(swap)))
