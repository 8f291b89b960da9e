"""What must hold before anything starts: checked in a second or two, without Ray or MLflow."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec
from popgen.envs.env_registry import make_env
from popgen.errors import UserError
from popgen.methods.method import Continuation, Method, Needs
from popgen.methods.registry import METHODS
from popgen.runs import sizes
from popgen.runs.chart_trackers import check_writer
from popgen.runs.ray_folder import check_ray_folder
from popgen.runs.resources import MOST_ON_A_CORE, count_cores, demands, total
from popgen.runs.tracking_address import check_uri

RAYS_SHARE = 0.3
"""Of the memory, for the object store where no size is given."""

CGROUPS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
"""Where a container's limit is told (cgroups 2 and 1)."""

MOST_EPISODES = 1_000_000
"""Of an evaluation."""

_RUN_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


def preflight(config: RunConfig) -> EnvSpec:
    """Refuse a run that cannot go well; what is known of its environment.

    Raises:
        UserError: an environment that cannot be built or pays nothing for events, a view it does not have, windows or
            buffers of a size that does not fit it, a population to start from that is not of this environment, an
            unsafe run id, a root or storage that cannot be written to or would not stay, or too little disk or memory.
    """
    spec = _build(config)
    check_run_id(config.run.id)
    check_cluster(config)
    if config.cluster.address is None and config.run.transport == "ray":
        check_ray_folder()
    method = METHODS[config.method]
    method.check(config, spec)
    if config.tracking.enabled:
        check_uri(config.tracking.uri)
        check_writer(config.tracking)
    if config.population.init_from is not None:
        _check_start(config, spec, method)
    needs = method.needs(config, spec)
    check_memory(config, needs)
    check_store(config, needs)
    check_evaluation(config)
    check_kept(Path(config.run.root))
    check_root(Path(config.run.root), sizes.disk_bytes(config, needs))
    if config.run.storage is not None:
        check_storage(config, needs)
    return spec


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


def check_storage(config: RunConfig, needs: Needs) -> None:
    """A storage that can be opened and, where it is a folder of this machine, written to, with room for the copy."""
    from popgen.runs.storage import local_folder, open_storage

    uri = str(config.run.storage)
    if not re.match(r"[A-Za-z][A-Za-z0-9+.-]*://.", uri):
        raise UserError("run.storage", f"{uri!r} is no URI", "give one such as s3://bucket/path or file:///path")
    folder = local_folder(*open_storage(uri))
    if folder is None:
        return
    needed, root = sizes.copy_bytes(config, needs), Path(config.run.root)
    if _device(folder) == _device(root):
        needed += sizes.disk_bytes(config, needs)
    check_root(folder, needed, "run.storage")


def check_run_id(name: str | None) -> None:
    """A run's id is a folder's name: letters, digits, dot, dash and underscore."""
    if name is not None and not _RUN_ID.fullmatch(name):
        problem = f"{name!r} is no safe folder name"
        raise UserError(
            "run.id", problem, "use up to 100 letters, digits, '.', '-' and '_', beginning with a letter or digit"
        )


def check_memory(config: RunConfig, needs: Needs) -> None:
    """Buffers, object store and a batch must fit into this machine's memory. A cluster's nodes are not looked at, but
    some methods learn in the driver's process."""
    if config.cluster.address is not None and not needs.in_driver:
        return
    needed, have = sizes.memory_needed(config, needs), memory_bytes()
    if needed <= have:
        return
    parts = {
        needs.buffers_field: 4 * needs.buffers,
        needs.batch_field: needs.batch,
        "cluster.object_store_bytes": config.cluster.object_store_bytes or 0,
    }
    field = max(parts, key=lambda name: parts[name])
    what = f"buffers of {_gib(needs.buffers)} and batches of {_gib(needs.batch)}"
    problem = f"{what}, with their copies and the object store, need about {_gib(needed)}, this machine has"
    raise UserError(field, f"{problem} {_gib(have)}", "lower it")


