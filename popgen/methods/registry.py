"""Methods by name: the built-in packages, and those that installed distributions offer as `popgen.methods`.

A distribution offers a method by an entry point in its pyproject.toml (docs/adding.md):

    [project.entry-points."popgen.methods"]
    my_method = "my_package.method:METHOD"
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint
from typing import Any

from popgen.config.run_config import RunConfig, field_names
from popgen.errors import UserError
from popgen.extensions import find_entries, load_record
from popgen.methods.method import Method
from popgen.methods.recipe import Settings

GROUP = "popgen.methods"

BUILT_IN: dict[str, str] = {
    "xpm_wm": "popgen.methods.xpm_wm.method:METHOD",
    "fcp_wm": "popgen.methods.xpm_wm.method:FCP_WM",
    "mep_wm": "popgen.methods.xpm_wm.method:MEP_WM",
    "xpm_sim": "popgen.methods.xpm_sim.method:METHOD",
    "lipo": "popgen.methods.mappo.method:LIPO",
    "comedi": "popgen.methods.mappo.method:COMEDI",
    "mappo": "popgen.methods.mappo.method:MAPPO",
    # The population; an ego agent that is trained with one has another name here, ego_fcp.
    "fcp": "popgen.methods.mappo.method:FCP",
    "mep": "popgen.methods.mappo.method:MEP",
    "trajedi": "popgen.methods.mappo.method:TRAJEDI",
    "hsp": "popgen.methods.mappo.method:HSP",
    "bp": "popgen.methods.mappo.method:BP",
    "brdiv": "popgen.methods.mappo.method:BRDIV",
    "e3t": "popgen.methods.mappo.method:E3T",
    "hipt": "popgen.methods.ego.method:HIPT",
    "ego_fcp": "popgen.methods.ego.method:FCP",
    "br": "popgen.methods.ego.method:BR",
    "sp": "popgen.methods.ego.method:SP",
    "sp_aug": "popgen.methods.ego.method:SP_AUG",
}
"""name -> `module:record`, imported when first needed."""

DEFAULT = "xpm_wm"
"""The method of a configuration that names none."""

DEFAULT_EGO = "hipt"
"""The method of an ego agent that names none."""

DEFAULT_RECIPE = "laptop"


@cache
def _find_offered() -> dict[str, EntryPoint]:
    """Methods of other distributions; a built-in name cannot be taken."""
    return find_entries(GROUP, BUILT_IN)


@cache
def _load_method(name: str) -> Method:
    if name in BUILT_IN:
        module, _, record = BUILT_IN[name].partition(":")
        return getattr(import_module(module), record)
    return load_record(_find_offered()[name], Method, "method")


class Methods(Mapping[str, Method]):
    """All methods; a record is imported when it is asked for."""

    def __getitem__(self, name: str) -> Method:
        if name not in self:
            raise KeyError(name)
        return _load_method(name)

    def __contains__(self, name: object) -> bool:
        return name in BUILT_IN or name in _find_offered()

    def __iter__(self) -> Iterator[str]:
        yield from BUILT_IN
        yield from _find_offered()

    def __len__(self) -> int:
        return len(BUILT_IN) + len(_find_offered())


METHODS = Methods()


def find_method(name: object) -> Method:
    """The method that a configuration names.

    Raises:
        UserError: there is no such method.
    """
    if name in METHODS:
        return METHODS[str(name)]
    close = difflib.get_close_matches(str(name), METHODS, n=1)
    fix = f"did you mean {close[0]}?" if close else f"choose one of {', '.join(METHODS)}"
    raise UserError("method", f"there is no method {name!r}", fix)


def list_objectives() -> list[str]:
    """`method:objective` of every row that a table of self-sabotage can have, self-play first."""
    labels = [f"{name}:{objective}" for name, method in list_working() for objective in method.objectives]
    return sorted(labels, key=lambda label: not label.endswith(":self-play"))


def find_objective(row: str) -> Settings:
    """What a row, `method` or `method:objective`, has on top of a recipe: nothing for a method alone.

    Raises:
        UserError: no such method, or it has no such objective.
    """
    name, _, objective = row.partition(":")
    known = find_method(name).objectives
    if objective and objective not in known:
        fix = f"choose one of {', '.join(known)}" if known else f"give {name} alone"
        raise UserError("method", f"{name} has no objective {objective!r}", fix)
    return known[objective] if objective else {}


def methods_with(key: str) -> list[str]:
    """Names of the methods whose schema has a dotted field."""
    return [name for name, method in list_working() if key in field_names(method.config)]


def policy_kinds() -> dict[str, str]:
    """Kinds of the policies that methods save -> `module:class`."""
    return {kind: place for _, method in list_working() for kind, place in method.policies.items()}


def list_working() -> list[tuple[str, Method]]:
    """Names and methods, without those whose package cannot be imported: who asks for another does not need it."""
    found = []
    for name in METHODS:
        with suppress(UserError):
            found.append((name, METHODS[name]))
    return found


def recipe(method: str, env: str = "overcooked/cramped_room", scale: str = DEFAULT_RECIPE) -> RunConfig:
    """The complete configuration of a recipe on a layout: what the command line would start with.

    Raises:
        UserError: no such method or recipe, or an environment's name without its family.
    """
    found = find_method(method)
    if "/" not in env:
        raise UserError("env", f"{env!r} names no environment", f"name its family too, such as overcooked/{env}")
    if scale not in found.recipes:
        raise UserError("scale", f"{method} has no recipe {scale!r}", f"choose one of {', '.join(found.recipes)}")
    values: dict[str, Any] = found.recipes[scale].values(env)
    env_values = {**values.pop("env", {}), "name": env}
    return RunConfig.parse({**values, "method": method, "scale": scale, "env": env_values})
