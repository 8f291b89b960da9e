"""The reward that agents learn from: one rule for every method."""

from __future__ import annotations

import numpy as np

from popgen.envs.contract import EnvSpec
from popgen.types import Segment, StepBatch


def rewards_events(spec: EnvSpec) -> bool:
    """Whether the environment pays for events (Overcooked) rather than by its own reward (rendezvous)."""
    return any(weight != 0.0 for weight in spec.event_weights)


def covered_steps(terminated: np.ndarray, time: np.ndarray, horizon: int) -> np.ndarray:
    """(...) float32: how many steps a reward stands for. It is one, but where the task ended early: that reward may
    hold the price of all steps which the episode still had, as in rendezvous.

    Args:
        terminated: (...) bool, of steps.
        time: (...) of the state that each led to.
        horizon: of an episode.
    """
    return np.where(terminated, 1 + horizon - time, 1).astype(np.float32)


def training_reward(spec: EnvSpec, batch: StepBatch | Segment) -> np.ndarray:
    """Joint reward of steps, counted once for the team, undiscounted and unscaled.

    Where events have weights, the weighted events of all players, as XPM-WM's reward head predicts them (paper,
    section 4.1 "Event-based Rewards" and appendix D.2: Overcooked 1, 1, 1, 3, 12); else the environment's own reward.

    Args:
        spec: of the environment that gave the batch.
        batch: with events (..., P, E) and reward (...).

    Returns:
        (...) float32.

    Raises:
        ValueError: events of another number of kinds than the environment has.
    """
    if batch.events.shape[-1:] != (spec.num_events,):
        raise ValueError(f"events: expected {spec.num_events} kinds, got shape {batch.events.shape}")
    if not rewards_events(spec):
        return np.asarray(batch.reward, np.float32)
    counts = batch.events.sum(axis=-2, dtype=np.float32)
    return counts @ np.asarray(spec.event_weights, np.float32)
