"""An ego's learner over a transport, and its partners out of populations."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from popgen.actors.actor_setup import build_env, limit_threads
from popgen.envs.contract import EnvSpec
from popgen.errors import UserError
from popgen.evaluation.holdout_lineages import NO_WEIGHTS, identify_member, merge_records, read_partners, read_people
from popgen.methods.ego.config import BrRun, EgoRun
from popgen.methods.ego.ego_learner import EgoLearner, EgoSetup, make_policy
from popgen.methods.ego.ego_rollout import EndedEpisode
from popgen.methods.ego.partner_source import PartnerSource
from popgen.methods.ego.train import EgoTraining
from popgen.methods.ego.workers import Iterations
from popgen.methods.training import Pending, Place, State, Transport, UpdateFigures
from popgen.play.policy import Policy
from popgen.population import Population, check_compatible
from popgen.population.chosen_members import load_members
from popgen.population.store import MANIFEST
from popgen.types import Weights


@dataclass(frozen=True)
class NamedMembers:
    """Members of one population that an argument names.

    Attributes:
        population: loaded and checked.
        members: from 1.
        digest: of its manifest, which names all its members' digests.
    """

    population: Population
    members: tuple[int, ...]
    digest: str


def read_partner(text: str) -> NamedMembers:
    """PATH, or PATH:1,3 for some members only. Of members with the same weights PATH means the first: FCP's half
    trained checkpoint is the final one where nothing was learned.

    Raises:
        UserError: no population, or no such member.
    """
    chosen = load_members(text, "ego.partners")
    population = chosen.population
    members = chosen.members if chosen.named else list_distinct(population)
    if not members:
        raise UserError("ego.partners", f"{text} has no members", "choose another population")
    data = (population.path / MANIFEST).read_bytes()
    return NamedMembers(population, members, hashlib.sha256(data).hexdigest())


def list_distinct(population: Population) -> tuple[int, ...]:
    """Members that act as no earlier one does; those without weights cannot be told apart, and all stay."""
    infos, fingerprint = population.members, population.env_info.fingerprint
    known = [identify_member(info, fingerprint) for info in infos]
    kept = [
        info.policy_sha256 == NO_WEIGHTS or own not in known[:n]
        for n, (info, own) in enumerate(zip(infos, known, strict=True))
    ]
    return tuple(member for member, stays in enumerate(kept, 1) if stays)


def load_partners(config: EgoRun, spec: EnvSpec) -> list[NamedMembers]:
    """All partners of a run, of its environment and unchanged since they were pinned.

    Raises:
        UserError: a population that is missing, changed or of another environment.
    """
    named = [read_partner(text) for text in config.ego.partners]
    for one in named:
        check_compatible(one.population, spec)
    _check_pinned(config, named)
    known = [
        identity
        for one in describe_partners(named)
        for digest, identity in zip(one.policy_sha256, one.identity, strict=True)
        if digest != NO_WEIGHTS
    ]
    if len(set(known)) < len(known):
        problem = "hold a member twice (by all that decides how it acts), which would play twice as often as others"
        raise UserError("ego.partners", problem, "name each once: PATH:1,3")
    if isinstance(config, BrRun) and (count := sum(len(one.members) for one in named)) > 1:
        raise UserError("ego.partners", f"{count} members, but a best response has one partner", "name it: PATH:3")
    return named


def _check_pinned(config: EgoRun, named: Sequence[NamedMembers]) -> None:
    """The populations are those, in their order, with which the run began; one that is not pinned has not begun."""
    if not (pinned := config.ego.pinned):
        return
    if len(pinned) != len(named):
        problem = f"has {len(pinned)} digests for {len(named)} populations"
        raise UserError("ego.pinned", problem, "leave it out: popgen ego train fills it in")
    for one, text, digest in zip(named, config.ego.partners, pinned, strict=True):
        if one.digest != digest:
            raise UserError("ego.partners", f"{text} has changed since the run began", "restore it or start a new run")


def describe_partners(named: Sequence[NamedMembers]) -> list[PartnerSource]:
    """Where they come from, and what they were trained with themselves.

    Raises:
        UserError: their records hold something else.
    """
    return [_describe_source(one) for one in named]


def _describe_source(one: NamedMembers) -> PartnerSource:
    population, place = one.population, str(one.population.path)
    manifest, members = population.manifest, [population.info(member) for member in one.members]
    for info in members:
        read_partners(place, info.extra)  # what an ego's record takes over must be readable
    nested = merge_records(members)
    people = dict.fromkeys(read_people(place, info.extra) for info in members)
    return PartnerSource(
        method=manifest.method,
        seed=manifest.seed,
        config_digest=manifest.config_digest,
        members=one.members,
        policy_sha256=tuple(info.policy_sha256 for info in members),
        identity=tuple(identify_member(info, manifest.environment.fingerprint) for info in members),
        population_sha256=tuple(info.policy_sha256 for info in population.members),
        people=tuple(group.as_dict() for group in people if group is not None),
        trained_with=None if nested is None else tuple(nested),
    )


def build_partners(named: Sequence[NamedMembers]) -> list[Policy]:
    """Fresh policies, in the order of the arguments and their members."""
    return [one.population[member] for one in named for member in one.members]


class EgoActor:
    """Thin: every number is made by `EgoLearner`."""

    def __init__(self, config: EgoRun, threads: int) -> None:
        limit_threads(threads)
        self.config = config
        self._learner: EgoLearner | None = None

    @property
    def learner(self) -> EgoLearner:
        """The learner of the running ego.

        Raises:
            RuntimeError: none has begun.
        """
        if self._learner is None:
            raise RuntimeError("begin_member comes first")
        return self._learner

    def begin_member(self, seed: int) -> None:
        """Fresh networks, environments and partners."""
        config = self.config
        env = build_env(config.env, config.ego.envs, seed)
        partners = build_partners(load_partners(config, env.spec))
        self._learner = EgoLearner(EgoSetup.of_run(config), env, partners, seed)

    def iterate(self, count: int) -> Iterations:
        """So many rollouts with their updates."""
        figures, episodes = UpdateFigures(), list[EndedEpisode]()
        steps = simulated = 0
        for _ in range(count):
            done = self.learner.iterate()
            steps, simulated, episodes = steps + done.steps, simulated + done.simulated, episodes + done.episodes
            figures.add(done.figures)
        means = figures.means() | {"steps_per_second": steps / figures.seconds()}
        return Iterations(means, steps, simulated, episodes, figures.cpu_seconds())

    def acting(self) -> Weights:
        """The ego's weights."""
        return self.learner.policy.weights()

    def critics(self) -> Weights:
        """The critics' weights."""
        return self.learner.training_weights()

    def state(self) -> dict[str, Any]:
        """Collect the state of the learner and the running episodes."""
        return self.learner.state()

    def load_state(self, state: State) -> None:
        """Continue from `state()`, after `begin_member`."""
        self.learner.load_state(state)


