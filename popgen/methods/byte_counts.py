"""Bytes that methods' needs are made of: buffers' rows, segments, networks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np

from popgen.envs.contract import EnvSpec

FLOAT = 4


def state_bytes(spec: EnvSpec) -> int:
    """Of one environment's state."""
    return spec.state_size * np.dtype(spec.state_dtype).itemsize


def buffer_bytes(capacity: int, spec: EnvSpec) -> int:
    """One full replay buffer: a state, actions, events and 15 bytes of marks for each step."""
    return capacity * (state_bytes(spec) + spec.num_players * (1 + spec.num_events) + 15)


def segment_bytes(rows: int, spec: EnvSpec) -> int:
    """Segments of `rows` steps: states twice, actions, events, rewards and marks."""
    return rows * (2 * state_bytes(spec) + spec.num_players * (1 + spec.num_events) + 10)


def observation_entries(spec: EnvSpec, view: str) -> int:
    """Numbers in one player's observation; 0 for a view that the environment does not have."""
    return math.prod(spec.views[view].shape) if view in spec.views else 0


def count_numbers(build: Callable[[], Iterable[object]]) -> int:
    """Numbers that the state dictionaries of the networks hold. They are built without memory, on the meta device."""
    import torch

    with torch.device("meta"):
        networks = [network for network in build() if isinstance(network, torch.nn.Module)]
    return sum(tensor.numel() for network in networks for tensor in network.state_dict().values())
