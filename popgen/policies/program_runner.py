"""Runs a policy's program in one seat, bit for bit as the browser does (`popgen/study/assets/ego_network.js`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from popgen.policies import portable_kernels as k
from popgen.policies.portable_program import Program

ACTIVATIONS = ("tanh", "leaky_relu", "silu")


class ProgramRunner:
    """One episode in one seat after another.

    Actions are drawn by inverting the distribution at uniform numbers of numpy's SFC64, a generator of a few lines.

    Args:
        program: see `portable_program`.
        num_actions: A.

    Attributes:
        view: name of the view that programs read.
        probabilities: (A,) of the last step.

    Raises:
        ValueError: an operation that is not known.
    """

    view = "features"

    def __init__(self, program: Program, num_actions: int) -> None:
        self.probabilities = np.zeros(num_actions)
        self._vectors: dict[str, np.ndarray] = {"seat": np.zeros(2), "joint": np.zeros(2 * num_actions)}
        self._vectors |= {name: np.zeros(num_actions) for name in ("own", "other")}
        self._memories = {name: np.zeros(size) for name, size in program.memories.items()}
        self._vectors |= self._memories
        self._actions, self._seat, self._action = num_actions, 0, 0
        self._held: dict[str, int] = {}
        self._draws = 0
        self._random = np.random.Generator(np.random.SFC64(0))
        self._program, self._steps = program, list[Callable[[], None]]()

    def begin(self, seat: int, seed: int) -> None:
        """A fresh episode."""
        self._seat, self._random = seat, np.random.Generator(np.random.SFC64(seed))
        self._vectors["seat"][:] = 0.0
        self._vectors["seat"][seat] = 1.0
        for memory in self._memories.values():
            memory[:] = 0.0
        self._held = {}

    def act(self, obs: np.ndarray, previous: np.ndarray, *, first: bool) -> int:
        """The action.

        Args:
            obs: (2, F) `features` of both players.
            previous: (2,) actions of the last step.
            first: there was none.
        """
        self._draws = 0
        self._take_inputs(obs, previous, first)
        if not self._steps:
            self._steps.extend(self._prepare_step(operation) for operation in self._program.operations)
        for step in self._steps:
            step()
        return self._action

    def count_draws(self) -> int:
        """Random numbers that the last step took; the last of them chose the action."""
        return self._draws

    def find_held(self) -> int | None:
        """The entry that is held, None for a program that holds none."""
        return int(self._vectors[next(iter(self._held))].argmax()) if self._held else None

    def _take_inputs(self, obs: np.ndarray, previous: np.ndarray, first: bool) -> None:
        vectors = self._vectors
        if "obs" not in vectors:
            vectors["obs"], vectors["both"] = np.zeros(obs.shape[1]), np.zeros(obs.size)
        vectors["obs"][:] = obs[self._seat]
        vectors["both"][:] = obs.reshape(-1)
        for name in ("own", "other", "joint"):
            vectors[name][:] = 0.0
        if not first:
            vectors["own"][previous[self._seat]] = 1.0
            vectors["other"][previous[1 - self._seat]] = 1.0
            vectors["joint"][[previous[0], self._actions + previous[1]]] = 1.0

    def _prepare_step(self, operation: Mapping[str, Any]) -> Callable[[], None]:
        """A call without arguments, on vectors that stay where they are."""
        kind, tensors = operation["op"], self._program.tensors
        sources = [self._vectors[name] for name in operation["of"]]
        first = sources[0]
        if kind in ("gru", "norm_gru"):
            return self._prepare_gru(kind, sources, self._memories[operation["into"]])
        if kind == "draw":
            return lambda: self._draw_action(first, operation["unimix"], operation["greedy"])
        out = self._make_vector(operation, sources)
        if kind == "linear":
            weight = np.ascontiguousarray(tensors[operation["weight"]].T)
            bias = tensors[operation["bias"]] if "bias" in operation else np.zeros(len(out), np.float32)
            return lambda: k.apply_linear(weight, bias, first, out)
        if kind == "norm":
            scale, shift, eps = tensors[operation["weight"]], tensors[operation["bias"]], float(operation["eps"])
            return lambda: (np.copyto(out, first), k.apply_norm(scale, shift, eps, out))[0]
        if kind in ACTIVATIONS:
            number = ACTIVATIONS.index(kind)
            return lambda: (np.copyto(out, first), k.apply_activation(number, out))[0]
        simple: dict[str, Callable[[], Any]] = {
            "join": lambda: np.concatenate(sources, out=out),
            "add": lambda: np.add(first, sources[1], out=out),
            "times": lambda: np.multiply(first, sources[1], out=out),
            "modes": lambda: k.mark_modes(first, operation["classes"], out),
            "hold": lambda: self._hold_entry(operation, first, out),
        }
        if kind not in simple:
            raise ValueError(f"there is no operation {kind!r}")
        return simple[kind]

    def _make_vector(self, operation: Mapping[str, Any], sources: list[np.ndarray]) -> np.ndarray:
        """The vector that an operation writes."""
        size = len(sources[0])
        if operation["op"] == "join":
            size = sum(len(source) for source in sources)
        elif operation["op"] == "linear":
            size = len(self._program.tensors[operation["weight"]])
        return self._vectors.setdefault(operation["into"], np.zeros(size))

    def _prepare_gru(self, kind: str, sources: list[np.ndarray], memory: np.ndarray) -> Callable[[], None]:
        if kind == "gru":
            return lambda: k.advance_gru(sources[0], sources[1], memory)
        return lambda: k.advance_norm_gru(sources[0], memory)

    def _draw_action(self, logits: np.ndarray, unimix: float, greedy: bool) -> None:
        if greedy:
            self._action = int(logits.argmax())
            return
        k.fill_probabilities(logits, unimix, self.probabilities)
        self._action = k.invert_distribution(self.probabilities, self._draw_uniform())

    def _draw_uniform(self) -> float:
        self._draws += 1
        return self._random.random()

    def _hold_entry(self, operation: Mapping[str, Any], logits: np.ndarray, out: np.ndarray) -> None:
        """Keep the entry for the steps that are left of it, else draw another one and its steps."""
        name, least, most = operation["into"], operation["least"], operation["most"]
        if self._held.get(name, 0) == 0:
            probabilities = np.empty(len(logits))
            k.fill_probabilities(logits, 0.0, probabilities)
            out[:] = 0.0
            out[k.invert_distribution(probabilities, self._draw_uniform())] = 1.0
            self._held[name] = least + int(self._draw_uniform() * (most - least + 1))
        self._held[name] -= 1


def describe_generator(seed: int) -> list[str]:
    """The state of the generator of a seed, four whole numbers below 2 ** 64 as text."""
    state: Any = np.random.SFC64(seed).state
    return [str(int(word)) for word in state["state"]["state"]]
