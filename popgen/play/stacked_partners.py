"""Partners of a batch of environments: those of the same shape act in one stacked call, the others one by one.

Calling eight networks one after the other on a few rows each costs more than an ego's own network. Here the weights of
policies of one kind and configuration are stacked on a new first dimension, and `torch.func.vmap` runs their networks
as batched matrix products.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap

from popgen.nets.blocks import draw_by_gumbel
from popgen.play.policy import Policy, Remembering


@runtime_checkable
class Stackable(Protocol):
    """A policy whose step in one seat is a function of weights, memory and inputs alone."""

    @property
    def memory_size(self) -> int:
        """Numbers that it keeps of each row from step to step, all 0 before the first."""
        ...

    def seat_network(self) -> nn.Module | None:
        """A module that shares the policy's weights, None where the policy cannot act so.

        forward(memory (R, S), obs (R, P, *view.shape), previous_actions (R, P) int64, is_first (R,) bool, seat (R,)
        int64) -> (logits (R, A), the next memory (R, S)); it forgets the memory where `is_first`.
        """
        ...


class StackedGroup:
    """K policies of one kind and configuration, called together.

    Args:
        numbers: of these policies among all partners.
        policies: the same, all `Stackable`.
        rows: N, environments of the batch.
    """

    def __init__(self, numbers: Sequence[int], policies: Sequence[Policy], rows: int) -> None:
        assert isinstance(policies[0], Stackable)
        self.numbers, self.view = list(numbers), policies[0].view
        self.memory = torch.zeros(rows, policies[0].memory_size)
        networks = [policy.seat_network() for policy in policies if isinstance(policy, Stackable)]
        modules = [network for network in networks if network is not None]
        parameters, buffers = stack_module_state(modules)
        self._weights = {name: value.detach() for name, value in parameters.items()}, buffers
        self._call = _make_call(copy.deepcopy(modules[0]).to("meta"))
        self.index = torch.zeros(0, 0, dtype=torch.int64)
        self.filled = np.zeros((0, 0), bool)

    def seat_rows(self, partner: np.ndarray) -> None:
        """Take note of the rows (N,) in which each policy plays; all have as many rows as the one with the most, of
        which some are another policy's and are computed in vain."""
        own = [np.flatnonzero(partner == number) for number in self.numbers]
        most = max(len(rows) for rows in own)
        self.filled = np.array([np.arange(most) < len(rows) for rows in own])
        padded = [np.concatenate([rows, np.zeros(most - len(rows), np.int64)]) for rows in own]
        self.index = torch.from_numpy(np.stack(padded))

    def logits(self, obs: Tensor, previous_actions: Tensor, is_first: Tensor, seat: Tensor) -> Tensor:
        """Action logits (K, R, A) of the rows of `index`; the memory of these rows moves on."""
        index = self.index
        answer, memory = self._call(
            *self._weights, self.memory[index], obs[index], previous_actions[index], is_first[index], seat[index]
        )
        filled = torch.from_numpy(self.filled)
        self.memory[index[filled]] = memory[filled]
        return answer


def _make_call(module: nn.Module) -> Callable[..., Any]:
    def call_one(parameters: dict[str, Tensor], buffers: dict[str, Tensor], *inputs: Tensor) -> Any:
        return functional_call(module, (parameters, buffers), inputs)

    return vmap(call_one)


class PartnerPool:
    """Policies that play one seat each in N environments; who plays where is said at every step.

    Args:
        policies: K distinct policies, with their weights loaded.
        rows: N.
        seed: of all draws.
    """

    def __init__(self, policies: Sequence[Policy], rows: int, seed: int) -> None:
        self.policies, self.rows = list(policies), rows
        self._generator = torch.Generator().manual_seed(seed)
        groups: dict[str, list[int]] = {}
        self._alone: list[int] = []
        for number, policy in enumerate(self.policies):
            if isinstance(policy, Stackable) and policy.seat_network() is not None:
                groups.setdefault(f"{policy.kind} {json.dumps(policy.config(), sort_keys=True)}", []).append(number)
            else:
                self._alone.append(number)
        self.groups = [StackedGroup(own, [self.policies[k] for k in own], rows) for own in groups.values()]
        seeds = np.random.SeedSequence(seed).generate_state(len(self.policies))
        for number in self._alone:
            self.policies[number].reset(rows, int(seeds[number] >> 1))
        self._partner: np.ndarray | None = None

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views that `act` needs."""
        return tuple(sorted({policy.view for policy in self.policies}))

    @torch.no_grad()
    def act(
        self,
        observations: Mapping[str, np.ndarray],
        previous_actions: np.ndarray,
        is_first: np.ndarray,
        partner: np.ndarray,
        seat: np.ndarray,
    ) -> np.ndarray:
        """(N,) uint8 actions of partner[n] in seat[n].

        Args:
            observations: view -> (N, P, *view.shape).
            previous_actions: (N, P) uint8. is_first: (N,) bool.
            partner, seat: (N,) int64; they may change where `is_first`.
        """
        if self._partner is None or (partner != self._partner).any():
            self._partner = partner.copy()
            for group in self.groups:
                group.seat_rows(partner)
        actions = np.zeros(self.rows, np.uint8)
        previous, first = torch.from_numpy(previous_actions.astype(np.int64)), torch.from_numpy(is_first)
        seats = torch.from_numpy(seat)
        for group in self.groups:
            if group.index.shape[1]:
                logits = group.logits(torch.from_numpy(observations[group.view]), previous, first, seats)
                drawn = draw_by_gumbel(logits, self._generator).action.numpy()
                actions[group.index.numpy()[group.filled]] = drawn[group.filled]
        for number in self._alone:
            policy, own = self.policies[number], np.flatnonzero(partner == number)
            chosen = policy.act(observations[policy.view], previous_actions, is_first)
            actions[own] = chosen[own, seat[own]]
        return actions

    def state(self) -> dict[str, Any]:
        """Everything to continue from exactly here, except the weights."""
        memories = {str(number): policy.memory() for number, policy in self._remembering_policies().items()}
        stacked = {str(number): group.memory.numpy().copy() for number, group in enumerate(self.groups)}
        return {"generator": self._generator.get_state().numpy(), "stacked": stacked, "memories": memories}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Continue from `state()` of a pool of the same policies."""
        self._generator.set_state(torch.from_numpy(np.array(state["generator"])))
        for number, group in enumerate(self.groups):
            group.memory = torch.from_numpy(np.array(state["stacked"][str(number)])).view(group.memory.shape)
        for number, policy in self._remembering_policies().items():
            policy.load_memory(state["memories"][str(number)])
        self._partner = None

    def _remembering_policies(self) -> dict[int, Remembering]:
        alone = ((number, self.policies[number]) for number in self._alone)
        return {number: policy for number, policy in alone if isinstance(policy, Remembering)}
