"""Registry of environment families: the part of the name before the slash picks the family."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from popgen.envs.contract import BatchedEnv
from popgen.errors import UserError


def _overcooked(variant: str, num_envs: int, seed: int, params: dict[str, Any]) -> BatchedEnv:
    from popgen.envs.overcooked import OvercookedEnv

    return OvercookedEnv(variant, num_envs, seed=seed, **params)


def _rendezvous(variant: str, num_envs: int, seed: int, params: dict[str, Any]) -> BatchedEnv:
    from popgen.envs.rendezvous import RendezvousEnv

    if variant != "mppmr":  # before the parameters, which may be another environment's
        raise UserError("env.name", f"unknown environment 'rendezvous/{variant}'", "choose rendezvous/mppmr")
    return RendezvousEnv(variant, num_envs, seed=seed, **params)


FAMILIES: dict[str, Callable[[str, int, int, dict[str, Any]], BatchedEnv]] = {
    "overcooked": _overcooked,
    "rendezvous": _rendezvous,
}


_GIVEN = {"self", "layout", "variant", "num_envs", "seed"}
"""Arguments of the environments that `make_env` gives."""


def env_names() -> list[str]:
    """Names that need no further parameters: the tested entries of the registry."""
    layouts = (
        "cramped_room",
        "asymmetric_advantages",
        "coordination_ring",
        "forced_coordination",
        "counter_circuit_o_1order",
    )
    return [f"overcooked/{layout}" for layout in layouts] + ["rendezvous/mppmr"]


def make_env(name: str, num_envs: int = 1, /, *, seed: int = 0, **params: Any) -> BatchedEnv:
    """Build B environments of a registered family.

    Raises:
        UserError: unknown family, layout or parameter, or a batch size below 1.
    """
    family, _, variant = str(name).partition("/")
    if family not in FAMILIES:
        raise UserError("env.name", f"unknown environment {name!r}", f"choose one of {', '.join(env_names())}")
    if num_envs < 1:
        raise UserError("num_envs", f"must be at least 1, got {num_envs}")
    if reserved := sorted(_GIVEN & params.keys()):
        raise UserError(f"env.params.{reserved[0]}", "is no parameter of an environment", "leave it out")
    try:
        return FAMILIES[family](variant, num_envs, seed, params)
    except TypeError as error:
        if "unexpected keyword" not in str(error):
            raise
        raise UserError("env", str(error).partition(") ")[2] or str(error), "see conf/env for the parameters") from None
