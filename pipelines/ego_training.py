"""From populations to an ego: partners are pinned by digest, then the ego is trained like any population of one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from popgen.actors.ego_workers import load_partners, read_partner
from popgen.config.run_config import RunConfig
from popgen.envs.env_registry import make_env
from popgen.errors import UserError
from popgen.methods.ego.config import EgoRun
from popgen.methods.registry import METHODS, recipe
from popgen.pipelines.population import run_population
from popgen.population.manifest import EnvironmentInfo
from popgen.progress import Reporter, make_reporter
from popgen.runs.preflight import preflight


def ego_methods() -> list[str]:
    """Names of the methods that train egos."""
    return [name for name, method in METHODS.items() if issubclass(method.config, EgoRun)]


def find_ego_method(name: str) -> str:
    """The method of the registry that a name means here: `fcp` is the ego of FCP, not the population.

    Raises:
        UserError: no ego is trained by it.
    """
    known = ego_methods()
    found = next((one for one in (f"ego_{name}", name) if one in known), None)
    if found is None:
        shown = ", ".join(one.removeprefix("ego_") for one in known)
        raise UserError("method", f"{name} trains no ego", f"choose one of {shown}")
    return found


def refuse_derived(ego: Mapping[str, Any]) -> None:
    """Make sure that settings of an ego leave out what follows from the populations that are named.

    Raises:
        UserError: they name partners, or pin them.
    """
    for name in ("partners", "pinned"):
        if ego.get(name):
            fix = "leave it out, and name them as words of their own: PATH or PATH:1,3"
            raise UserError(f"ego.{name}", "follows from the populations that are named", fix)


def environment_of(partners: Sequence[str]) -> EnvironmentInfo:
    """The environment of the first population.

    Raises:
        UserError: it is no population.
    """
    return read_partner(partners[0]).population.env_info


def make_ego_config(
    method: str, partners: Sequence[str] = (), settings: Mapping[str, Any] | None = None, *, scale: str = "laptop"
) -> EgoRun:
    """A run of an ego from Python, as `popgen ego train` would start it.

    Args:
        method: `hipt`, `fcp`, `br`, `sp` or `sp_aug`.
        partners: populations, PATH or PATH:1,3; none in self-play.
        settings: dotted field -> value, on top of the recipe: `{"run.seed": 1, "ego.steps": 500_000}`. In self-play
            `env.name` says where.
        scale: the recipe.

    Raises:
        UserError: a method that trains no ego, a setting that does not exist or follows from `partners`, partners that
            do not fit.
    """
    method, settings = find_ego_method(method), dict(settings or {})
    refuse_derived({key.removeprefix("ego."): value for key, value in settings.items() if key.startswith("ego.")})
    name = settings.get("env.name", "overcooked/cramped_room")
    if partners:
        info = environment_of(partners)
        name = info.name
        settings |= {"env.name": name, "env.params": info.params}
    values = recipe(method, name, scale).as_dict()
    for key, value in {**settings, "ego.partners": list(partners)}.items():
        section = values
        *sections, last = key.split(".")
        for part in sections:
            section = section.setdefault(part, {})
            if not isinstance(section, dict):
                raise UserError(key, f"does not exist: {part} holds no settings", "see popgen config METHOD")
        section[last] = value
    return pin_partners(RunConfig.parse(values))


def pin_partners(config: RunConfig) -> EgoRun:
    """The run with the digests of its partners' populations, which must be of its environment.

    Raises:
        UserError: no run of an ego, or a population that is missing or of another environment.
    """
    if not isinstance(config, EgoRun):
        raise UserError("method", f"{config.method} trains no ego", "see popgen ego train --help")
    unpinned = config.model_copy(update={"ego": config.ego.model_copy(update={"pinned": ()})})
    named = load_partners(unpinned, make_env(config.env.name, 1, **config.env.params).spec)
    pinned = tuple(one.digest for one in named)
    return config.model_copy(update={"ego": config.ego.model_copy(update={"pinned": pinned})})


def train_ego(config: EgoRun, reporter: Reporter | None = None) -> dict[str, Any]:
    """Check a run and train its ego; resumes a run that was interrupted.

    Args:
        config: of `make_ego_config` or the command line.
        reporter: told of progress; none for silence.

    Returns:
        See `popgen.pipelines.population.run_population`; `population` is the path of the ego.

    Raises:
        UserError: what cannot work.
    """
    preflight(config)
    return run_population(config, reporter=make_reporter(quiet=True) if reporter is None else reporter)
