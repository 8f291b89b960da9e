"""Networks' weights and optimisers: as plain numpy dictionaries and back, and the bound on a step's gradient."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, cast

import numpy as np
import torch
from torch import nn

from popgen.types import Weights

_MOMENTS = ("exp_avg", "exp_avg_sq")  # Adam's, in its own words


def weights_of(module: nn.Module) -> Weights:
    """Copies of all parameters and persistent buffers."""
    return {name: value.detach().cpu().numpy().copy() for name, value in module.state_dict().items()}


def load_weights(module: nn.Module, weights: Mapping[str, np.ndarray], *, cast: bool = False) -> None:
    """Copy named arrays into a module; `cast` allows a module in another precision than the arrays'.

    Raises:
        ValueError: a tensor is missing, unknown or of another shape or dtype; the message names it.
    """
    own = module.state_dict()
    if missing := sorted(own.keys() - weights.keys()):
        raise ValueError(f"tensor {missing[0]!r} is missing")
    if unknown := sorted(weights.keys() - own.keys()):
        raise ValueError(f"tensor {unknown[0]!r} is not one of the policy's")
    loaded = {name: torch.as_tensor(np.array(weights[name])) for name in own}
    for name, tensor in own.items():
        if loaded[name].shape != tensor.shape:
            raise ValueError(f"tensor {name!r} has shape {tuple(loaded[name].shape)}, expected {tuple(tensor.shape)}")
        if loaded[name].dtype != tensor.dtype and not cast:
            raise ValueError(f"tensor {name!r} is {loaded[name].dtype}, expected {tensor.dtype}")
    for name, tensor in own.items():
        tensor.copy_(loaded[name])


def prefixed(prefix: str, weights: Weights) -> Weights:
    """`name` -> `prefix.name`."""
    return {f"{prefix}.{name}": value for name, value in weights.items()}


def under(prefix: str, weights: Weights) -> Weights:
    """The inverse of `prefixed` on a merged dictionary."""
    start = prefix + "."
    return {name.removeprefix(start): value for name, value in weights.items() if name.startswith(start)}


def clip_gradients(parameters: Iterable[nn.Parameter], most: float) -> torch.Tensor:
    """Scale the gradients down to the norm `most` where theirs is larger (0: never); the norm that they had."""
    return nn.utils.clip_grad_norm_(parameters, most or math.inf)


def optimiser_state(optimiser: torch.optim.Optimizer) -> dict[str, np.ndarray]:
    """Adam's moments and step counts by parameter number."""
    state = optimiser.state_dict()["state"]
    return {
        f"{index}.{name}": value.cpu().numpy().copy() for index, slots in state.items() for name, value in slots.items()
    }


def load_optimiser_state(optimiser: torch.optim.Optimizer, saved: dict[str, np.ndarray]) -> None:
    """Replace the contents with `optimiser_state` of an optimiser over the same parameters.

    Raises:
        ValueError: a parameter's moments or step count are missing, of another shape, of no parameter, or below 0.
    """
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in saved.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = torch.as_tensor(np.array(value))
    for index, slots in state.items():
        shape = parameters[index].shape if 0 <= index < len(parameters) else None
        wanted = {**dict.fromkeys(_MOMENTS, shape), "step": torch.Size()}
        if {name: slot.shape for name, slot in slots.items()} != wanted or slots["step"] < 0:
            raise ValueError(f"an optimiser's moments of parameter {index} do not fit it")
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


def same_form(value: Any, like: Any, name: str = "a part") -> None:
    """Weights from a checkpoint against those that they are to replace: names, shapes and types.

    Raises:
        ValueError: they differ.
    """
    if isinstance(like, dict):
        if not isinstance(value, dict) or value.keys() != like.keys():
            raise ValueError(f"{name} has other tensors")
        for key, item in cast("dict[str, Any]", like).items():
            same_form(value[key], item, key)
        return
    array = cast("np.ndarray", value)
    if not isinstance(value, np.ndarray) or (array.shape, array.dtype) != (like.shape, like.dtype):
        raise ValueError(f"{name} is of another shape or type")
