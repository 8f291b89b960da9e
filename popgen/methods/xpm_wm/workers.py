"""What the training loop asks of its workers, wherever they run, and what they answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from popgen.envs.contract import EnvSpec
from popgen.methods.training import Checkpoint, Pending, PolicySnapshot, Sampled, State
from popgen.methods.xpm_wm.config import WorldModelRun
from popgen.methods.xpm_wm.real_play import MemberWeights, Tally
from popgen.methods.xpm_wm.world_model import Starts
from popgen.play.rollout import Match
from popgen.types import Weights


@dataclass(frozen=True)
class ModelUpdate:
    """Of the world model: handles of its weights, of start states from the training windows and of such from the last
    rows of self-play (None if not asked for), mean metrics."""

    weights: Pending[Weights]
    starts: Pending[Starts] | None
    metrics: dict[str, float]
    recent: Pending[Starts] | None = None


@dataclass(frozen=True)
class ModelTask:
    """Updates of the world model.

    Attributes:
        updates: how many.
        starts_per_update: start states from each update's windows.
        chosen: also from windows that were drawn for an event.
        rare: events of which none happened before a start state in its window.
        recent_rows: last rows of self-play from which further start states are taken, evenly; 0 for none.
    """

    updates: int
    starts_per_update: int = 0
    chosen: bool = True
    rare: tuple[int, ...] = ()
    recent_rows: int = 0


@dataclass(frozen=True)
class AgentTask:
    """Updates of the agent in imagination.

    Attributes:
        updates: how many.
        model: the world model to imagine with.
        starts: states to start from.
        self_play_has_begun: real self-play has reached `agent.entropy_after` of the target.
        new_share: share of the starts from this member's own data.
        partner_scores: each partner's return in real cross-play, of those seen.
        tally: of real play, where anything goes by it.
        recent: states of this member's latest self-play; None: those among `starts`.
        multipliers: of each partner's cross-play, where that is a constraint; 1 for those that are not there.
        partners: their actors on the latents of `model`; None: as they are.
        pay_limits: (H,) the most that the last 1, 2, ... H steps of an imagined trajectory may earn; None: anything.
    """

    updates: int
    model: Pending[Weights]
    starts: Pending[Starts]
    self_play_has_begun: bool
    new_share: float = 0.0
    partner_scores: Mapping[int, float] = field(default_factory=dict[int, float])
    tally: Tally | None = None
    recent: Pending[Starts] | None = None
    multipliers: Mapping[int, float] = field(default_factory=dict[int, float])
    partners: Pending[FittedPartners] | None = None
    pay_limits: np.ndarray | None = None


@dataclass(frozen=True)
class FittedPartners:
    """Partners' actors on the present world model's latents, of those that were fitted; figures of the fits."""

    actors: dict[int, Weights]
    figures: dict[str, float]


@dataclass(frozen=True)
class AgentUpdate:
    """Of the agent: what it published, mean metrics."""

    weights: MemberWeights
    metrics: dict[str, float]


class Workers(Protocol):
    """Samplers of real episodes, both buffers, the world model's learner and the agent's."""

    def begin_member(self, member: int, seed: int, archive: dict[int, Weights]) -> None:
        """Line 1: a fresh actor and critics; the world model, beside the archived filters of those before."""

    def restart_agent(self, seed: int) -> None:
        """Fresh actor and critics (line 1) for the same member and world model."""

    def start_episodes(
        self, matches: list[Match], policies: dict[int, PolicySnapshot], seed: int, stagger: bool = False
    ) -> None:
        """All samplers begin fresh episodes of these matches."""

    def collect(self, steps: int) -> list[Sampled]:
        """All samplers play `steps` joint steps (lines 17 and 20)."""
        ...

    def add_to_buffers(self, sampled: Sequence[Sampled], owner: int) -> None:
        """Segments of self-play and random play into B_SP, of cross-play into B_XP (lines 18 and 21)."""

    def samplers(self) -> list[str]:
        """Names of the samplers that have matches."""
        ...

    def start_sampling(self, sampler: str, steps: int, member: int, acting: Pending[Weights]) -> Pending[Sampled]:
        """One sampler plays on, with new weights of one member."""
        ...

    def update_world_model(self, task: ModelTask) -> Pending[ModelUpdate]:
        """Gradient steps on windows from both buffers (lines 6 and 7), with start states from those windows."""
        ...

    def tally(self, member: int) -> Pending[Tally]:
        """What the self-play buffer has taken in so far, with `member` as the present one."""
        ...

    def most_paid(self) -> Pending[np.ndarray]:
        """The most that up to 1, 2, ... steps of the self-play buffer have earned, as many as imagination has."""
        ...

    def cache_starts(self) -> Pending[Starts]:
        """Start states from both buffers through the present world model (lines 8 and 10)."""
        ...

    def fit_partners(self) -> Pending[FittedPartners]:
        """The actors of those before, fitted to the latents of the present world model."""
        ...

    def model_weights(self) -> Pending[Weights]:
        """The present world model."""
        ...

    def report_model(self) -> Pending[dict[str, float]]:
        """How well the world model predicts, on fresh windows."""
        ...

    def update_agent(self, task: AgentTask) -> Pending[AgentUpdate]:
        """Simulate and update in the world model (lines 8 to 15)."""
        ...

    # ---- checkpoints -----------------------------------------------------------------------------------------------

    def state(self) -> State:
        """Learners, samplers' episodes and the buffers' generators; handles."""
        ...

    def buffers_state(self) -> State:
        """Both buffers whole; handles."""
        ...

    def model_state(self) -> Pending[State]:
        """The world model's learner."""
        ...

    def restore(self, checkpoint: Checkpoint) -> None:
        """Buffers and learners as `state` found them; the member must have begun.

        Raises:
            LookupError, TypeError, ValueError: a part is missing or does not fit.
        """

    def restore_samplers(self, states: list[State]) -> None:
        """The running episodes, after `start_episodes` with the same matches."""

    def adopt(self, left: State) -> None:
        """Buffers and world model as a finished member left them."""

    def published_form(self) -> State:
        """Weights of the form that `MemberWeights` has at present: acting, model, critics."""
        ...

    def end(self) -> None:
        """End all workers."""

    def put(self, value: Any) -> Pending[Any]:
        """A handle of a value that is there."""
        ...

    def wait(self, pending: Sequence[Pending[Any]], timeout: float | None = None) -> list[Pending[Any]]:
        """Handles whose results are there: at least one, or after `timeout` seconds perhaps none."""
        ...


class ModelReports:
    """Now and then a report of the world model.

    Args:
        work: makes them.
        every: rounds between two.
        waits: take each in at once; else when it is there, and nothing waits for it.
    """

    def __init__(self, work: Workers, every: int, *, waits: bool) -> None:
        self.work, self.every, self.timeout = work, every, None if waits else 0.0
        self.pending: Pending[dict[str, float]] | None = None

    def after_round(self, number: int) -> dict[str, float]:
        """Figures of a report that has come in (`report/NAME`); starts one where it is time."""
        if self.pending is None and number % self.every == 0:
            self.pending = self.work.report_model()
        if self.pending is None or not self.work.wait([self.pending], self.timeout):
            return {}
        report, self.pending = self.pending.result(), None
        return {f"report/{name}": value for name, value in report.items()}


@dataclass(frozen=True)
class Setup:
    """What one member's training is given.

    Attributes:
        work: the workers.
        config, spec: of the run and its environment.
        member, seed: its number and the seed of everything in it.
        archive: acting weights of the members before it.
    """

    work: Workers
    config: WorldModelRun
    spec: EnvSpec
    member: int
    seed: int
    archive: Mapping[int, Pending[Weights]]
