"""XPM-Sim's workers: samplers, and one actor with both buffers, the exact dynamics F and a member's learner."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from popgen.actors.actor_setup import build_env, limit_threads
from popgen.actors.samplers import start_samplers
from popgen.envs.contract import EnvSpec
from popgen.methods.training import Pending, Place, PolicySnapshot, Sampled, Segments, State, Transport, UpdateFigures
from popgen.methods.xpm_sim.agent import XpmSimLearner
from popgen.methods.xpm_sim.config import XpmSimRun
from popgen.methods.xpm_sim.restart_check import restart_check
from popgen.methods.xpm_sim.train import XpmSimTraining
from popgen.methods.xpm_sim.workers import Learned, RestartCheck
from popgen.nets.weights import weights_of
from popgen.play.rollout import Match
from popgen.types import Weights

ENVS = 64
"""Environments from which start states are drawn at once."""


class SimulatedAgentActor:
    """Thin: every number is made by `XpmSimLearner`."""

    def __init__(self, config: XpmSimRun, threads: int, transport: Transport) -> None:
        limit_threads(threads)
        self.config, self.transport = config, transport
        self.env = build_env(config.env, ENVS, config.run.seed)
        self._learner: XpmSimLearner | None = None

    @property
    def learner(self) -> XpmSimLearner:
        """The learner of the running member.

        Raises:
            RuntimeError: no member has begun.
        """
        if self._learner is None:
            raise RuntimeError("begin_member comes first")
        return self._learner

    def begin_member(
        self, member: int, seed: int, partners: Mapping[int, Pending[Weights]], encoder: Pending[State | None] | None
    ) -> Weights:
        """Fresh networks and buffers beside frozen predecessors (weights by member), on the shared encoder if there is
        one; the fresh acting weights."""
        self.env.reset(seed=seed)
        frozen = {partner: weights.result() for partner, weights in partners.items()}
        shared = None if encoder is None else encoder.result()
        self._learner = XpmSimLearner(self.config.xpm_sim, self.env, member, seed, frozen, shared)
        return self._learner.actor.weights()

    def ingest(self, segments: list[Segments], strength: dict[int, float], multipliers: dict[int, float]) -> None:
        """Real episodes into the buffers; each partner's latest cross-play return, and its multiplier."""
        for by_kind in segments:
            for part in by_kind.values():
                self.learner.starts.add(part.result())
        self.learner.partner_scores, self.learner.constraint.multipliers = dict(strength), dict(multipliers)

    def learn(self, updates: int) -> Learned:
        """Simulate and update `updates` times."""
        figures, learner = UpdateFigures(), self.learner
        steps, trajectories = learner.simulated, learner.trajectories
        for _ in range(updates):
            figures.add(learner.update())
        times = figures.times(updates)
        means = figures.means() | {name: times[name] for name in ("update_ms", "cpu_seconds")}
        acting = self.transport.put(learner.actor.weights())
        return Learned(acting, means, learner.simulated - steps, learner.trajectories - trajectories)

    def check(self) -> RestartCheck:
        """Check restarts; see `restart_check`."""
        return RestartCheck(*restart_check(self.learner, self.config.xpm_sim.check_pairs))

    def encoder(self) -> State | None:
        """The shared encoder for the next member, None without one."""
        return None if self.learner.encoder is None else self.learner.encoder.state()

    def critics(self) -> Weights:
        """The critics' weights, which a member keeps beside its policy."""
        return weights_of(self.learner.critics)

    def state(self) -> dict[str, Any]:
        """Collect the state of the learner, its buffers and running trajectories."""
        return self.learner.state()

    def load_state(self, state: Pending[State]) -> None:
        """Continue from `state()`, after `begin_member` with the same partners."""
        self.learner.load_state(state.result())


class XpmSimWorkers:
    """See `popgen.methods.xpm_sim.workers.Workers`."""

    def __init__(self, config: XpmSimRun, attempt: str, transport: Transport) -> None:
        cluster, self.transport = config.cluster, transport
        self.samplers = start_samplers(config, attempt, transport)
        place = Place(cluster.agent_cpus)
        self.learner = transport.start(SimulatedAgentActor, place, config, cluster.threads, transport)

    def put(self, weights: Weights) -> Pending[Weights]:
        """Put weights into the transport's store."""
        return self.transport.put(weights)

    def begin_member(
        self, member: int, seed: int, partners: Mapping[int, Pending[Weights]], encoder: Pending[State | None] | None
    ) -> Pending[Weights]:
        """Have the learner begin with a member; its fresh acting weights."""
        return self.learner.ask(SimulatedAgentActor.begin_member, member, seed, dict(partners), encoder)

    def play(self, matches: list[Match], policies: dict[int, PolicySnapshot], seed: int, steps: int) -> list[Sampled]:
        """Let all samplers play at the same time; segments stay where they are."""
        self.samplers.open(matches, policies, seed)
        return self.samplers.collect(steps)

    def ingest(
        self, segments: list[Segments], strength: dict[int, float], multipliers: dict[int, float]
    ) -> Pending[None]:
        """Send segments from the samplers' store to the learner."""
        return self.learner.ask(SimulatedAgentActor.ingest, segments, strength, multipliers)

    def learn(self, updates: int) -> Pending[Learned]:
        """Ask the learner for updates."""
        return self.learner.ask(SimulatedAgentActor.learn, updates)

    def check(self) -> Pending[RestartCheck]:
        """Ask the learner how self-play does from states of cross-play and from its own."""
        return self.learner.ask(SimulatedAgentActor.check)

    def critics(self) -> Pending[Weights]:
        """Ask the learner for its critics' weights."""
        return self.learner.ask(SimulatedAgentActor.critics)

    def encoder(self) -> Pending[State | None]:
        """Ask the learner for the shared encoder's state."""
        return self.learner.ask(SimulatedAgentActor.encoder)

    def state(self) -> State:
        """Ask learner and samplers for their states; handles."""
        return {"learner": self.learner.ask(SimulatedAgentActor.state), "samplers": self.samplers.state()}

    def load_state(self, state: State) -> None:
        """Load the learner's state; of the fresh samplers' only the number of the next segment matters."""
        self.learner.ask(SimulatedAgentActor.load_state, self.transport.put(state["learner"])).result()
        self.samplers.load_state(state["samplers"])

    def end(self) -> None:
        """End samplers and learner."""
        self.samplers.end()
        self.learner.end()


def open_training(config: XpmSimRun, spec: EnvSpec, attempt: str, transport: Transport) -> XpmSimTraining:
    """Start the workers of one attempt; see `popgen.methods.training.OpenTraining`."""
    return XpmSimTraining(config, spec, attempt, XpmSimWorkers(config, attempt, transport))
