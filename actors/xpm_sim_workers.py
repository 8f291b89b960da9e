"""XPM-Sim's workers over a transport: samplers, and the learner with its buffers and simulator."""

from __future__ import annotations

from collections.abc import Mapping

from popgen.actors.sampler_pool import start_samplers
from popgen.actors.simulated_agent_actor import SimulatedAgentActor
from popgen.envs.contract import EnvSpec
from popgen.methods.training import Pending, PolicySnapshot, Sampled, Segments, State
from popgen.methods.transport import Place, Transport
from popgen.methods.xpm_sim.config import XpmSimRun
from popgen.methods.xpm_sim.train import XpmSimTraining
from popgen.methods.xpm_sim.workers import Learned, RestartCheck
from popgen.nets.weights import Weights
from popgen.play.matches import Match


class XpmSimWorkers:
    """See `popgen.methods.xpm_sim.workers.Workers`."""

    def __init__(self, config: XpmSimRun, attempt: str, transport: Transport) -> None:
        cluster, self.transport = config.cluster, transport
        self.samplers = start_samplers(config, attempt, transport)
        place = Place(cluster.agent_cpus)
        self.learner = transport.start(SimulatedAgentActor, place, config, cluster.threads, transport)

    def put(self, weights: Weights) -> Pending[Weights]:
        """Into the transport's store."""
        return self.transport.put(weights)

    def begin_member(
        self, member: int, seed: int, partners: Mapping[int, Pending[Weights]], encoder: Pending[State | None] | None
    ) -> Pending[Weights]:
        """The learner's."""
        return self.learner.ask(SimulatedAgentActor.begin_member, member, seed, dict(partners), encoder)

    def play(self, matches: list[Match], policies: dict[int, PolicySnapshot], seed: int, steps: int) -> list[Sampled]:
        """All samplers at the same time; segments stay where they are."""
        self.samplers.open(matches, policies, seed)
        return self.samplers.collect(steps)

    def ingest(
        self, segments: list[Segments], strength: dict[int, float], multipliers: dict[int, float]
    ) -> Pending[None]:
        """Segments go from the samplers' store to the learner."""
        return self.learner.ask(SimulatedAgentActor.ingest, segments, strength, multipliers)

    def learn(self, updates: int) -> Pending[Learned]:
        """The learner's."""
        return self.learner.ask(SimulatedAgentActor.learn, updates)

    def check(self) -> Pending[RestartCheck]:
        """The learner's."""
        return self.learner.ask(SimulatedAgentActor.check)

    def critics(self) -> Pending[Weights]:
        """The learner's."""
        return self.learner.ask(SimulatedAgentActor.critics)

    def encoder(self) -> Pending[State | None]:
        """The learner's."""
        return self.learner.ask(SimulatedAgentActor.encoder)

    def state(self) -> State:
        """Handles of the learner's state and of the samplers'."""
        return {"learner": self.learner.ask(SimulatedAgentActor.state), "samplers": self.samplers.state()}

    def load_state(self, state: State) -> None:
        """The learner's; fresh samplers have played nothing: only the running number of their segments matters."""
        self.learner.ask(SimulatedAgentActor.load_state, self.transport.put(state["learner"])).result()
        self.samplers.load_state(state["samplers"])

    def end(self) -> None:
        """End samplers and learner."""
        self.samplers.end()
        self.learner.end()


def open_training(config: XpmSimRun, spec: EnvSpec, attempt: str, transport: Transport) -> XpmSimTraining:
    """Start the workers of one attempt; see `popgen.methods.transport.OpenTraining`."""
    return XpmSimTraining(config, spec, attempt, XpmSimWorkers(config, attempt, transport))
