"""popgen: populations of diverse cooperative partner agents."""

from __future__ import annotations

from typing import Any

__version__ = "0.1.0"

_LAZY = {
    "evaluate_population": "popgen.evaluation.crossplay",
    "load_population": "popgen.population",
    "make_env": "popgen.envs",
    "make_partner_env": "popgen.population.partner_env",
    "recipe": "popgen.methods.registry",
}
__all__ = ["__version__", *_LAZY]  # pyright: ignore[reportUnsupportedDunderAll] (`__getattr__` has them)


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        from importlib import import_module

        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'popgen' has no attribute {name!r}")
