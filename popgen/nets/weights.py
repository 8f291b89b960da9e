"""Weights as plain numpy dictionaries: what travels between processes and into safetensors."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

Weights = dict[str, np.ndarray]


def weights_of(module: nn.Module) -> Weights:
    """Copies of all parameters and persistent buffers."""
    return {name: value.detach().cpu().numpy().copy() for name, value in module.state_dict().items()}


def load_weights(module: nn.Module, weights: Weights) -> None:
    """Fill a module; raises RuntimeError naming missing, unexpected or misshapen entries."""
    module.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in weights.items()})


def prefixed(prefix: str, weights: Weights) -> Weights:
    """`name` -> `prefix.name`."""
    return {f"{prefix}.{name}": value for name, value in weights.items()}


def under(prefix: str, weights: Weights) -> Weights:
    """The inverse of `prefixed` on a merged dictionary."""
    start = prefix + "."
    return {name.removeprefix(start): value for name, value in weights.items() if name.startswith(start)}


def optimiser_state(optimiser: torch.optim.Optimizer) -> dict[str, np.ndarray]:
    """Adam's moments and step counts by parameter number."""
    state = optimiser.state_dict()["state"]
    return {f"{index}.{name}": value.cpu().numpy().copy() for index, slots in state.items() for name, value in slots.items()}


def load_optimiser_state(optimiser: torch.optim.Optimizer, saved: dict[str, np.ndarray]) -> None:
    """Take over `optimiser_state` of an optimiser over the same parameters."""
    state: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in saved.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = torch.from_numpy(np.array(value))
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
