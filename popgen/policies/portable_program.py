"""Policies as programs: a few operations on named vectors, which other languages can run too.

A program is one step of a policy in one seat, on Overcooked's `features`. It finds these vectors:

    obs          (F,)     the seat's own view
    both         (2 F,)   both players' views, player 1's first
    seat         (2,)     one-hot
    own, other   (A,)     one-hot previous actions of the seat and of the other player; zeros at the first step
    joint        (2 A,)   the same, player 1's first

and memory vectors, zeros at the first step. Operations read vectors (`of`) and write one (`into`):

    join         of several, one after the other
    linear       `bias` + `of` times `weight` (O, I)
    norm         layer norm with `weight`, `bias`, `eps`
    tanh, leaky_relu, silu
    add, times   of two, entry by entry
    gru          PyTorch's, from the gates of input and memory; writes a memory
    norm_gru     `popgen.nets.blocks.NormGRUCell` from its normalised gates; writes a memory
    modes        one-hot of each group's likeliest of `classes`; class-major
    hold         one-hot of an entry drawn from logits and kept for a drawn number of steps (`least` to `most`)
    draw         the action, from logits mixed with a share `unimix` of uniform; the likeliest one if `greedy`

A file holds the program beside its tensors (safetensors, the program as JSON in the metadata).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import safetensors.numpy
import torch
from torch import nn

from popgen.types import Weights

ACTIVATION_NAMES: Mapping[type[nn.Module], str] = {nn.Tanh: "tanh", nn.LeakyReLU: "leaky_relu", nn.SiLU: "silu"}


@dataclass(frozen=True)
class Program:
    """A policy's step; see the module's docstring.

    Attributes:
        operations: in order; JSON-able.
        memories: name -> size.
        tensors: name -> float32 array.
    """

    operations: tuple[Mapping[str, Any], ...]
    memories: Mapping[str, int]
    tensors: Mapping[str, np.ndarray]

    def to_bytes(self) -> bytes:
        """A safetensors file."""
        told = {"operations": list(self.operations), "memories": dict(self.memories)}
        tensors = {name: np.ascontiguousarray(tensor, np.float32) for name, tensor in self.tensors.items()}
        return safetensors.numpy.save(tensors, {"program": json.dumps(told, sort_keys=True)})


@runtime_checkable
class Portable(Protocol):
    """A policy that can be written as a program."""

    def to_program(self) -> Program:
        """The program.

        Raises:
            ValueError: this one cannot; says why.
        """
        ...


def write_program(policy: object) -> Program:
    """The program of a policy.

    Raises:
        ValueError: it has none; says why.
    """
    if not isinstance(policy, Portable):
        raise ValueError(f"policies of the kind {getattr(policy, 'kind', type(policy).__name__)!r} have no program")
    return policy.to_program()


class ProgramWriter:
    """Writes a program operation by operation; each gives the name of the vector that it writes."""

    def __init__(self) -> None:
        self._operations: list[dict[str, Any]] = []
        self._memories: dict[str, int] = {}
        self._tensors: Weights = {}

    def add_memory(self, name: str, size: int) -> str:
        """A vector that is kept from step to step."""
        self._memories[name] = size
        return name

    def add_operation(self, kind: str, of: str | Sequence[str], into: str | None = None, **given: Any) -> str:
        """Any operation."""
        into = into or f"v{len(self._operations)}"
        operation = {"op": kind, "of": [of] if isinstance(of, str) else list(of), "into": into, **given}
        self._operations.append(operation)
        return into

    def add_linear(self, of: str, weight: torch.Tensor | nn.Parameter, bias: torch.Tensor | None = None) -> str:
        """A product with a matrix (O, I)."""
        given = {"weight": self._add_tensor(weight)}
        if bias is not None:
            given["bias"] = self._add_tensor(bias)
        return self.add_operation("linear", of, **given)

    def add_layers(self, layers: Iterable[nn.Module], of: str) -> str:
        """Layers one after the other.

        Raises:
            ValueError: one of them is no operation, such as a convolution.
        """
        for layer in layers:
            if isinstance(layer, nn.Linear):
                of = self.add_linear(of, layer.weight, layer.bias)
            elif isinstance(layer, nn.LayerNorm):
                tensors = {"weight": self._add_tensor(layer.weight), "bias": self._add_tensor(layer.bias)}
                of = self.add_operation("norm", of, **tensors, eps=layer.eps)
            elif type(layer) in ACTIVATION_NAMES:
                of = self.add_operation(ACTIVATION_NAMES[type(layer)], of)
            else:
                raise ValueError(f"its {type(layer).__name__} layers are no operations of programs")
        return of

    def finish(self, logits: str, *, unimix: float = 0.0, greedy: bool = False) -> Program:
        """End with the draw of an action."""
        self.add_operation("draw", logits, into="action", unimix=unimix, greedy=greedy)
        return Program(tuple(self._operations), self._memories, self._tensors)

    def _add_tensor(self, tensor: torch.Tensor) -> str:
        name = f"t{len(self._tensors)}"
        self._tensors[name] = tensor.detach().cpu().numpy().astype(np.float32)
        return name


def write_constant(logits: Sequence[float]) -> Program:
    """The program that always draws from the same logits."""
    writer = ProgramWriter()
    column = torch.tensor(logits, dtype=torch.float32)
    return writer.finish(writer.add_linear("seat", torch.zeros(len(column), 2), column))


def read_program(data: bytes) -> Program:
    """The program of a safetensors file of `Program.to_bytes`.

    Raises:
        ValueError: it is none.
    """
    try:
        tensors = safetensors.numpy.load(data)
        length = int.from_bytes(data[:8], "little")
        told = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["program"])
        return Program(tuple(told["operations"]), told["memories"], tensors)
    except (safetensors.SafetensorError, KeyError, TypeError) as error:
        raise ValueError(f"this is no program: {error}") from None
