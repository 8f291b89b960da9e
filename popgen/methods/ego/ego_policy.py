"""Egos as policies: with a memory of their own in each seat, of one level or two."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from popgen.envs.contract import EnvSpec
from popgen.methods.ego.ego_networks import EgoSizes, build_network
from popgen.methods.ego.two_levels import draw_durations
from popgen.nets.blocks import draw_by_gumbel
from popgen.nets.weights import load_weights, weights_of
from popgen.policies.portable_program import Program, ProgramWriter
from popgen.types import Weights, check, check_reset

_GRU_PARTS = ("weight_ih", "bias_ih", "weight_hh", "bias_hh")


class EgoPolicy:
    """A flat ego; actions are drawn as in training.

    Args:
        sizes: of the networks.
        spec: of the environment.
        seed: of the initial weights.
    """

    kind: ClassVar[str] = "ego"

    def __init__(self, sizes: EgoSizes, spec: EnvSpec, seed: int = 0) -> None:
        self.view, self._sizes = sizes.view, sizes
        self.net = build_network(sizes, spec, seed)
        self._players = spec.num_players
        self._generator = torch.Generator()
        self._state = torch.zeros(0, self.net.state_size)

    def reset(self, batch: int, seed: int) -> None:
        """B fresh episodes; see `Policy`."""
        self._generator.manual_seed(seed)
        self._state = torch.zeros(batch * self._players, self.net.state_size)

    @torch.no_grad()
    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """(B, P) uint8 actions; see `Policy`.

        Raises:
            RuntimeError: `reset` was for another batch.
        """
        check(obs, (None, self._players, *self.net.shape), "obs")
        check_reset(len(self._state) // self._players or None, len(obs))
        first = torch.from_numpy(np.repeat(np.asarray(is_first, bool), self._players))
        memory = self._encode_view(obs, previous_actions, first)
        logits = self._action_logits(memory, first)
        drawn = draw_by_gumbel(logits, self._generator).action
        return drawn.numpy().astype(np.uint8).reshape(len(obs), self._players)

    @torch.no_grad()
    def tell_probabilities(
        self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray, skill: int | None
    ) -> np.ndarray:
        """Take in a step as `act` does; of each seat's actions, (B, P, A), under one z where there are two levels."""
        first = torch.from_numpy(np.repeat(np.asarray(is_first, bool), self._players))
        memory = self._encode_view(obs, previous_actions, first)
        chosen = None if skill is None else torch.full((len(memory),), skill)
        return self.net.action_logits(memory, chosen).softmax(-1).numpy().reshape(*obs.shape[:2], -1)

    def _encode_view(self, obs: np.ndarray, previous_actions: np.ndarray, first: Tensor) -> Tensor:
        """Take in a step; what the memory gives, (B * P, U)."""
        seats = torch.arange(self._players).repeat(len(obs))
        own = torch.from_numpy(previous_actions.astype(np.int64))
        extras = self.net.make_extras(seats, own.flatten(), own.flip(1).flatten(), first)
        rows = torch.from_numpy(np.ascontiguousarray(obs)).flatten(0, 1)
        remembered = self.net.remember(self.net.encode(rows, extras).unsqueeze(0), self._state, first.unsqueeze(0))
        self._state = remembered.state
        return remembered.outputs[0]

    def _action_logits(self, memory: Tensor, first: Tensor) -> Tensor:
        return self.net.action_logits(memory)

    def memory(self) -> dict[str, Any]:
        """The running episodes' memory and the generator; see `Remembering`."""
        return {"state": self._state.numpy().copy(), "generator": self._generator.get_state().numpy()}

    def load_memory(self, memory: dict[str, Any]) -> None:
        """Continue from `memory()`."""
        self._state = torch.from_numpy(np.array(memory["state"], np.float32))
        self._generator.set_state(torch.from_numpy(np.array(memory["generator"])))

    def to_program(self) -> Program:
        """See `popgen.policies.portable_program.Portable`."""
        net, writer = self.net, ProgramWriter()
        if not isinstance(net.memory, torch.nn.GRU):
            raise ValueError(f"its network {self._sizes.network!r} has no program, only features_gru has")
        state = writer.add_memory("state", net.state_size)
        leak = torch.nn.LeakyReLU()
        rows = writer.add_operation("join", ("obs", "seat", "own", "other"))
        encoded = writer.add_layers((net.first, leak, net.second, leak), rows)
        weights = {name: net.memory.get_parameter(f"{name}_l0") for name in _GRU_PARTS}
        gates = (
            writer.add_linear(encoded, weights["weight_ih"], weights["bias_ih"]),
            writer.add_linear(state, weights["weight_hh"], weights["bias_hh"]),
        )
        writer.add_operation("gru", gates, into=state)
        hidden = self._write_hidden(writer, state)
        return writer.finish(writer.add_layers((leak, net.action), hidden))

    def _write_hidden(self, writer: ProgramWriter, state: str) -> str:
        """The actor's hidden layer before its activation."""
        return writer.add_linear(state, self.net.hidden.weight, self.net.hidden.bias + self.net.skill_bias[0])

    def config(self) -> dict[str, Any]:
        """The networks' sizes."""
        return self._sizes.as_dict()

    def weights(self) -> Weights:
        """The network's parameters."""
        return weights_of(self.net)

    def load(self, weights: Mapping[str, np.ndarray]) -> None:
        """Load `weights()` of a policy of the same sizes; raises ValueError for others."""
        load_weights(self.net, weights)

    @classmethod
    def from_parts(cls, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec) -> Self:
        """See `Policy.from_parts`."""
        policy = cls(EgoSizes(**config), spec)
        policy.load(weights)
        return policy


