"""Behaviour cloning: a network that predicts what a recorded player did from what the player saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from torch import Tensor

from popgen.envs.contract import EnvSpec
from popgen.humans.clone_policy import ClonePolicy, CloneSettings
from popgen.humans.recordings import HumanGame, make_human_env


@dataclass(frozen=True)
class CloneTraining:
    """Settings of the fit.

    Attributes:
        epochs: passes over the games.
        batch: players' steps of a gradient.
        learning_rate: of Adam, falling linearly to 0.
        weight_decay: of AdamW.
    """

    epochs: int = 60
    batch: int = 512
    learning_rate: float = 3e-3
    weight_decay: float = 1e-4


@dataclass(frozen=True)
class PlayedSteps:
    """What single players saw and did: features (N, F) float32, extras (N, X) float32, actions (N,) int64."""

    features: Tensor
    extras: Tensor
    actions: Tensor

    @classmethod
    def of(cls, games: Sequence[HumanGame], policy: ClonePolicy) -> PlayedSteps:
        """All players' steps in games of one layout, as a clone would see them."""
        env = make_human_env(games[0].layout)
        states = np.concatenate([game.states[:-1] for game in games])
        actions = np.concatenate([game.actions for game in games]).reshape(-1)
        features, extras = policy.inputs(env.encode(states))
        return cls(features.float(), extras, torch.from_numpy(actions.astype(np.int64)))


def fit_clone(games: Sequence[HumanGame], settings: CloneSettings, training: CloneTraining, seed: int) -> ClonePolicy:
    """A network fitted to all players of the games by maximum likelihood; the same seed gives the same weights."""
    policy = ClonePolicy(make_human_env(games[0].layout).spec, settings, seed=seed)
    steps = PlayedSteps.of(games, policy)
    optimiser = torch.optim.AdamW(
        policy.net.parameters(), lr=training.learning_rate, weight_decay=training.weight_decay
    )
    generator = torch.Generator().manual_seed(seed)
    rounds = training.epochs * -(-len(steps.actions) // training.batch)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.01, rounds)
    for _ in range(training.epochs):
        for rows in torch.randperm(len(steps.actions), generator=generator).split(training.batch):
            logits = policy.net(steps.features[rows], steps.extras[rows])
            loss = torch.nn.functional.cross_entropy(logits, steps.actions[rows])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return policy


def change_settings(policy: ClonePolicy, spec: EnvSpec, settings: CloneSettings) -> ClonePolicy:
    """A clone with the same network that acts by other settings; the network's sizes stay."""
    kept = replace(settings, units=policy.settings.units, layers=policy.settings.layers)
    return ClonePolicy.from_parts(asdict(kept), policy.weights(), spec)


@torch.inference_mode()
def negative_log_likelihood(policy: ClonePolicy, games: Sequence[HumanGame]) -> float:
    """Mean over steps and players of -log of what the network gives the recorded action, in nats."""
    steps = PlayedSteps.of(games, policy)
    given = policy.probabilities(policy.net(steps.features, steps.extras).numpy())
    return float(-np.log(given[np.arange(len(given)), steps.actions.numpy()] + 1e-12).mean())
