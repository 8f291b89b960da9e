"""Frozen records that pass between the rooms of popgen, and the dimensions of every docstring.

B batch            T time               P players (2)        E events per player
S state numbers    F features of a view A actions            M members
D deterministic    G latent groups      C classes of a group L length of a replay window
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

Weights = dict[str, np.ndarray]
"""A network's weights by name: what travels between processes and into safetensors."""


class Kind(StrEnum):
    """What an environment step was spent on; each has its own column in the ledger."""

    RANDOM = "random"
    SP = "SP"
    XP = "XP"
    MP = "MP"
    EVALUATION = "evaluation"
    SIMULATED = "simulated"  # steps of an exact simulator used as the dynamics model F


TRAINING_KINDS = (Kind.RANDOM, Kind.SP, Kind.XP, Kind.MP)
"""Real steps that training took. A total of steps, wherever one is given, is of these: neither evaluation nor a
simulator's steps."""

RANDOM_MEMBER = 0
"""Member id of the uniform-random player; trained members count from 1."""

FINAL_SKILL = "final"
"""`extra.skill` of a member whose training went to its end, where others are kept from the way there."""

SKILLS = ("initial", "half", FINAL_SKILL)
"""Of the members of a seed of FCP, in order."""

BIASED_ROLE, CONFEDERATE_ROLE, PARTNER_ROLE = "biased", "confederate", "partner"
"""`extra.role` of the members of pairs: who wants something of its own, who wants no other best response, and who
learned to play beside either."""

POPULATION = 0
"""Who stands for all members in the ledger: the final evaluation is nobody's own."""


@dataclass(frozen=True)
class StepBatch:
    """What one joint step of B environments gave.

    Attributes:
        reward: (B,) float32, the environment's own joint reward, counted once for the team.
        score: (B,) float32, the headline figure: dishes in Overcooked, the reward in rendezvous.
        events: (B, P, E) uint8, which player caused which event.
        terminated: (B,) bool, the task itself ended.
        truncated: (B,) bool, the horizon was reached; bootstrap, do not treat as terminal.
    """

    reward: np.ndarray
    score: np.ndarray
    events: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray

    @property
    def done(self) -> np.ndarray:
        """(B,) bool: the environment must be reset before its next step."""
        return self.terminated | self.truncated


@dataclass(frozen=True)
class Segment:
    """T contiguous steps of B environments played by one pair of members.

    Row t holds the transition s_t, a_t -> s_{t+1}; `next_states[t]` is s_{t+1} even where the
    environment was reset before row t + 1.

    Attributes:
        kind: random, SP, XP, ...
        members: who sat in seat 0 and seat 1 (RANDOM_MEMBER for the random player).
        states, next_states: (T, B, S) in the environment's state dtype.
        actions: (T, B, P) uint8.
        reward, score: (T, B) float32.
        events: (T, B, P, E) uint8, caused by the transition of the row.
        terminated, truncated: (T, B) bool.
        sampler, sequence: who stepped it and its running number, the ledger's key.
    """

    kind: Kind
    members: tuple[int, int]
    states: np.ndarray
    next_states: np.ndarray
    actions: np.ndarray
    reward: np.ndarray
    score: np.ndarray
    events: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    sampler: str
    sequence: int

    @property
    def steps(self) -> int:
        """Environment steps in the segment: T * B."""
        return int(self.reward.size)


@dataclass(frozen=True)
class LedgerEntry:
    """Environment steps of one task; the key (run, member, kind, sampler, sequence) is unique."""

    run: str
    member: int
    kind: Kind
    sampler: str
    sequence: int
    steps: int
    episodes: int
    score: float

    @property
    def key(self) -> tuple[str, int, str, str, int]:
        return (self.run, self.member, str(self.kind), self.sampler, self.sequence)


def check(array: Any, shape: Sequence[int | None], name: str) -> None:
    """Raise ValueError unless `array.shape` equals `shape` (None matches any size)."""
    got = tuple(array.shape)
    if len(got) != len(shape) or any(want is not None and want != have for want, have in zip(shape, got, strict=True)):
        raise ValueError(f"{name}: expected shape {tuple(shape)}, got {got}")


def check_reset(batch: int | None, rows: int) -> None:
    """Raise RuntimeError unless a policy was reset for as many rows as it is to act on (None: never)."""
    if batch != rows:
        before = "nothing yet" if batch is None else f"{batch} rows"
        raise RuntimeError(f"act on {rows} rows, but reset for {before}: call reset(batch={rows}, seed=...) first")
