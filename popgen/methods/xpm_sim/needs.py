"""What an XPM-Sim run needs, and what cannot work: actors, bytes, checks."""

from __future__ import annotations

from popgen.envs.contract import EnvSpec
from popgen.errors import UserError
from popgen.methods.byte_counts import (
    FLOAT,
    buffer_bytes,
    count_numbers,
    observation_entries,
    segment_bytes,
    state_bytes,
)
from popgen.methods.method import ActorDemand, Needs, ask_for
from popgen.methods.xpm_sim.config import XpmSimRun

WRITTEN = 3
"""Checkpoints of the running member on disk at a time, each with its whole buffers."""


def list_actors(config: XpmSimRun) -> list[ActorDemand]:
    """Samplers and a learner, which steps the simulator and stays on processors."""
    return [ask_for(config, "sampler_cpus", config.cluster.samplers), ask_for(config, "agent_cpus", 1)]


def estimate_needs(config: XpmSimRun, spec: EnvSpec) -> Needs:
    """Bytes."""
    sim = config.xpm_sim
    member = FLOAT * count_numbers(lambda: _build_networks(config, spec))
    columns = sim.sims_sp + sim.sims_restart + sim.sims_xp
    row = state_bytes(spec) + spec.num_players * observation_entries(spec, "features")
    return Needs(
        member=member,
        batch=columns * sim.unroll * row,
        batch_field="xpm_sim.unroll",
        buffers=2 * buffer_bytes(sim.capacity, spec),
        buffers_field="xpm_sim.capacity",
        in_flight=2 * segment_bytes((sim.episodes_sp + sim.episodes_xp) * spec.horizon, spec),
        left=member,
        buffer_copies=WRITTEN,
    )


def _build_networks(config: XpmSimRun, spec: EnvSpec) -> list[object]:
    """Actor and critics of the last member; with a shared encoder that too, and its decoder."""
    from popgen.methods.xpm_sim.encoded_policy import EncodedNet
    from popgen.methods.xpm_sim.vae import latent_view
    from popgen.nets.feed_forward import FeedForwardNet, Sizes, joint_copies

    sim, view, partners = config.xpm_sim, spec.views["features"], config.population.size - 1
    sizes, players = Sizes(sim.units, sim.layers, sim.activation), spec.num_players
    observed = view
    if sim.encoder == "none":
        networks: list[object] = [FeedForwardNet(view, spec.num_actions, players, sizes)]
    else:
        observed, inner = latent_view(sim.latent), Sizes(sim.encoder_units, sim.encoder_layers, sim.activation)
        encoder = FeedForwardNet(view, 2 * sim.latent, 0, inner)
        decoder = FeedForwardNet(observed, view.shape[0], 0, inner)
        networks = [EncodedNet(encoder, sim.latent, spec.num_actions, players, sizes), decoder]
    extras = [players] * partners if sim.xp_critic == "separate" else [players + partners] * min(partners, 1)
    copies = joint_copies(observed)
    return networks + [FeedForwardNet(observed, 1, extra, sizes, copies) for extra in (0, *extras)]


def check_run(config: XpmSimRun, spec: EnvSpec) -> None:
    """A round's real episodes must fit the buffers; where episodes end early each step can add a second row.

    Raises:
        UserError: they do not.
    """
    sim = config.xpm_sim
    added = 2 * max(sim.episodes_sp, sim.episodes_xp) * spec.horizon
    if sim.capacity < added:
        problem = f"may not hold the {added:,} rows that a round of real episodes adds"
        raise UserError("xpm_sim.capacity", problem, "raise it or lower xpm_sim.episodes_sp and episodes_xp")
