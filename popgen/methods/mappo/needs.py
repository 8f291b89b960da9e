"""What a baseline's run needs, and what cannot work: actors, bytes, checks."""

from __future__ import annotations

import math
from typing import NoReturn

import numpy as np

from popgen.envs.contract import EnvSpec
from popgen.errors import UserError
from popgen.methods.byte_counts import FLOAT, count_numbers
from popgen.methods.mappo.config import (
    BaselineRun,
    BpRun,
    BrdivConfig,
    BrdivRun,
    ComediRun,
    E3tRun,
    FcpRun,
    HspConfig,
    HspRun,
    LipoRun,
    PpoConfig,
)
from popgen.methods.method import ActorDemand, Needs, ask_for
from popgen.types import BIASED_ROLE, CONFEDERATE_ROLE, PARTNER_ROLE, SKILLS


def list_actors(config: BaselineRun) -> list[ActorDemand]:
    """Remote runners; the learner is in the driver's process."""
    return [ask_for(config, "sampler_cpus", config.ppo.runners)]


def estimate_mappo(config: BaselineRun, spec: EnvSpec) -> Needs:
    """Bytes of self-play alone."""
    return _estimate(config, spec, critics=1, environments=config.ppo.envs)


def estimate_together(config: BaselineRun, spec: EnvSpec) -> Needs:
    """Bytes of self-play of all members at once."""
    size = config.population.size
    return _estimate(config, spec, critics=1, environments=size * config.ppo.envs, together=size)


