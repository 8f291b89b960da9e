"""What must hold before anything starts: checked in a second or two, without Ray, torch or MLflow."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from popgen.config.run_config import SECTIONS, RunConfig
from popgen.envs.contract import EnvSpec
from popgen.envs.env_registry import make_env
from popgen.errors import UserError
from popgen.methods.xpm_wm.config import OPEN_LOOP, SHAPES
from popgen.runs import sizes
from popgen.runs.mlflow_tracker import check_uri
from popgen.runs.resources import demands, total

RAYS_SHARE = 0.3
"""Of the memory, for the object store where no size is given."""

CGROUPS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
"""Where a container's limit is told (cgroups 2 and 1)."""

MOST_EPISODES = 1_000_000
"""Of an evaluation."""

_CAPACITY = {"xpm_wm": "replay.capacity", "xpm_sim": "xpm_sim.capacity"}
_BATCH = {"xpm_wm": "agent.horizon", "xpm_sim": "xpm_sim.unroll"}

_RUN_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


def preflight(config: RunConfig) -> None:
    """Refuse a run that cannot go well.

    Raises:
        UserError: an environment that cannot be built or pays nothing for events, a view it does not have, windows or
            buffers of a size that does not fit it, a population to start from that is not of this environment, an
            unsafe run id, a root or storage that cannot be written to or would not stay, or too little disk or memory.
    """
    spec = _build(config)
    check_run_id(config.run.id)
    check_cluster(config)
    if config.method == "xpm_wm":
        _check_view(config, spec)
        _check_rewards(config, spec)
        _check_lengths(config, spec)
    if "ppo" in SECTIONS[config.method]:
        check_baseline(config, spec)
    if config.method == "xpm_sim":
        _check_simulation(config, spec)
    if config.tracking.enabled:
        check_uri(config.tracking.uri)
    if config.population.init_from is not None:
        _check_start(config, spec)
    check_memory(config, spec)
    if config.method in _CAPACITY:
        check_store(config, spec)
    check_evaluation(config)
    check_kept(Path(config.run.root))
    check_root(Path(config.run.root), sizes.disk_bytes(config, spec))
    if config.run.storage is not None:
        check_storage(config, spec)


def check_baseline(config: RunConfig, spec: EnvSpec) -> None:
    """What RLlib's MAPPO needs: the view and CoMeDi's order."""
    ppo = config.ppo
    if ppo.view not in spec.views:
        raise UserError("ppo.view", f"{spec.name} has no view {ppo.view!r}", f"choose one of {', '.join(spec.views)}")
    if config.method == "comedi" and config.diversity.order != "sequential":
        raise UserError("diversity.order", "CoMeDi trains one member after the other", "set it to sequential")


def check_evaluation(config: RunConfig) -> None:
    """The final evaluation plays every ordered pair, and holds the figures of all its episodes."""
    episodes = config.population.size**2 * config.evaluation.episodes
    if episodes > MOST_EPISODES:
        problem = (
            f"{config.evaluation.episodes:,} for each of {config.population.size**2:,} pairs is {episodes:,} episodes"
        )
        raise UserError("evaluation.episodes", problem, f"keep them to {MOST_EPISODES:,} in all")


def check_kept(root: Path) -> None:
    """A run in the working directory that `ray job submit` uploads would be deleted with it, when the job has ended."""
    if any(part.startswith("_ray_pkg_") for part in root.absolute().parts):
        problem = f"{root} lies in the job's working directory, which Ray deletes"
        raise UserError("run.root", problem, "give an absolute path on storage that stays, shared by all nodes")


def check_storage(config: RunConfig, spec: EnvSpec) -> None:
    """A storage that can be opened and, where it is a folder of this machine, written to, with room for the copy."""
    from popgen.runs.storage import local_folder, open_storage

    uri = str(config.run.storage)
    if not re.match(r"[A-Za-z][A-Za-z0-9+.-]*://.", uri):
        raise UserError("run.storage", f"{uri!r} is no URI", "give one such as s3://bucket/path or file:///path")
    folder = local_folder(*open_storage(uri))
    if folder is None:
        return
    needed, root = sizes.copy_bytes(config, spec), Path(config.run.root)
    if _device(folder) == _device(root):
        needed += sizes.disk_bytes(config, spec)
    check_root(folder, needed, "run.storage")


def check_run_id(name: str | None) -> None:
    """A run's id is a folder's name: letters, digits, dot, dash and underscore."""
    if name is not None and not _RUN_ID.fullmatch(name):
        problem = f"{name!r} is no safe folder name"
        raise UserError(
            "run.id", problem, "use up to 100 letters, digits, '.', '-' and '_', beginning with a letter or digit"
        )


