"""XPM-WM's workers over a transport: samplers, both buffers, the world model's learner and the agent's."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from popgen.actors.samplers import start_samplers
from popgen.actors.xpm_wm_actors import AgentActor, ReplayActor, WorldModelActor
from popgen.envs.contract import EnvSpec
from popgen.methods.training import Checkpoint, Pending, PolicySnapshot, Sampled, Segments, State
from popgen.methods.transport import Place, Transport, Worker
from popgen.methods.xpm_wm.config import FcpWmRun, WorldModelRun
from popgen.methods.xpm_wm.imagination import Starts
from popgen.methods.xpm_wm.member_training import XpmWmTraining
from popgen.methods.xpm_wm.real_play import Tally
from popgen.methods.xpm_wm.skilled_training import FcpWmTraining
from popgen.methods.xpm_wm.workers import AgentTask, AgentUpdate, ModelTask, ModelUpdate
from popgen.nets.weights import Weights
from popgen.play.matches import Match
from popgen.types import Kind

BUFFERS = ("replay_sp", "replay_xp")


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
        self.transport, self.attempt = transport, attempt
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
        """Into the transport's store."""
        return self.transport.put(value)

    def wait(self, pending: Sequence[Pending[Any]], timeout: float | None = None) -> list[Pending[Any]]:
        """See `Transport.wait`."""
        return self.transport.wait(pending, timeout)

    def begin_member(self, member: int, seed: int, archive: dict[int, Weights]) -> None:
        """Both learners'."""
        self.agent.ask(AgentActor.begin_member, member, seed, archive).result()
        self.model.ask(WorldModelActor.begin_member, member, archive).result()

    def restart_agent(self, seed: int) -> None:
        """The agent learner's."""
        self.agent.ask(AgentActor.restart, seed).result()

    # ---- real episodes ---------------------------------------------------------------------------------------------

    def start_episodes(
        self, matches: list[Match], policies: dict[int, PolicySnapshot], seed: int, stagger: bool = False
    ) -> None:
        """All samplers'."""
        self.pool.open(matches, policies, seed, stagger)

    def collect(self, steps: int) -> list[Sampled]:
        """All samplers at the same time."""
        return self.pool.collect(steps)

    def samplers(self) -> list[str]:
        """sampler0, sampler1, ... of those with matches."""
        return [f"sampler{index}" for index in self.pool.active]

    def start_sampling(self, sampler: str, steps: int, member: int, acting: Pending[Weights]) -> Pending[Sampled]:
        """One sampler's."""
        return self.pool.start(int(sampler.removeprefix("sampler")), steps, member, acting)

    def add_to_buffers(self, sampled: Sequence[Sampled], owner: int) -> None:
        """Each segment goes to the one buffer that wants it; it has arrived when this returns."""
        wait_for_all(added for one in sampled for added in self._send(one.segments, owner))

    def _send(self, segments: Segments, owner: int) -> list[Pending[int]]:
        return [
            self.replays["replay_xp" if kind == Kind.XP else "replay_sp"].ask(ReplayActor.ingest, part, owner)
            for kind, part in segments.items()
        ]

    # ---- learning --------------------------------------------------------------------------------------------------

    def update_world_model(self, task: ModelTask) -> Pending[ModelUpdate]:
        """The world-model learner's."""
        return self.model.ask(WorldModelActor.train, task)

    def tally(self, member: int) -> Pending[Tally]:
        """B_SP's."""
        return self.replays["replay_sp"].ask(ReplayActor.tally, member)

    def cache_starts(self) -> Pending[Starts]:
        """The world-model learner's."""
        return self.model.ask(WorldModelActor.cache_starts)

    def model_weights(self) -> Pending[Weights]:
        """The world-model learner's."""
        return DelayedWeights(self.model.ask(WorldModelActor.weights))

    def report_model(self) -> Pending[dict[str, float]]:
        """The world-model learner's."""
        return self.model.ask(WorldModelActor.report)

    def update_agent(self, task: AgentTask) -> Pending[AgentUpdate]:
        """The agent learner's."""
        return self.agent.ask(AgentActor.train, task)

    # ---- checkpoints -----------------------------------------------------------------------------------------------

    def state(self) -> State:
        """Handles; the buffers themselves are in the log."""
        return {
            "model": self.model_state(),
            "agent": self.agent.ask(AgentActor.state),
            "marks": {name: replay.ask(ReplayActor.marks) for name, replay in self.replays.items()},
            "samplers": self.pool.state(),
        }

    def buffers_state(self) -> State:
        """Handles of both buffers."""
        return {name: replay.ask(ReplayActor.state) for name, replay in self.replays.items()}

    def model_state(self) -> Pending[State]:
        """The world-model learner's."""
        return self.model.ask(WorldModelActor.state)

    def adopt(self, left: State) -> None:
        """Buffers and world model as a finished member left them."""
        if left:
            self._load_buffers(left)
            self.model.ask(WorldModelActor.load_state, left["model"]).result()

    def _load_buffers(self, states: State) -> None:
        wait_for_all(replay.ask(ReplayActor.load_state, states[name]) for name, replay in self.replays.items())

    def restore(self, checkpoint: Checkpoint) -> None:
        """Buffers from their last whole copy and the log, then both learners."""
        if checkpoint.buffers is not None:
            self._load_buffers(checkpoint.buffers)
        for segments, owner in checkpoint.log:
            wait_for_all(self._send(segments, owner))
        state = checkpoint.state
        wait_for_all(replay.ask(ReplayActor.load_marks, state["marks"][name]) for name, replay in self.replays.items())
        self.model.ask(WorldModelActor.load_state, self.put(state["model"])).result()
        self.agent.ask(AgentActor.load_state, state["agent"]).result()

    def restore_samplers(self, states: list[State]) -> None:
        """All samplers'."""
        self.pool.load_state(states)

    def published_form(self) -> State:
        """Of the restored learners."""
        model, agent = self.model_weights().result(), self.agent.ask(AgentActor.state).result()
        acting = self.agent.ask(AgentActor.acting_weights, model).result()
        return {"acting": acting, "model": model, "critics": agent["critics"]}

    def end(self) -> None:
        """End all workers."""
        self.pool.end()
        for worker in (*self.replays.values(), self.model, self.agent):
            worker.end()


def open_training(config: WorldModelRun, spec: EnvSpec, attempt: str, transport: Transport) -> XpmWmTraining:
    """Start the workers of one attempt; see `popgen.methods.transport.OpenTraining`."""
    return XpmWmTraining(config, spec, XpmWmWorkers(config, attempt, transport))


def open_skilled_training(config: FcpWmRun, spec: EnvSpec, attempt: str, transport: Transport) -> FcpWmTraining:
    """The same, each later seed kept at several skills."""
    return FcpWmTraining(config, spec, XpmWmWorkers(config, attempt, transport))