def estimate_lipo(config: LipoRun, spec: EnvSpec) -> Needs:
    """Bytes with cross-play: all pairs together, or those of the last member."""
    size, together = config.population.size, config.diversity.order == "concurrent"
    own, pairs = (size, size * (size - 1) // 2) if together else (1, size - 1)
    environments = own * config.ppo.envs + pairs * config.diversity.xp_envs
    return _estimate(config, spec, critics=size, environments=environments, together=size)


def estimate_comedi(config: ComediRun, spec: EnvSpec) -> Needs:
    """Bytes with cross-play and mixed play of the last member, and with the fresh episodes that find its strongest
    partner, which are played at once."""
    partners, diversity = config.population.size - 1, config.diversity
    mixed = diversity.mp_envs if diversity.lambda_mp > 0.0 else 0
    environments = config.ppo.envs + partners * (diversity.xp_envs + mixed)
    fresh = 2 * diversity.select_episodes * partners
    return _estimate(config, spec, critics=1 + 2 * partners, environments=environments, fresh=fresh)


def list_pair_roles(pairs: HspConfig | BrdivConfig) -> tuple[str, ...]:
    """Of the members that a pair gives, in order."""
    first = BIASED_ROLE if isinstance(pairs, HspConfig) else CONFEDERATE_ROLE
    return {"both": (first, PARTNER_ROLE), "partners": (PARTNER_ROLE,)}.get(pairs.members, (first,))


def estimate_hsp(config: HspRun | BpRun, spec: EnvSpec) -> Needs:
    """Bytes of all pairs at once, two policies each."""
    pool = config.hsp.pool
    return _estimate(config, spec, critics=1, environments=pool * config.ppo.envs, together=2 * pool)


def check_hsp(config: HspRun | BpRun, spec: EnvSpec) -> None:
    """A run of RLlib's, whole pairs, and a pool that has as many.

    Raises:
        UserError: what `check_run` refuses, half a pair, or more pairs than are trained.
    """
    check_run(config, spec)
    size, each = config.population.size, len(list_pair_roles(config.hsp))
    _check_groups(size, each, "each pair gives a biased agent and its partner")
    if size // each > config.hsp.pool:
        raise UserError("hsp.pool", f"is {config.hsp.pool}, of which {size // each} are to be chosen", "raise it")
    _check_seatings(config)


def estimate_brdiv(config: BrdivRun, spec: EnvSpec) -> Needs:
    """Bytes of all pairs at once, two policies each, and of their cross-play."""
    pairs = config.population.size // len(list_pair_roles(config.brdiv))
    crossed = pairs - 1 if config.brdiv.alpha > 0.0 else 0
    environments = pairs * (config.ppo.envs + crossed * config.brdiv.xp_envs)
    return _estimate(config, spec, critics=1 + crossed, environments=environments, together=2 * pairs)


def check_brdiv(config: BrdivRun, spec: EnvSpec) -> None:
    """A run of RLlib's, and at least two whole pairs.

    Raises:
        UserError: what `check_run` refuses, half a pair, or a single one.
    """
    check_run(config, spec)
    size, each = config.population.size, len(list_pair_roles(config.brdiv))
    _check_groups(size, each, "each pair gives a confederate and its best response")
    if size < 2 * each:
        raise UserError("population.size", f"{size} leaves a pair nobody to differ from", f"set it to {2 * each}")
    _check_seatings(config)


def _check_groups(size: int, each: int, gives: str) -> None:
    """A population of whole groups of members that come together."""
    if left := size % each:
        problem = f"{size} is no multiple of {each}: {gives}"
        raise UserError("population.size", problem, f"set it to {size + each - left}")


def _check_seatings(config: BaselineRun) -> None:
    """Environments for both seatings of a pair."""
    if config.ppo.envs < 2:
        raise UserError("ppo.envs", "a pair plays in two seatings", "set it to at least 2")


def _estimate(
    config: BaselineRun, spec: EnvSpec, *, critics: int, environments: int, fresh: int = 0, together: int = 1
) -> Needs:
    """Bytes: an iteration's observations as they were sampled and as they are learned from, or the fresh episodes."""
    ppo, view = config.ppo, spec.views.get(config.ppo.view)
    if view is None:
        return Needs(member=0, batch=0, batch_field="ppo.envs", in_driver=True)
    row = spec.num_players * math.prod(view.shape) * np.dtype(view.dtype).itemsize
    member = FLOAT * count_numbers(lambda: _build_networks(ppo, spec, critics))
    return Needs(
        member=member,
        batch=row * max(2 * (ppo.steps + 1) * environments, (spec.horizon + 1) * fresh),
        batch_field="ppo.envs",
        left=member,
        together=together,
        in_driver=True,
    )


def _build_networks(ppo: PpoConfig, spec: EnvSpec, critics: int) -> list[object]:
    from popgen.nets.feed_forward import FeedForwardNet, Sizes, joint_copies

    view, players = spec.views[ppo.view], spec.num_players
    sizes = Sizes(ppo.units, ppo.layers, ppo.activation, tuple(ppo.cnn_kernels), ppo.cnn_channels)
    values = [FeedForwardNet(view, 1, players, sizes, joint_copies(view)) for _ in range(critics)]
    return [FeedForwardNet(view, spec.num_actions, players, sizes), *values]


def refuse_inline() -> NoReturn:
    """RLlib starts its own workers, on Ray.

    Raises:
        UserError: always.
    """
    raise UserError("run.transport", "is inline, but RLlib needs Ray", "set run.transport=ray")


def check_run(config: BaselineRun, spec: EnvSpec) -> None:
    """RLlib needs Ray, and the environment must have the networks' view.

    Raises:
        UserError: everything is to be in one process, or the environment does not have the view.
    """
    if config.run.transport == "inline":
        refuse_inline()
    view = config.ppo.view
    if view not in spec.views:
        raise UserError("ppo.view", f"{spec.name} has no view {view!r}", f"choose one of {', '.join(spec.views)}")


def check_comedi(config: ComediRun, spec: EnvSpec) -> None:
    """A run of RLlib's, and one member after the other.

    Raises:
        UserError: what `check_run` refuses, or another order.
    """
    check_run(config, spec)
    if config.diversity.order != "sequential":
        raise UserError("diversity.order", "CoMeDi trains one member after the other", "set it to sequential")


def check_e3t(config: E3tRun, spec: EnvSpec) -> None:
    """A run of RLlib's, and an environment for each seating and for plain self-play.

    Raises:
        UserError: what `check_run` refuses, or too few environments.
    """
    check_run(config, spec)
    if config.e3t.epsilon > 0.0 and config.ppo.envs < 3:
        raise UserError("ppo.envs", "E3T plays in two seatings, and plainly with itself", "set it to at least 3")


def check_fcp(config: FcpRun, spec: EnvSpec) -> None:
    """A run of RLlib's, and whole seeds.

    Raises:
        UserError: what `check_run` refuses, or members that are no whole seeds.
    """
    check_run(config, spec)
    gives = "each seed gives an initial, a half trained and a final member"
    _check_groups(config.population.size, len(SKILLS), gives)
