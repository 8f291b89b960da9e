"""Bytes that a run may need, from its configuration alone: buffers, weights, checkpoints, batches.

All are bounds of what grows with the configuration; what does not (programs, logs, plots, MLflow's own file) is
`MARGIN`. `popgen/runs/preflight.py` compares them with what the machine has.
"""

from __future__ import annotations

import math

import numpy as np

from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec, ViewSpec
from popgen.methods.mappo.config import PpoConfig
from popgen.methods.xpm_wm.config import WorldModelConfig

MARGIN = 256 * 2**20
"""Bytes of disk beside buffers and weights: MLflow's file, logs, plots."""

PROGRESS = 8
"""Copies of a member's weights in one checkpoint of its training: optimisers, what is published, the best so far."""

KEPT = 3
"""Checkpoints of the running member that are on disk at a time, the one that is being written among them."""

_FLOAT = 4


# ---- buffers ---------------------------------------------------------------------------------------------------------


def buffer_bytes(config: RunConfig, spec: EnvSpec) -> int:
    """The two full replay buffers: a state, actions, events and 15 bytes of marks for each step. 0 without buffers."""
    capacity = {"xpm_wm": config.replay.capacity, "xpm_sim": config.xpm_sim.capacity}.get(config.method, 0)
    return 2 * capacity * (_state_bytes(spec) + spec.num_players * (1 + spec.num_events) + 15)


def store_bytes(config: RunConfig, spec: EnvSpec) -> int:
    """What is in a node's object store at a time.

    Both whole buffers on their way to a checkpoint; of the samplers, two calls' segments (states twice, rewards and
    marks); and a margin for weights and start states.
    """
    row = 2 * _state_bytes(spec) + spec.num_players * (1 + spec.num_events) + 10
    rows = {
        "xpm_wm": config.phase1.envs * max(400, config.phase1.steps_per_iteration),
        "xpm_sim": (config.xpm_sim.episodes_sp + config.xpm_sim.episodes_xp) * spec.horizon,
    }
    return buffer_bytes(config, spec) + 2 * rows.get(config.method, 0) * row + MARGIN


def memory_needed(config: RunConfig, spec: EnvSpec) -> int:
    """Object store, a batch, and the buffers three times: where they are filled, as they are copied for a checkpoint,
    and in the driver that writes it."""
    store = max(config.cluster.object_store_bytes or 0, store_bytes(config, spec))
    return 3 * buffer_bytes(config, spec) + store + batch_bytes(config, spec)


def batch_bytes(config: RunConfig, spec: EnvSpec) -> int:
    """The observations or latents of the largest batch that an update learns from, once."""
    players, model, agent, sim = spec.num_players, config.world_model, config.agent, config.xpm_sim
    if config.method == "xpm_wm":
        windows = model.batch * model.length * players * _entries(spec.views.get(model.view))
        latents = (agent.starts_sp + agent.starts_xp) * agent.horizon * (model.deter + model.classes * model.groups)
        return _FLOAT * max(windows, latents)
    if config.method == "xpm_sim":
        columns = sim.sims_sp + sim.sims_restart + sim.sims_xp
        return columns * sim.unroll * (_state_bytes(spec) + players * _entries(spec.views.get("features")))
    view = spec.views.get(config.ppo.view)
    row = 0 if view is None else players * _entries(view) * np.dtype(view.dtype).itemsize
    # An iteration's as they were sampled and as they are learned from; or those of the fresh episodes.
    return row * max(2 * (config.ppo.steps + 1) * _environments(config), (spec.horizon + 1) * _fresh(config))