def check_memory(config: RunConfig, spec: EnvSpec) -> None:
    """Buffers, object store and a batch must fit into this machine's memory; a cluster's nodes are not looked at, but
    the baselines learn in the driver's process."""
    if config.cluster.address is not None and "ppo" not in SECTIONS[config.method]:
        return
    needed, have = sizes.memory_needed(config, spec), memory_bytes()
    if needed <= have:
        return
    batch, store = sizes.batch_bytes(config, spec), config.cluster.object_store_bytes or 0
    parts = {
        _CAPACITY.get(config.method, ""): 4 * sizes.buffer_bytes(config, spec),
        _BATCH.get(config.method, "ppo.envs"): batch,
        "cluster.object_store_bytes": store,
    }
    field = max(parts, key=lambda name: parts[name])
    told = f"buffers of {_gib(sizes.buffer_bytes(config, spec))} and batches of {_gib(batch)}"
    problem = f"{told}, with their copies and the object store, need about {_gib(needed)}, this machine has"
    raise UserError(field, f"{problem} {_gib(have)}", "lower it")


def check_store(config: RunConfig, spec: EnvSpec) -> None:
    """The object store, given or Ray's own choice here, must hold what is in it at a time."""
    given, needed = config.cluster.object_store_bytes, sizes.store_bytes(config, spec)
    if given is not None and given < needed:
        problem = f"{given:,} bytes, but {needed:,} may be in it at a time"
        raise UserError("cluster.object_store_bytes", problem, f"raise it or lower {_CAPACITY[config.method]}")
    chosen = int(RAYS_SHARE * memory_bytes())
    if given is None and config.cluster.address is None and chosen < needed:
        problem = f"Ray's own choice is {_gib(chosen)}, but {_gib(needed)} may be in it at a time"
        raise UserError("cluster.object_store_bytes", problem, f"set it, or lower {_CAPACITY[config.method]}")


def check_cluster(config: RunConfig) -> None:
    """A local Ray must have what the actors ask for, or they wait for ever; a running cluster is asked itself later."""
    cluster = config.cluster
    if cluster.address is not None:
        return
    needed = total(demands(config))
    cpus, have = needed.pop("CPU", 0.0), cluster.num_cpus
    if have is not None and have < cpus:
        raise UserError("cluster.num_cpus", f"{have}, but the actors ask for {cpus:g}", "raise it or ask for less")
    gpus, found = needed.pop("GPU", 0.0), len(list(Path("/dev").glob("nvidia[0-9]*")))
    if gpus > found:
        problem = f"the learners ask for {gpus:g} GPUs, this machine has {found}"
        raise UserError("cluster.model_gpus", problem, "set cluster.model_gpus and cluster.agent_gpus to 0")
    if needed:
        problem = "is a resource that a local Ray does not have"
        raise UserError(f"cluster.resources.{min(needed)}", problem, "leave it out or give cluster.address")


def check_root(root: Path, needed: int, field: str = "run.root") -> None:
    """A folder to write to must be writable, or be made in one that is, with room for `needed` bytes."""
    fix = "choose another folder"
    try:
        there = _nearest(root)
        with tempfile.NamedTemporaryFile(dir=there, prefix=".popgen-"):
            pass
        free = shutil.disk_usage(there).free
    except OSError as error:
        raise UserError(field, f"cannot write to {root} ({error.strerror or error})", fix) from None
    if free < needed:
        problem = f"{root} has {_gib(free)} free, {_gib(needed)} may be needed"
        raise UserError(field, problem, "free some space or choose another folder")


def memory_bytes(limits: Sequence[str] = CGROUPS) -> int:
    """Memory of this machine, or of the container that this process is in, if that is less."""
    have = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for path in limits:
        try:
            have = min(have, int(Path(path).read_text()))
        except (OSError, ValueError):  # no such limit: the file is not there, or says "max"
            continue
    return have


def _device(path: Path) -> int:
    """The file system that a path is on, or will be."""
    return _nearest(path).stat().st_dev


def _nearest(path: Path) -> Path:
    """The path, or the folder above it that is there."""
    return next(folder for folder in (path, *path.absolute().parents) if folder.exists())


