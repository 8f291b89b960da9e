"""Families of environments by name: the built-in ones, and those that installed distributions offer.

The part of an environment's name before the slash is its family's. A distribution offers a family as
`popgen.environments` by an entry point of that name in its pyproject.toml (docs/adding.md):

    [project.entry-points."popgen.environments"]
    my_family = "my_package.family:FAMILY"
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint
from numbers import Integral
from typing import Any

from popgen.envs.contract import BatchedEnv
from popgen.errors import UserError
from popgen.extensions import find_entries, load_record

GROUP = "popgen.environments"


@dataclass(frozen=True)
class EnvFamily:
    """Environments of one kind.

    Attributes:
        name: before the slash.
        variants: names after the slash that need no parameters: listed, tested, and options of `env=`.
        environment: `module:class` of a `BatchedEnv`, called as (variant, num_envs, seed=seed, **parameters) and
            imported when one is made.
        is_open: the class takes other variants too, such as a path, and judges them itself.
    """

    name: str
    variants: tuple[str, ...]
    environment: str
    is_open: bool = False

    def load_environment(self) -> Callable[..., BatchedEnv]:
        """The class."""
        module, _, name = self.environment.partition(":")
        return getattr(import_module(module), name)

    def list_names(self) -> list[str]:
        """Whole names of the variants."""
        return [f"{self.name}/{variant}" for variant in self.variants]


BUILT_IN = {
    "overcooked": EnvFamily(
        "overcooked",
        (
            "cramped_room",
            "asymmetric_advantages",
            "coordination_ring",
            "forced_coordination",
            "counter_circuit_o_1order",
        ),
        "popgen.envs.overcooked:OvercookedEnv",
        is_open=True,
    ),
    "rendezvous": EnvFamily("rendezvous", ("mppmr",), "popgen.envs.rendezvous:RendezvousEnv"),
}

_GIVEN = {"self", "layout", "variant", "num_envs", "seed"}
"""Arguments of the environments that `make_env` gives."""


@cache
def _find_offered() -> dict[str, EntryPoint]:
    """Families of other distributions; a built-in name cannot be taken."""
    return find_entries(GROUP, BUILT_IN)


@cache
def _load_family(name: str) -> EnvFamily:
    if name in BUILT_IN:
        return BUILT_IN[name]
    return load_record(_find_offered()[name], EnvFamily, "env.name")


def env_names() -> list[str]:
    """Names that need no further parameters; a family whose package cannot be imported is left out."""
    names: list[str] = []
    for family in (*BUILT_IN, *_find_offered()):
        with suppress(UserError):
            names += _load_family(family).list_names()
    return names


def make_env(name: str, /, num_envs: int = 1, *, seed: int = 0, **params: Any) -> BatchedEnv:
    """Build B environments of a registered family.

    Args:
        name: `family/variant`, see `env_names`; for Overcooked also a layout of overcooked_ai or a file's path.
        num_envs: B.
        seed: of the environment's generator.
        params: of the family, such as `horizon`.

    Raises:
        UserError: unknown family, variant or parameter, a batch size below 1, or a package that cannot be imported.
    """
    kind, _, variant = str(name).partition("/")
    if kind not in BUILT_IN and kind not in _find_offered():
        raise UserError("env.name", f"unknown environment {name!r}", f"choose one of {', '.join(env_names())}")
    family = _load_family(kind)
    if variant not in family.variants and not family.is_open:  # before the parameters, which may be another one's
        raise UserError("env.name", f"unknown environment {name!r}", f"choose {' or '.join(family.list_names())}")
    if isinstance(num_envs, bool) or not isinstance(num_envs, Integral) or num_envs < 1:
        raise UserError("num_envs", f"must be a whole number of at least 1, got {num_envs!r}")
    if reserved := sorted(_GIVEN & params.keys()):
        raise UserError(f"env.params.{reserved[0]}", "is no parameter of an environment", "leave it out")
    try:
        return family.load_environment()(variant, int(num_envs), seed=seed, **params)
    except TypeError as error:
        if "unexpected keyword" not in str(error):
            raise
        raise UserError("env", str(error).partition(") ")[2] or str(error), "see conf/env for the parameters") from None