def _environments(config: RunConfig) -> int:
    """Of the last member of a baseline, or of all that learn together (`training_job.Job.groups`)."""
    method, ppo, diversity, size = config.method, config.ppo, config.diversity, config.population.size
    if method == "mappo":
        return ppo.envs
    together = method == "lipo" and diversity.order == "concurrent"
    own, pairs = (size, size * (size - 1) // 2) if together else (1, size - 1)
    mixed = diversity.mp_envs if method == "comedi" and diversity.lambda_mp > 0.0 else 0
    return own * ppo.envs + pairs * (diversity.xp_envs + mixed)


def _fresh(config: RunConfig) -> int:
    """Episodes by which CoMeDi's last member finds its strongest partner, played at once."""
    return 2 * config.diversity.select_episodes * (config.population.size - 1) if config.method == "comedi" else 0


# ---- disk ------------------------------------------------------------------------------------------------------------


def disk_bytes(config: RunConfig, spec: EnvSpec) -> int:
    """The run's folder: population (twice where MLflow's artefacts are in it), checkpoints, and the margin."""
    size, weights = config.population.size, member_bytes(config, spec)
    copies = 2 if config.tracking.enabled and config.tracking.uri is None else 1
    # With a finished member XPM-WM keeps the buffers, and the world model with its optimiser.
    kept = buffer_bytes(config, spec) + 3 * weights if config.method == "xpm_wm" else weights
    return size * (copies * weights + kept) + _running(config, spec) + MARGIN


def copy_bytes(config: RunConfig, spec: EnvSpec) -> int:
    """The folder's copy in a storage, which for a while holds what only the copy before needs."""
    return disk_bytes(config, spec) + _running(config, spec)


def _running(config: RunConfig, spec: EnvSpec) -> int:
    """Checkpoints of the running member: its weights and the buffers, which XPM-Sim writes whole each time; XPM-WM
    keeps two copies and a log of them, and writes one more."""
    together = config.population.size if config.method == "lipo" else 1
    buffers = {"xpm_wm": 4, "xpm_sim": KEPT}.get(config.method, 0) * buffer_bytes(config, spec)
    return buffers + KEPT * PROGRESS * together * member_bytes(config, spec)


# ---- weights ---------------------------------------------------------------------------------------------------------


def member_bytes(config: RunConfig, spec: EnvSpec) -> int:
    """The weights of the last member: what it acts with, and its critics, of which it has the most."""
    if config.method == "xpm_wm":
        numbers = _world_model(config.world_model, spec) + _agent(config, spec)
    elif config.method == "xpm_sim":
        numbers = _simulated_agent(config, spec)
    else:
        kinds = {"mappo": 0, "lipo": 1, "comedi": 2}[config.method]
        critics = 1 + kinds * (config.population.size - 1)
        view = spec.views.get(config.ppo.view)
        numbers = _feed_forward(view, config.ppo, spec.num_actions) + critics * _feed_forward(view, config.ppo, 1, 2)
    return _FLOAT * numbers


def _world_model(model: WorldModelConfig, spec: EnvSpec) -> int:
    """Numbers of `popgen.methods.xpm_wm.world_model.WorldModel`."""
    view, units, size = spec.views.get(model.view), model.units, model.classes * model.groups
    if view is None:
        return 0
    state, kernels, channels = model.deter + size, model.cnn_kernels, model.cnn_channels
    seen, outputs, convolutions = 2 * view.shape[0], view.shape[0], 0
    if len(view.shape) == 3:
        seen, outputs = channels * view.shape[0] * view.shape[1], 0
        encoder = _convolutions(2 * view.shape[2], channels, kernels) + 2 * _entries(view)
        upwards = _convolutions(max(channels, view.shape[2]), channels, kernels) + _entries(view)
        convolutions = encoder + 2 * ((units + 1) * seen + upwards)
    inputs, step = size + 2 * spec.num_actions, 0
    if model.recurrent_units:
        step, inputs = _mlp(inputs + model.deter, model.recurrent_units, 1), model.recurrent_units
    gates = (inputs + model.deter + 3) * 3 * model.deter
    trunk = _mlp(seen, units, model.encoder_layers)
    posterior = _mlp(model.deter + units, units, model.posterior_layers, size)
    prior = _mlp(model.deter, units, model.prior_layers, size)
    decoders = 2 * _mlp(state, units, model.decoder_layers, outputs)
    heads = sum(_mlp(state, units, model.head_layers, n) for n in (spec.num_events * spec.num_players, 1))
    return convolutions + trunk + step + gates + posterior + prior + decoders + heads


def _agent(config: RunConfig, spec: EnvSpec) -> int:
    """Numbers of the last member's actor and critics on the world model, one critic for each partner."""
    agent, model = config.agent, config.world_model
    inputs = model.deter + model.classes * model.groups + 2
    actor = _mlp(inputs, agent.units, agent.layers, spec.num_actions)
    return actor + config.population.size * _mlp(inputs, agent.units, agent.layers, agent.bins)


def _simulated_agent(config: RunConfig, spec: EnvSpec) -> int:
    sim, size = config.xpm_sim, config.population.size
    seen, encoder = 2 * _entries(spec.views.get("features")), 0
    if sim.encoder == "shared":
        both = ((seen, 2 * sim.latent), (sim.latent, seen))  # and the decoder
        encoder = sum(_mlp(n, sim.encoder_units, sim.encoder_layers, outputs) for n, outputs in both)
    networks = 1 + (size if sim.xp_critic == "separate" else 2)
    return encoder + networks * _mlp(max(seen, sim.latent) + spec.num_players + size, sim.units, sim.layers, 8)


def _feed_forward(view: ViewSpec | None, ppo: PpoConfig, outputs: int, copies: int = 1) -> int:
    """Numbers of `popgen.nets.feed_forward.FeedForwardNet` with a seat, for the joint observation with two copies."""
    if view is None:
        return 0
    inputs, convolutions = _entries(view) * copies, 0
    if ppo.cnn_kernels and len(view.shape) == 3:
        convolutions = _convolutions(view.shape[2] * copies, ppo.cnn_channels, ppo.cnn_kernels)
        inputs = ppo.cnn_channels * view.shape[0] * view.shape[1]
    return convolutions + _mlp(inputs + 2, ppo.units, ppo.layers, outputs)


def _mlp(inputs: int, units: int, layers: int, outputs: int = 0) -> int:
    """Weights, biases and norms of `layers` layers of `units`, and of a linear output."""
    numbers = 0
    for _ in range(layers):
        numbers, inputs = numbers + (inputs + 3) * units, units
    return numbers + (inputs + 1) * outputs


def _convolutions(planes: int, channels: int, kernels: tuple[int, ...]) -> int:
    numbers = 0
    for kernel in kernels:
        numbers, planes = numbers + (planes * kernel**2 + 3) * channels, channels
    return numbers


def _entries(view: ViewSpec | None) -> int:
    """Of one player's observation; 0 for a view that the environment does not have."""
    return 0 if view is None else math.prod(view.shape)


def _state_bytes(spec: EnvSpec) -> int:
    return spec.state_size * np.dtype(spec.state_dtype).itemsize