class EgoWorkers:
    """See `popgen.methods.ego.workers.Workers`."""

    def __init__(self, config: EgoRun, transport: Transport) -> None:
        cluster = config.cluster
        self.learner = transport.start(EgoActor, Place(cluster.agent_cpus), config, cluster.threads)

    def begin_member(self, seed: int) -> Pending[None]:
        """Have the learner begin with an ego."""
        return self.learner.ask(EgoActor.begin_member, seed)

    def iterate(self, count: int) -> Pending[Iterations]:
        """Ask the learner for so many rollouts with their updates."""
        return self.learner.ask(EgoActor.iterate, count)

    def acting(self) -> Pending[Weights]:
        """Ask the learner for the ego's weights."""
        return self.learner.ask(EgoActor.acting)

    def critics(self) -> Pending[Weights]:
        """Ask the learner for its critics' weights."""
        return self.learner.ask(EgoActor.critics)

    def state(self) -> Pending[State]:
        """Ask the learner for its state and that of the running episodes."""
        return self.learner.ask(EgoActor.state)

    def load_state(self, state: State) -> None:
        """Load a state into the learner and wait until it is there."""
        self.learner.ask(EgoActor.load_state, state).result()

    def end(self) -> None:
        """End the learner."""
        self.learner.end()


def open_training(config: EgoRun, spec: EnvSpec, attempt: str, transport: Transport) -> EgoTraining:
    """Start the worker of one attempt; see `popgen.methods.training.OpenTraining`."""
    sources = describe_partners(load_partners(config, spec))
    policy = make_policy(EgoSetup.of_run(config), spec)
    return EgoTraining(config, policy, spec.score_name, attempt, EgoWorkers(config, transport), sources)
