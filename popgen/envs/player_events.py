"""What each player did in a step, for whoever counts or pays events: one list for each kind of environment, and one for
BR-Div."""

from __future__ import annotations

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.envs.overcooked.env import OvercookedEnv
from popgen.envs.overcooked.transition_events import HSP_EVENTS, find_transition_events, hsp_events
from popgen.types import StepBatch

SPARSE_REWARD = "sparse_r"
"""What a player earned by deliveries, under ZSC-Eval's name."""

BR_DIV_EVENTS = (
    *("put_onion_on_X", "put_dish_on_X", "put_soup_on_X"),
    *("pickup_onion_from_X", "pickup_onion_from_O", "pickup_dish_from_X", "pickup_dish_from_D", "pickup_soup_from_X"),
    *("USEFUL_DISH_PICKUP", "SOUP_PICKUP", "PLACEMENT_IN_POT", "delivery", "STAY", SPARSE_REWARD),
)
"""The 14 kinds of BR-Div in ZSC-Eval (`zsceval/scripts/prep/select_bias_agent_br.py`, layouts of one recipe): HSP's
without MOVEMENT, IDLE_MOVEMENT, IDLE_INTERACT_X and IDLE_INTERACT_EMPTY, and the sparse reward."""


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


def name_diversity_events(env: BatchedEnv) -> tuple[str, ...]:
    """Names of BR-Div's F kinds: BR_DIV_EVENTS in Overcooked, elsewhere the environment's own events."""
    return BR_DIV_EVENTS if isinstance(env, OvercookedEnv) else tuple(env.spec.event_names)


def count_diversity_events(env: BatchedEnv, states: np.ndarray, actions: np.ndarray, result: StepBatch) -> np.ndarray:
    """(B, P, F) float64, how much of BR-Div's kinds each player did in one step.

    The reward of a step is the player's who delivers, in equal parts where both do.

    Args:
        env: of the step.
        states: (B, S) before it.
        actions: (B, P).
        result: what it gave.
    """
    counts = count_player_events(env, states, actions, result).astype(np.float64)
    if not isinstance(env, OvercookedEnv):
        return counts
    names = name_player_events(env)
    delivered = counts[..., names.index("delivery")]
    share = delivered / np.maximum(1.0, delivered.sum(-1, keepdims=True))
    kinds = counts[..., [names.index(name) for name in BR_DIV_EVENTS if name != SPARSE_REWARD]]
    return np.concatenate([kinds, (result.reward[:, None] * share)[..., None]], -1)
