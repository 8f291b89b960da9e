"""What an ego's run needs, and what cannot work: actors, bytes, checks."""

from __future__ import annotations

from popgen.envs.contract import EnvSpec
from popgen.errors import UserError
from popgen.methods.byte_counts import FLOAT, count_numbers, observation_entries
from popgen.methods.ego.config import BrRun, EgoRun, HiptRun
from popgen.methods.method import ActorDemand, Needs, ask_for

MOST_PARTNERS = 64
"""For which memory is reckoned: a critic's inputs, and their weights."""


def list_actors(config: EgoRun) -> list[ActorDemand]:
    """One learner, with its environments and partners; it computes on the CPU."""
    return [ask_for(config, "agent_cpus", 1)]


def estimate_needs(config: EgoRun, spec: EnvSpec) -> Needs:
    """Bytes."""
    ego = config.ego
    member = FLOAT * count_numbers(lambda: _build_networks(config, spec))
    rows = ego.envs * (spec.num_players if config.plays_itself else 1)
    row = FLOAT * (2 * observation_entries(spec, "features") + observation_entries(spec, _view_of(config)))
    row += FLOAT * (2 * spec.num_actions + 4 * spec.num_players + MOST_PARTNERS + 16)
    return Needs(member=member, batch=2 * rows * ego.unroll * row, batch_field="ego.envs", left=member)


def _view_of(config: EgoRun) -> str:
    return "lossless" if config.ego.network == "conv_lstm" else "features"


def _build_networks(config: EgoRun, spec: EnvSpec) -> list[object]:
    from popgen.methods.ego.ego_learner import EgoSetup
    from popgen.methods.ego.ego_networks import EgoNet
    from popgen.nets.feed_forward import FeedForwardNet, Sizes, joint_copies

    sizes, view = Sizes(config.ego.critic_units, 2, "leaky_relu"), spec.views["features"]
    who = spec.num_players + MOST_PARTNERS
    critics = [FeedForwardNet(view, 1, who, sizes, joint_copies(view)) for _ in range(2)]
    return [EgoNet(EgoSetup.of_run(config).sizes, spec), *critics]


def _check_alone(config: EgoRun) -> None:
    """Settings of play beside partners are in vain where there are none."""
    for name, value, fix in (
        ("other_starts", config.ego.other_starts, "leave it out; method=sp_aug has augment.share"),
        ("sampling", "" if config.ego.sampling == "uniform" else config.ego.sampling, "leave it out"),
    ):
        if value:
            raise UserError(f"ego.{name}", f"is of play beside partners, {config.method} plays with itself", fix)


def check_run(config: EgoRun, spec: EnvSpec) -> None:
    """No card; partners, unless the ego plays with itself; two players; the view of the network.

    Raises:
        UserError: what is missing or in vain.
    """
    ego, partners = config.ego, config.ego.partners
    if config.cluster.agent_gpus > 0:
        raise UserError("cluster.agent_gpus", "an ego learns on the CPU", "set cluster.agent_gpus=0")
    if config.plays_itself and partners:
        raise UserError("ego.partners", f"{config.method} plays with itself", "leave them out or choose another method")
    if not config.plays_itself and not partners:
        raise UserError("ego.partners", f"{config.method} needs partners", "name a population: popgen ego train PATH")
    if config.plays_itself:
        _check_alone(config)
    if isinstance(config, BrRun) and len(partners) != 1:
        raise UserError("ego.partners", "a best response has one partner", "name one member: PATH:3")
    if spec.num_players != 2:
        raise UserError("env.name", f"{spec.name} has {spec.num_players} players", "egos play with one partner")
    if (view := _view_of(config)) not in spec.views:
        raise UserError("ego.network", f"{spec.name} has no view {view!r}", "choose features_gru")
    if isinstance(config, HiptRun) and ego.unroll < config.hipt.duration_most:
        problem = f"{ego.unroll} is shorter than a z may last ({config.hipt.duration_most})"
        raise UserError("ego.unroll", problem, "raise it, best to the environment's horizon")
