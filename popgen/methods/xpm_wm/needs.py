"""What an XPM-WM run needs, and what cannot work: actors, bytes, checks."""

from __future__ import annotations

from popgen.envs.contract import EnvSpec
from popgen.errors import UserError
from popgen.methods.byte_counts import FLOAT, buffer_bytes, count_numbers, observation_entries, segment_bytes
from popgen.methods.method import ActorDemand, Needs, ask_for
from popgen.methods.xpm_wm.config import OPEN_LOOP, PREFILL_CHUNK, FcpWmRun, WorldModelRun
from popgen.types import SKILLS


def list_actors(config: WorldModelRun) -> list[ActorDemand]:
    """Samplers, two replays and two learners."""
    cluster = config.cluster
    return [
        ask_for(config, "sampler_cpus", cluster.samplers),
        ask_for(config, "replay_cpus", 2),
        ask_for(config, "model_cpus", 1, cluster.model_gpus),
        ask_for(config, "agent_cpus", 1, cluster.agent_gpus),
    ]


def estimate_needs(config: WorldModelRun, spec: EnvSpec) -> Needs:
    """Bytes. A finished member leaves the buffers behind, and the world model with its optimiser; the running one's
    checkpoints hold two copies and a log of the buffers, and one more is being written."""
    model, agent = config.world_model, config.agent
    member = FLOAT * _count_member(config, spec) if model.view in spec.views else 0
    buffers = 2 * buffer_bytes(config.replay.capacity, spec)
    windows = model.batch * model.length * spec.num_players * observation_entries(spec, model.view)
    latents = (agent.starts_sp + agent.starts_xp) * agent.horizon * (model.deter + model.classes * model.groups)
    rows = config.phase1.envs * max(PREFILL_CHUNK, config.phase1.steps_per_iteration)
    return Needs(
        member=member,
        batch=FLOAT * max(windows, latents),
        batch_field="agent.horizon",
        buffers=buffers,
        buffers_field="replay.capacity",
        in_flight=2 * segment_bytes(rows, spec),
        left=buffers + 3 * member,
        buffer_copies=4,
    )


def _count_member(config: WorldModelRun, spec: EnvSpec) -> int:
    """Numbers in world model, actor, and a critic for each partner of the last member."""
    from popgen.methods.xpm_wm.actor_critic import Actor, Critic
    from popgen.methods.xpm_wm.world_model import WorldModel

    model, agent = config.world_model, config.agent
    once = count_numbers(lambda: [WorldModel(model, spec), Actor(agent, model, spec.num_actions)])
    return once + config.population.size * count_numbers(lambda: [Critic(agent, model)])


def check_run(config: WorldModelRun, spec: EnvSpec) -> None:
    """Refuse what does not fit the environment.

    Raises:
        UserError: a view it does not have, no events that pay, windows or rounds too long for it.
    """
    _check_view(config, spec)
    if not any(spec.event_weights):  # the imagined reward is made of events alone
        problem = f"{config.method} needs an environment with weighted events, {spec.name} has none"
        raise UserError("env.name", problem, "choose another environment")
    _check_lengths(config, spec)
    _check_discovery(config, spec)


def check_fcp(config: FcpWmRun, spec: EnvSpec) -> None:
    """The same, and whole seeds after member 1.

    Raises:
        UserError: what `check_run` refuses, or members, new ones or those taken over, that are no whole seeds.
    """
    check_run(config, spec)
    population, each = config.population, len(SKILLS)
    sizes = {"size": population.size} | ({"init_members": population.init_members} if population.init_from else {})
    for name, size in sizes.items():
        if left := (size - 1) % each:
            problem = f"{size} is not 1 and a multiple of {each}: each seed after member 1 gives an initial, a half"
            fix = f"set it to {size + each - left}"
            raise UserError(f"population.{name}", f"{problem} trained and a final member", fix)


def _check_view(config: WorldModelRun, spec: EnvSpec) -> None:
    view = config.world_model.view
    if view not in spec.views:
        raise UserError(
            "world_model.view", f"{spec.name} has no view {view!r}", f"choose one of {', '.join(spec.views)}"
        )


def _check_lengths(config: WorldModelRun, spec: EnvSpec) -> None:
    window, phase, size = config.world_model.length + OPEN_LOOP, config.phase2, config.population.size
    if window > spec.horizon:
        problem = f"windows of {window} steps ({OPEN_LOOP} of them open loop) do not fit an episode of {spec.name}"
        raise UserError("world_model.length", f"{problem} ({spec.horizon})", "shorten them")
    episodes_xp = phase.cross_play_episodes(size - 1)
    added = max(phase.episodes_sp, episodes_xp) * (spec.horizon + 1)
    if config.replay.capacity < added:
        problem = f"cannot hold the {added:,} steps that phase2 adds at once"
        raise UserError("replay.capacity", problem, "raise it or lower phase2.episodes_sp and episodes_xp")
    one = (phase.episodes_sp + episodes_xp) * spec.horizon
    if size > 1 and phase.max_steps is not None and phase.max_steps < one:
        problem = f"is less than the {one:,} steps that a round of member {size} takes"
        raise UserError("phase2.max_steps", problem, "raise it or lower phase2.episodes_sp and episodes_xp")


def _check_discovery(config: WorldModelRun, spec: EnvSpec) -> None:
    view = spec.views[config.world_model.view]
    if config.discovery.count_bonus and not (view.own and view.binary):
        problem = f"view {config.world_model.view!r} of {spec.name} does not tell a player's own state apart"
        raise UserError("discovery.count_bonus", problem, "set it to 0 or choose another view")
    scaffolds = config.discovery.scaffolds
    named = {"event_factors": [*config.discovery.event_factors], "scaffolds": [*scaffolds, *scaffolds.values()]}
    for field, name in ((field, name) for field, names in named.items() for name in names):
        if name not in spec.event_names:
            problem = f"{spec.name} has no event {name!r}"
            raise UserError(f"discovery.{field}", problem, f"choose among {', '.join(spec.event_names)}")
    if scaffolds and not config.discovery.trust:
        raise UserError("discovery.scaffolds", "need the events' real rates", "set discovery.trust above 0, such as 2")