class HierarchicalEgoPolicy(EgoPolicy):
    """HiPT's ego: a z is drawn at an episode's beginning and whenever its steps are over, and kept in between.

    Args:
        sizes, spec, seed: as `EgoPolicy`; with skills.
        duration_least, duration_most: steps of a z, both included.
    """

    kind: ClassVar[str] = "hierarchical_ego"

    def __init__(
        self, sizes: EgoSizes, spec: EnvSpec, seed: int = 0, *, duration_least: int, duration_most: int
    ) -> None:
        if sizes.skills < 2 or not 1 <= duration_least <= duration_most:
            raise ValueError("an ego of two levels needs two skills and a range of durations from 1 on")
        super().__init__(sizes, spec, seed)
        self._least, self._most = int(duration_least), int(duration_most)
        self._skill = torch.zeros(0, dtype=torch.int64)
        self._left = torch.zeros(0, dtype=torch.int64)

    def reset(self, batch: int, seed: int) -> None:
        """See `Policy`."""
        super().reset(batch, seed)
        self._skill = torch.zeros(batch * self._players, dtype=torch.int64)
        self._left = torch.zeros_like(self._skill)

    def _action_logits(self, memory: Tensor, first: Tensor) -> Tensor:
        """Under each row's z, after a new choice where it is over."""
        decides = first | (self._left == 0)
        chosen = draw_by_gumbel(self.net.skill_logits(memory), self._generator).action
        durations = draw_durations(len(memory), self._least, self._most, self._generator)
        self._skill = torch.where(decides, chosen, self._skill)
        self._left = torch.where(decides, durations, self._left) - 1
        return self.net.action_logits(memory, self._skill)

    def memory(self) -> dict[str, Any]:
        """See `Remembering`."""
        return {**super().memory(), "skill": self._skill.numpy().copy(), "left": self._left.numpy().copy()}

    def load_memory(self, memory: dict[str, Any]) -> None:
        """Continue from `memory()`."""
        super().load_memory(memory)
        self._skill = torch.from_numpy(np.array(memory["skill"], np.int64))
        self._left = torch.from_numpy(np.array(memory["left"], np.int64))

    def _write_hidden(self, writer: ProgramWriter, state: str) -> str:
        assert self.net.skill is not None
        chosen = writer.add_layers([self.net.skill], state)
        skill = writer.add_operation("hold", chosen, least=self._least, most=self._most)
        parts = (writer.add_layers([self.net.hidden], state), writer.add_linear(skill, self.net.skill_bias.T))
        return writer.add_operation("add", parts)

    def config(self) -> dict[str, Any]:
        """The networks' sizes and the durations."""
        return {**super().config(), "duration_least": self._least, "duration_most": self._most}

    @classmethod
    def from_parts(cls, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec) -> Self:
        """See `Policy.from_parts`."""
        durations = {name: int(config[name]) for name in ("duration_least", "duration_most")}
        sizes = EgoSizes(**{name: value for name, value in config.items() if name not in durations})
        policy = cls(sizes, spec, **durations)
        policy.load(weights)
        return policy
