"""What the recorder tells its sinks. A sink overrides what it wants to know; each can be left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from popgen.types import LedgerEntry


@dataclass(frozen=True)
class MetricPoint:
    """Figures of a member after so many of its environment steps; `free_bytes` of the disk, where it was looked at."""

    member: int
    step: int
    figures: Mapping[str, float]
    free_bytes: int | None = None


@dataclass(frozen=True)
class CheckpointWritten:
    """A checkpoint is whole on disk, after `iteration` iterations and `steps` environment steps of `member`."""

    member: int
    iteration: int
    steps: int


@dataclass(frozen=True)
class MemberAdded:
    """The population has one more member.

    Attributes:
        steps: environment steps of its training.
        total_steps: of all members so far.
        following: the member that is trained next, None after the last one.
        kinds: of all members so far by kind, simulated ones among them.
    """

    member: int
    steps: int
    total_steps: int
    following: int | None
    kinds: Mapping[str, int] = field(default_factory=dict)


class Sink:
    """Ignores everything."""

    def on_entries(self, entries: Sequence[LedgerEntry]) -> None:
        """Environment steps were taken."""

    def on_metrics(self, point: MetricPoint) -> None:
        """A point of metrics."""

    def on_checkpoint(self, checkpoint: CheckpointWritten) -> None:
        """A checkpoint was written."""

    def on_member(self, added: MemberAdded) -> None:
        """A member was added to the population."""

    def on_end(self, status: str) -> None:
        """The run ends with an MLflow status: FINISHED, FAILED or KILLED."""
