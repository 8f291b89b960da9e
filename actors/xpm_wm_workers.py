"""XPM-WM's workers over a transport: samplers, both buffers, the world model's learner and the agent's.

The actors are thin: every number is made by what they hold.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from popgen.actors.actor_setup import build_env, device_of, limit_threads
from popgen.actors.samplers import start_samplers
from popgen.envs.contract import EnvSpec
from popgen.methods.training import (
    Checkpoint,
    Pending,
    Place,
    PolicySnapshot,
    Sampled,
    Segments,
    State,
    Transport,
    UpdateFigures,
    Worker,
)
from popgen.methods.xpm_wm.actor_critic import Actor
from popgen.methods.xpm_wm.agent import AgentLearner
from popgen.methods.xpm_wm.config import FcpWmRun, WorldModelRun
from popgen.methods.xpm_wm.imagination import OLD
from popgen.methods.xpm_wm.member_training import XpmWmTraining
from popgen.methods.xpm_wm.model_report import OPEN_LOOP, model_report
from popgen.methods.xpm_wm.real_play import MemberWeights, Tally
from popgen.methods.xpm_wm.replay import (
    Draws,
    Query,
    ReplayActor,
    Request,
    Windows,
    exchange_players,
    join,
    model_batch,
    start_batch,
)
from popgen.methods.xpm_wm.skilled_training import FcpWmTraining
from popgen.methods.xpm_wm.workers import AgentTask, AgentUpdate, FittedPartners, ModelTask, ModelUpdate
from popgen.methods.xpm_wm.world_model import ModelLearner, Starts, fit_partners
from popgen.nets.weights import load_weights, prefixed, under, weights_of
from popgen.play.rollout import Match
from popgen.types import Kind, Weights

BUFFERS = ("replay_sp", "replay_xp")
CHUNK = 25
"""Updates whose batches are drawn in one call."""
EXCHANGED = ("event_recall_step1", "exact_step1")
"""Figures that are reported of windows with exchanged players too."""
FIT_WINDOWS = 256
"""Windows of kept data to which partners are fitted, beside as many of the member's own."""


