"""Between torch modules and plain named arrays, with strict checks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import nn


def module_weights(module: nn.Module, prefix: str = "") -> dict[str, np.ndarray]:
    """Copies of the module's parameters and buffers by name, each name preceded by `prefix`."""
    return {prefix + name: tensor.detach().cpu().numpy().copy() for name, tensor in module.state_dict().items()}


def load_weights(module: nn.Module, weights: Mapping[str, np.ndarray], prefix: str = "") -> None:
    """Copy the arrays whose names begin with `prefix` into the module.

    Raises:
        ValueError: a tensor is missing, unknown or of another shape or dtype; the message names it.
    """
    given = {name.removeprefix(prefix): array for name, array in weights.items() if name.startswith(prefix)}
    own = module.state_dict()
    for name in own.keys() - given.keys():
        raise ValueError(f"tensor {prefix + name!r} is missing")
    for name in given.keys() - own.keys():
        raise ValueError(f"tensor {prefix + name!r} is not one of the policy's")
    for name, tensor in own.items():
        array = np.ascontiguousarray(given[name])
        if array.shape != tuple(tensor.shape):
            raise ValueError(f"tensor {prefix + name!r} has shape {array.shape}, expected {tuple(tensor.shape)}")
        loaded = torch.from_numpy(array.copy())
        if loaded.dtype != tensor.dtype:
            raise ValueError(f"tensor {prefix + name!r} is {loaded.dtype}, expected {tensor.dtype}")
        tensor.copy_(loaded)