def check_store(config: RunConfig, needs: Needs) -> None:
    """The object store, of the given size or Ray's own choice here, must hold what is in it at a time."""
    if not needs.buffers:
        return
    size, needed = config.cluster.object_store_bytes, sizes.store_bytes(needs)
    if size is not None and size < needed:
        problem = f"{size:,} bytes, but {needed:,} may be in it at a time"
        raise UserError("cluster.object_store_bytes", problem, f"raise it or lower {needs.buffers_field}")
    chosen = int(RAYS_SHARE * memory_bytes())
    if size is None and config.cluster.address is None and chosen < needed:
        problem = f"Ray's own choice is {_gib(chosen)}, but {_gib(needed)} may be in it at a time"
        raise UserError("cluster.object_store_bytes", problem, f"set it, or lower {needs.buffers_field}")


def check_cluster(config: RunConfig) -> None:
    """A local Ray must have what the actors ask for, or they wait for ever; a running cluster is asked itself later."""
    cluster = config.cluster
    if cluster.address is not None:
        return
    cores = cluster.num_cpus or count_cores()
    for demand in demands(config):
        if demand.count > MOST_ON_A_CORE * cores:
            number = "ppo.runners" if hasattr(config, "ppo") else "cluster.samplers"
            setting = number if demand.field == "cluster.sampler_cpus" else demand.field
            problem = f"{demand.count} processes on {cores} core{'s' * (cores > 1)} would wait for each other"
            fix = f"ask for at most {MOST_ON_A_CORE * cores}, or set cluster.num_cpus to what the machine can bear"
            raise UserError(setting, problem, fix)
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
        is_param = name in config.env.params or name == "grid"
        field = f"env.params.{name}" if is_param else "env.name" if name == "layout" else error.field
        raise UserError(field, error.problem, error.fix) from None


def _check_start(config: RunConfig, spec: EnvSpec, method: Method) -> None:
    """A population to continue must be there, of this environment and method, with a checkpoint, and smaller."""
    if method.continuation is None:
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
    if run.resolve().name == config.run.id:
        problem = f"is {config.run.id}, as that of the run it continues, whose samplers have the same names then"
        raise UserError("run.id", problem, "choose another")
    if wanted >= config.population.size:
        problem = f"{config.population.size} leaves nothing to train after {wanted} members of {run}"
        raise UserError("population.size", problem, "raise it above population.init_members")
    first = population.info(1)
    if first.kind != method.continuation.kind:
        raise UserError(
            "population.init_from", f"{run} has members of kind {first.kind}", "choose a run of this method"
        )
    _check_shapes(config, run, method.continuation)
    if not (run / "checkpoints" / f"member_{wanted:03d}").is_dir():
        problem = f"{run} has no checkpoint of member {wanted}"
        raise UserError("population.init_members", problem, "choose a member that has one")


def _check_shapes(config: RunConfig, run: Path, continuation: Continuation) -> None:
    """The origin's networks must have our sizes; its config.json may be of another version in all else, and what it
    does not name was then as the schema's default is."""
    path = run / "config.json"
    try:
        origin = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        problem = f"cannot read {path} ({getattr(error, 'strerror', None) or 'it is no JSON'})"
        raise UserError("population.init_from", problem, "give a run's folder") from None
    ours = config.as_dict()
    for section, names in continuation.shapes.items():
        part = origin.get(section) if isinstance(origin, dict) else None
        if not isinstance(part, dict):
            raise UserError("population.init_from", f"{path} has no {section!r}", "give a run's folder")
        defaults = type(getattr(config, section))().model_dump(mode="json")
        for name in names:
            there, here = part.get(name, defaults[name]), ours[section][name]
            if there != here:
                raise UserError(f"{section}.{name}", f"is {here!r}, but {there!r} in {run}", "use the same sizes")
    section, name = continuation.capacity
    replay = origin.get(section)
    held = replay.get(name) if isinstance(replay, dict) else None
    if isinstance(held, int) and ours[section][name] < held:
        problem = f"is {ours[section][name]:,}, but the buffers of {run} may hold {held:,} steps"
        raise UserError(f"{section}.{name}", problem, "raise it")


def _gib(size: int) -> str:
    return f"{size / 2**30:.1f} GiB"