def _build(config: RunConfig) -> EnvSpec:
    try:
        return make_env(config.env.name, 1, seed=config.run.seed, **config.env.params).spec
    except UserError as error:
        unknown = re.search(r"unexpected keyword argument '(\w+)'", error.problem)
        if unknown:
            problem = f"{config.env.name} has no such parameter"
            fix = "leave it out, or choose the environment by its group, env=NAME, which gives what it needs"
            raise UserError(f"env.params.{unknown[1]}", problem, fix) from None
        name = error.field.removeprefix("env.")
        field = f"env.params.{name}" if name in config.env.params else "env.name" if name == "layout" else error.field
        raise UserError(field, error.problem, error.fix) from None


def _check_view(config: RunConfig, spec: EnvSpec) -> None:
    view = config.world_model.view
    if view not in spec.views:
        raise UserError(
            "world_model.view", f"{spec.name} has no view {view!r}", f"choose one of {', '.join(spec.views)}"
        )


def _check_rewards(config: RunConfig, spec: EnvSpec) -> None:
    """The imagined reward is made of events alone."""
    if not any(spec.event_weights):
        problem = f"{config.method} needs an environment with weighted events, {spec.name} has none"
        raise UserError("env.name", problem, "choose another environment")


def _check_lengths(config: RunConfig, spec: EnvSpec) -> None:
    window, phase = config.world_model.length + OPEN_LOOP, config.phase2
    if window > spec.horizon:
        problem = f"windows of {window} steps ({OPEN_LOOP} of them open loop) do not fit an episode of {spec.name}"
        raise UserError("world_model.length", f"{problem} ({spec.horizon})", "shorten them")
    added = max(phase.episodes_sp, phase.episodes_xp) * (spec.horizon + 1)
    if config.replay.capacity < added:
        problem = f"cannot hold the {added:,} steps that phase2 adds at once"
        raise UserError("replay.capacity", problem, "raise it or lower phase2.episodes_sp and episodes_xp")


def _check_simulation(config: RunConfig, spec: EnvSpec) -> None:
    """A round's real episodes must fit the buffers; where episodes end early each step can add a second row."""
    given = config.xpm_sim
    added = 2 * max(given.episodes_sp, given.episodes_xp) * spec.horizon
    if given.capacity < added:
        problem = f"may not hold the {added:,} rows that a round of real episodes adds"
        raise UserError("xpm_sim.capacity", problem, "raise it or lower xpm_sim.episodes_sp and episodes_xp")


def _check_start(config: RunConfig, spec: EnvSpec) -> None:
    if config.method != "xpm_wm":
        raise UserError("population.init_from", f"{config.method} has no use for it", "leave it out")
    from popgen.population import check_compatible, load_population

    run, wanted = Path(str(config.population.init_from)), config.population.init_members
    try:
        population = load_population(run / "population")
    except UserError as error:
        raise UserError("population.init_from", f"{error.field} {error.problem}", "give a run's folder") from None
    check_compatible(population, spec)
    if wanted > len(population):
        raise UserError("population.init_members", f"{wanted}, but {run} has {len(population)}", "lower it")
    if wanted >= config.population.size:
        problem = f"{config.population.size} leaves nothing to train after {wanted} members of {run}"
        raise UserError("population.size", problem, "raise it above population.init_members")
    first = population.info(1)
    if first.kind != "world_model":
        raise UserError(
            "population.init_from", f"{run} has members of kind {first.kind}", "choose a run of this method"
        )
    _check_sizes(config, run)
    if not (run / "checkpoints" / f"member_{wanted:03d}").is_dir():
        problem = f"{run} has no checkpoint of member {wanted}"
        raise UserError("population.init_members", problem, "choose a member that has one")


def _check_sizes(config: RunConfig, run: Path) -> None:
    """The origin's networks must have our sizes; its config.json may be of another version in all else."""
    path = run / "config.json"
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        problem = f"cannot read {path} ({getattr(error, 'strerror', None) or 'it is no JSON'})"
        raise UserError("population.init_from", problem, "give a run's folder") from None
    ours = config.model_dump(mode="json")
    for section, names in SHAPES.items():
        part = known.get(section) if isinstance(known, dict) else None
        if not isinstance(part, dict):
            raise UserError("population.init_from", f"{path} has no {section!r}", "give a run's folder")
        for name in names:
            there, here = part.get(name), ours[section][name]
            if there != here:
                raise UserError(f"{section}.{name}", f"is {here!r}, but {there!r} in {run}", "use the same sizes")
    replay = known.get("replay")
    held = replay.get("capacity") if isinstance(replay, dict) else None
    if isinstance(held, int) and config.replay.capacity < held:
        problem = f"is {config.replay.capacity:,}, but the buffers of {run} may hold {held:,} steps"
        raise UserError("replay.capacity", problem, "raise it")


def _gib(size: int) -> str:
    return f"{size / 2**30:.1f} GiB"
