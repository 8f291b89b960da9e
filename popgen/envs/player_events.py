"""What each player did in a step, for whoever counts or pays events: one list for each kind of environment."""

from __future__ import annotations

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.envs.overcooked.env import OvercookedEnv
from popgen.envs.overcooked.transition_events import HSP_EVENTS, find_transition_events, hsp_events
from popgen.types import StepBatch


def name_player_events(env: BatchedEnv) -> tuple[str, ...]:
    """Names of the F events: HSP's of transitions in Overcooked, elsewhere the environment's own."""
    return tuple(HSP_EVENTS) if isinstance(env, OvercookedEnv) else tuple(env.spec.event_names)


def count_player_events(env: BatchedEnv, states: np.ndarray, actions: np.ndarray, result: StepBatch) -> np.ndarray:
    """(B, P, F) int64, which player caused which event in one step.

    Args:
        env: of the step.
        states: (B, S) before it.
        actions: (B, P).
        result: what it gave.
    """
    if isinstance(env, OvercookedEnv):
        return hsp_events(find_transition_events(env, states, actions).astype(np.int64))
    return result.events.astype(np.int64)