class WorldModelActor:
    """Thin: every number is made by `ModelLearner`."""

    def __init__(
        self,
        config: WorldModelRun,
        seed: int,
        threads: int,
        replays: tuple[Worker[ReplayActor], Worker[ReplayActor]],
        transport: Transport,
    ) -> None:
        limit_threads(threads)
        self.config, self.replays, self.transport = config, replays, transport
        self.spec = build_env(config.env, 1).spec
        self.learner = ModelLearner(config.world_model, self.spec, seed, device_of(config.cluster.model_gpus))
        self.member = 1
        self.partners: dict[int, Weights] = {}
        self.biased = False

    def begin_member(self, member: int, archive: dict[int, Weights]) -> None:
        """Fine-tune for a later member beside the archived filters of those before (acting weights by member)."""
        self.member = member
        if member > 1:
            self.learner.set_learning_rate(self.config.phase2.model_lr)
        for predecessor in sorted(set(archive) - set(self.learner.predecessors)):
            self.learner.add_predecessor(predecessor, under("filter", archive[predecessor]))
        self.partners = {one: under("actor", weights) for one, weights in archive.items()}

    def _draw_windows(self, draws: Draws, length: int, repeats: int) -> list[list[Windows | None]]:
        view = self.config.world_model.view
        pending = [
            replay.ask(ReplayActor.draw, requests, length, view, repeats)
            for replay, requests in zip(self.replays, (draws.sp, draws.xp), strict=True)
        ]
        sp, xp = (one.result() for one in pending)
        return [a + b for a, b in zip(sp, xp, strict=True)]

    def train(self, task: ModelTask) -> ModelUpdate:
        """Gradient steps; weights, start states from the training windows and mean metrics. Weights and states stay in
        the store."""
        config, learner, updates = self.config.world_model, self.learner, task.updates
        figures = UpdateFigures()
        starts: list[Starts] = []
        for first in range(0, updates, CHUNK):
            chunk = self._draw_windows(
                model_batch(self.config, self.member), config.length, min(CHUNK, updates - first)
            )
            for parts in chunk:
                windows = join([part for part in parts if part is not None])
                if not self.biased:
                    learner.set_biases(windows)
                    self.biased = True
                metrics, seen = learner.update(windows)
                figures.add(metrics)
                if count := task.starts_per_update:
                    starts.append(learner.starts(seen, windows, count, pool=OLD, chosen=task.chosen, rare=task.rare))
        recent = self._recent_starts(task.recent_rows)
        means = figures.means() | figures.times(updates)
        stored = self.transport.put(Starts.concat(starts)) if starts else None
        return ModelUpdate(self.weights(), stored, means, recent)

    def _recent_starts(self, rows: int) -> Pending[Starts] | None:
        """Start states of the last so many rows of this member's self-play, none of them chosen; None where there are
        none."""
        if not rows:
            return None
        length, count = self.config.world_model.length, self.config.discovery.trust_starts
        per_window = max(1, length // 2)
        query = Query(owner=self.member, kind=Kind.SP, last=rows)
        part = self._draw_windows(Draws(sp=(Request(query, -(-count // per_window)),)), length, 1)[0][0]
        if part is None:
            return None
        seen = self.learner.posteriors(part)
        return self.transport.put(self.learner.starts(seen, part, count, pool=OLD, skip=length - per_window))

    def cache_starts(self) -> Starts:
        """A later member's start states, seen through the present world model."""
        length = self.config.world_model.length
        per_window = max(1, length // 2)
        draws = start_batch(self.config, self.spec, self.member, self.config.phase2.cache // per_window)
        parts = self._draw_windows(draws, length, 1)[0]
        starts = []
        for request, part in zip((*draws.sp, *draws.xp), parts, strict=True):
            if part is not None:
                seen = self.learner.posteriors(part)
                count = per_window * len(part.partner)
                starts.append(self.learner.starts(seen, part, count, pool=request.pool, skip=length - per_window))
        return Starts.concat(starts)

    def fit_partners(self) -> FittedPartners:
        """The actors of those before on the present model's latents of the states that imagination starts from."""
        config, steps = self.config, self.config.phase2.partner_fits
        if not steps or not self.partners:
            return FittedPartners({}, {})
        draws = start_batch(config, self.spec, self.member, FIT_WINDOWS)
        parts = self._draw_windows(draws, config.world_model.length, 1)[0]
        windows = join([part for part in parts if part is not None])
        actors: dict[int, Actor] = {}
        for member, weights in sorted(self.partners.items()):
            actors[member] = Actor(config.agent, config.world_model, self.spec.num_actions)
            load_weights(actors[member], weights)
        before, after = np.mean(fit_partners(self.learner, actors, windows, steps), axis=0)
        figures = {"partner_drift": float(before), "partner_drift_left": float(after)}
        return FittedPartners({member: weights_of(actor) for member, actor in actors.items()}, figures)

    def report(self) -> dict[str, float]:
        """Event precision and recall at one step and open loop, exact observations: on fresh windows; and some of it on
        the same with the players exchanged (`exchanged/NAME`), of which the model may know nothing."""
        length = self.config.world_model.length
        parts = self._draw_windows(model_batch(self.config, self.member), length + OPEN_LOOP, 4)
        windows = join([part for update in parts for part in update if part is not None])
        figures, generator = model_report(self.learner, windows, context=length), self.learner.generator
        before = generator.get_state()
        other = model_report(self.learner, exchange_players(windows), context=length)
        generator.set_state(before)  # what is only looked at changes no training
        return figures | {f"exchanged/{name}": other[name] for name in EXCHANGED if name in other}

    def weights(self) -> Pending[Weights]:
        """The whole world model, in the store."""
        return self.transport.put(weights_of(self.learner.model))

    def state(self) -> dict[str, Any]:
        """Collect the learner's state."""
        return {"learner": self.learner.state(), "biased": self.biased}

    def load_state(self, state: Pending[dict[str, Any]]) -> None:
        """Continue from `state()`."""
        contents = state.result()
        self.learner.load_state(contents["learner"])
        self.biased = bool(contents["biased"])


class AgentActor:
    """Thin: every number is made by `AgentLearner`."""

    def __init__(self, config: WorldModelRun, threads: int, transport: Transport) -> None:
        limit_threads(threads)
        self.config, self.transport = config, transport
        self.spec = build_env(config.env, 1).spec
        self.learner = self._fresh_learner(1, 0)

    def _fresh_learner(self, member: int, seed: int) -> AgentLearner:
        config, device = self.config, device_of(self.config.cluster.agent_gpus)
        agent = config.agent_of(member)
        return AgentLearner(agent, config.world_model, self.spec, member, seed, device, config.discovery)

    def begin_member(self, member: int, seed: int, partners: dict[int, Weights]) -> None:
        """A fresh actor and critics beside frozen predecessors (acting weights by member)."""
        self.learner = self._fresh_learner(member, seed)
        for partner, weights in partners.items():
            self.learner.add_partner(partner, under("actor", weights))

    def restart(self, seed: int) -> None:
        """Fresh actor and critics on the same world model."""
        self.learner.restart(seed)

    def train(self, task: AgentTask) -> AgentUpdate:
        """Imagine and update; what comes of it stays in the store."""
        figures = UpdateFigures()
        model, fitted = task.model.result(), task.partners.result() if task.partners is not None else None
        self.learner.set_model(model, None if fitted is None else fitted.actors)
        self.learner.set_starts(task.starts.result(), task.new_share)
        self.learner.partner_scores = dict(task.partner_scores)
        self.learner.self_play_has_begun = task.self_play_has_begun
        self.learner.constraint.multipliers = dict(task.multipliers)
        self.learner.pay_limits.most = task.pay_limits
        rates: dict[str, float] = {} if fitted is None else dict(fitted.figures)
        if task.tally is not None:
            recent = None if task.recent is None else task.recent.result()
            rates |= self.learner.compare_with_real_play(task.tally, recent)
        for _ in range(task.updates):
            figures.add(self.learner.update() | self.learner.pay_limits.figures())
        means = figures.means() | rates | figures.times(task.updates)
        acting, critics = self.acting_weights(model), weights_of(self.learner.critics)
        return AgentUpdate(MemberWeights(self.transport.put(acting), self.transport.put(critics), task.model), means)

    def acting_weights(self, model: Weights) -> Weights:
        """Policy weights: the filter of `model` and this member's actor."""
        return prefixed("filter", under("filter", model)) | prefixed("actor", self.learner.actor_weights())

    def state(self) -> dict[str, Any]:
        """Collect the learner's state: all but world model and start states, which come with every task."""
        return self.learner.state()

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`, after `begin_member` with the same partners."""
        self.learner.load_state(state)


def wait_for_all(pending: Iterable[Pending[Any]]) -> None:
    """All results are there."""
    for one in list(pending):
        one.result()


@dataclass(frozen=True)
class DelayedWeights:
    """A handle of a handle: what a worker put into the store, before it has said so."""

    answer: Pending[Pending[Weights]]

    def result(self) -> Weights:
        """Wait for both."""
        return self.answer.result().result()


class XpmWmWorkers:
    """See `popgen.methods.xpm_wm.workers.Workers`."""

    def __init__(self, config: WorldModelRun, attempt: str, transport: Transport) -> None:
        self.config, self.transport, self.attempt = config, transport, attempt
        cluster, seed, start = config.cluster, config.run.seed * 1000, transport.start
        self.pool = start_samplers(config, attempt, transport)
        place, capacity = Place(cluster.replay_cpus), config.replay.capacity
        counted = config.world_model.view if config.discovery.count_bonus else ""
        self.replays: dict[str, Worker[ReplayActor]] = {
            name: start(ReplayActor, place, config.env, capacity, seed + number, counted)
            for name, number in zip(BUFFERS, (11, 12), strict=True)
        }
        self.model: Worker[WorldModelActor] = start(
            WorldModelActor,
            Place(cluster.model_cpus, cluster.model_gpus),
            config,
            seed + 21,
            cluster.threads,
            (self.replays["replay_sp"], self.replays["replay_xp"]),
            transport,
        )
        place = Place(cluster.agent_cpus, cluster.agent_gpus)
        self.agent: Worker[AgentActor] = start(AgentActor, place, config, cluster.threads, transport)

    def put(self, value: Any) -> Pending[Any]:
        """Put a value into the transport's store."""
        return self.transport.put(value)

    def wait(self, pending: Sequence[Pending[Any]], timeout: float | None = None) -> list[Pending[Any]]:
        """Wait for handles; see `Transport.wait`."""
        return self.transport.wait(pending, timeout)

    def begin_member(self, member: int, seed: int, archive: dict[int, Weights]) -> None:
        """Have both learners begin with a member (line 1) and wait until they have."""
        self.agent.ask(AgentActor.begin_member, member, seed, archive).result()
        self.model.ask(WorldModelActor.begin_member, member, archive).result()

    def restart_agent(self, seed: int) -> None:
        """Have the agent's learner begin anew and wait until it has."""
        self.agent.ask(AgentActor.restart, seed).result()

    # ---- real episodes ---------------------------------------------------------------------------------------------

    def start_episodes(
        self, matches: list[Match], policies: dict[int, PolicySnapshot], seed: int, stagger: bool = False
    ) -> None:
        """Start fresh episodes on all samplers."""
        self.pool.open(matches, policies, seed, stagger)

    def collect(self, steps: int) -> list[Sampled]:
        """Let all samplers play at the same time."""
        return self.pool.collect(steps)

    def samplers(self) -> list[str]:
        """Name those with matches: sampler0, sampler1, ..."""
        return [f"sampler{index}" for index in self.pool.active]

    def start_sampling(self, sampler: str, steps: int, member: int, acting: Pending[Weights]) -> Pending[Sampled]:
        """Let one sampler play on, with new weights of one member."""
        return self.pool.start(int(sampler.removeprefix("sampler")), steps, member, acting)

    def add_to_buffers(self, sampled: Sequence[Sampled], owner: int) -> None:
        """Send each segment to the one buffer that wants it; it has arrived when this returns."""
        wait_for_all(added for one in sampled for added in self._send(one.segments, owner))

    def _send(self, segments: Segments, owner: int) -> list[Pending[int]]:
        return [
            self.replays["replay_xp" if kind == Kind.XP else "replay_sp"].ask(ReplayActor.ingest, part, owner)
            for kind, part in segments.items()
        ]

    # ---- learning --------------------------------------------------------------------------------------------------

    def update_world_model(self, task: ModelTask) -> Pending[ModelUpdate]:
        """Ask the world-model learner for updates."""
        return self.model.ask(WorldModelActor.train, task)

    def tally(self, member: int) -> Pending[Tally]:
        """Ask B_SP what it has taken in."""
        return self.replays["replay_sp"].ask(ReplayActor.tally, member)

    def most_paid(self) -> Pending[np.ndarray]:
        """Ask B_SP for the most that its steps on end have earned."""
        return self.replays["replay_sp"].ask(ReplayActor.most_paid, self.config.discovery, self.config.agent.horizon)

    def cache_starts(self) -> Pending[Starts]:
        """Ask the world-model learner for start states."""
        return self.model.ask(WorldModelActor.cache_starts)

    def fit_partners(self) -> Pending[FittedPartners]:
        """Ask the world-model learner for partners' actors on its latents."""
        return self.model.ask(WorldModelActor.fit_partners)

    def model_weights(self) -> Pending[Weights]:
        """Ask the world-model learner for its weights."""
        return DelayedWeights(self.model.ask(WorldModelActor.weights))

    def report_model(self) -> Pending[dict[str, float]]:
        """Ask the world-model learner for a report on fresh windows."""
        return self.model.ask(WorldModelActor.report)

    def update_agent(self, task: AgentTask) -> Pending[AgentUpdate]:
        """Ask the agent's learner for updates in imagination."""
        return self.agent.ask(AgentActor.train, task)

    # ---- checkpoints -----------------------------------------------------------------------------------------------

    def state(self) -> State:
        """Ask all workers for their state; handles, without the buffers' rows, which are in the log."""
        return {
            "model": self.model_state(),
            "agent": self.agent.ask(AgentActor.state),
            "marks": {name: replay.ask(ReplayActor.marks) for name, replay in self.replays.items()},
            "samplers": self.pool.state(),
        }

    def buffers_state(self) -> State:
        """Ask both buffers for whole copies; handles."""
        return {name: replay.ask(ReplayActor.state) for name, replay in self.replays.items()}

    def model_state(self) -> Pending[State]:
        """Ask the world-model learner for its state."""
        return self.model.ask(WorldModelActor.state)

    def adopt(self, left: State) -> None:
        """Load buffers and world model as a finished member left them."""
        if left:
            self._load_buffers(left)
            self.model.ask(WorldModelActor.load_state, left["model"]).result()

    def _load_buffers(self, states: State) -> None:
        wait_for_all(replay.ask(ReplayActor.load_state, states[name]) for name, replay in self.replays.items())

    def restore(self, checkpoint: Checkpoint) -> None:
        """Load buffers from their last whole copy and the log, then both learners."""
        if checkpoint.buffers is not None:
            self._load_buffers(checkpoint.buffers)
        for segments, owner in checkpoint.log:
            wait_for_all(self._send(segments, owner))
        state = checkpoint.state
        wait_for_all(replay.ask(ReplayActor.load_marks, state["marks"][name]) for name, replay in self.replays.items())
        self.model.ask(WorldModelActor.load_state, self.put(state["model"])).result()
        self.agent.ask(AgentActor.load_state, state["agent"]).result()

    def restore_samplers(self, states: list[State]) -> None:
        """Load the running episodes into the samplers."""
        self.pool.load_state(states)

    def published_form(self) -> State:
        """Ask the restored learners for the weights that they had published."""
        model, agent = self.model_weights().result(), self.agent.ask(AgentActor.state).result()
        acting = self.agent.ask(AgentActor.acting_weights, model).result()
        return {"acting": acting, "model": model, "critics": agent["critics"]}

    def end(self) -> None:
        """End all workers."""
        self.pool.end()
        for worker in (*self.replays.values(), self.model, self.agent):
            worker.end()


def open_training(config: WorldModelRun, spec: EnvSpec, attempt: str, transport: Transport) -> XpmWmTraining:
    """Start the workers of one attempt; see `popgen.methods.training.OpenTraining`."""
    return XpmWmTraining(config, spec, XpmWmWorkers(config, attempt, transport))


def open_skilled_training(config: FcpWmRun, spec: EnvSpec, attempt: str, transport: Transport) -> FcpWmTraining:
    """The same, each later seed kept at several skills."""
    return FcpWmTraining(config, spec, XpmWmWorkers(config, attempt, transport))
