"""Registry of policy kinds: what a saved policy's `kind` stands for, imported when first needed."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np

from popgen.envs.contract import EnvSpec
from popgen.play.policy import Policy

POLICIES: dict[str, str] = {
    "random": "popgen.policies.simple_policies:RandomPolicy",
    "idle": "popgen.policies.simple_policies:IdlePolicy",
    "feed_forward": "popgen.policies.feed_forward_policy:FeedForwardPolicy",
    "human_clone": "popgen.humans.clone_policy:ClonePolicy",
}
"""kind -> `module:class` of policies of no method in particular."""

_METHODS = "popgen.methods.registry"
"""Module that knows the kinds of methods' policies; imported by its name, since methods stand above this package."""


def policy_kinds() -> dict[str, str]:
    """kind -> `module:class` of all policies, those of installed methods too: the only classes that a loaded artefact
    can name."""
    return POLICIES | import_module(_METHODS).policy_kinds()


def policy_class(kind: str) -> type[Policy]:
    """The class behind a kind.

    Raises:
        ValueError: the kind is not registered.
    """
    places = POLICIES if kind in POLICIES else policy_kinds()
    if kind not in places:
        raise ValueError(f"unknown policy kind {kind!r}, known are {', '.join(sorted(places))}")
    module, _, name = places[kind].partition(":")
    return getattr(import_module(module), name)


def build_policy(kind: str, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec) -> Policy:
    """Build a policy of a registered kind from its parts.

    Raises:
        ValueError: unknown kind, or parts that do not fit each other or the environment.
    """
    cls = policy_class(kind)
    try:
        return cls.from_parts(config, weights, spec)
    except (KeyError, TypeError, RuntimeError) as error:  # what torch and constructors raise for ill-fitting parts
        raise ValueError(f"{kind} policy cannot be built: {error}") from error
