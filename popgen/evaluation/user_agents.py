"""A user's own agent as a policy: `module:Agent`, of popgen's contract or of overcooked_ai's.

The name stands for a policy, for a class, or for a function that makes one; a callable with an argument gets the
environment's `EnvSpec`. What it makes is a `popgen.play.policy.Policy` or an `Agent` of overcooked_ai.
"""

from __future__ import annotations

import copy
import inspect
import os
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from textwrap import shorten
from typing import Any, ClassVar, Self

import numpy as np

from popgen.envs.contract import BatchedEnv, EnvSpec
from popgen.envs.overcooked import OvercookedEnv
from popgen.errors import UserError
from popgen.play.policy import Policy

PLAYS = ("view", "reset", "act")
"""What a policy needs to play; all else of the contract is for saving it."""


class ForeignAgentPolicy:
    """Agents of overcooked_ai in a batch: one for each row and seat, each looking at overcooked_ai's own states.

    What an agent draws from a generator of its own is not seeded here.

    Args:
        make_agent: () -> a new agent.
        env: of the layout and cooking mode that is played; used for its rules only.
    """

    kind: ClassVar[str] = "foreign_agent"

    def __init__(self, make_agent: Callable[[], Any], env: OvercookedEnv) -> None:
        from popgen.envs.overcooked.bridge import to_overcooked_mdp

        self.view = "features"
        self._make_agent, self._env, self._mdp = make_agent, env, to_overcooked_mdp(env)
        self._agents: list[tuple[Any, ...]] = []
        self._time = np.zeros(0, np.int64)

    def reset(self, batch: int, seed: int) -> None:
        """New agents for `batch` episodes."""
        self._agents = [tuple(self._seat_agent(seat) for seat in range(2)) for _ in range(batch)]
        self._time = np.zeros(batch, np.int64)

    def _seat_agent(self, seat: int) -> Any:
        agent = self._make_agent()
        agent.set_agent_index(seat)
        agent.set_mdp(self._mdp)
        return agent

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """See `Policy.act`."""
        from overcooked_ai_py.mdp.actions import Action

        from popgen.envs.overcooked.bridge import to_overcooked_ai

        states = self._env.features_to_states(np.ascontiguousarray(obs[:, 0]))
        chosen = np.zeros((len(obs), 2), np.uint8)
        for row, agents in enumerate(self._agents):
            if is_first[row]:
                self._time[row] = 0
            state = to_overcooked_ai(self._env, states[row])
            state.timestep = int(self._time[row])
            for seat, agent in enumerate(agents):
                if is_first[row]:
                    agent.reset()
                    agent.set_agent_index(seat)
                    agent.set_mdp(self._mdp)
                action, _ = agent.action(state)
                chosen[row, seat] = Action.ACTION_TO_INDEX[action]
        self._time += 1
        return chosen

    def config(self) -> dict[str, Any]:
        """Nothing: the agent is the user's."""
        return {}

    def weights(self) -> dict[str, np.ndarray]:
        """Nothing: the agent is the user's."""
        return {}

    @classmethod
    def from_parts(cls, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec) -> Self:
        """Raises ValueError: it is not an artefact."""
        raise ValueError("a user's agent is not loaded from a population")


def is_agent_name(text: str) -> bool:
    """Whether this is `module:Agent` and no folder."""
    module, colon, name = text.partition(":")
    words = [*module.split("."), *name.split(".")]
    return bool(colon) and all(word.isidentifier() for word in words) and not os.path.exists(text)


def open_user_agent(text: str, env: BatchedEnv) -> Callable[[], Policy]:
    """A maker of policies from `module:Agent`; the module is imported, also from the working folder.

    Raises:
        UserError: no such module or name, a module that cannot be run, or it makes something else than a policy or an
            agent.
    """
    found = _import_named(text)
    try:
        make = _make_things(found, env.spec)
        first = make()
        foreign = _is_foreign(first)
        missing = [] if foreign else [part for part in PLAYS if not hasattr(first, part)]
        view = None if foreign or missing else first.view
    except (Exception, SystemExit) as error:  # of the user's own code
        raise UserError(text, f"cannot be made ({_describe_fault(error)})", "see docs/evaluation.md") from error
    if foreign:
        if not isinstance(env, OvercookedEnv):
            raise UserError(text, f"is an agent of overcooked_ai, {env.spec.name} is another game", "give a policy")
        return lambda: ForeignAgentPolicy(make, env)
    if missing:
        problem = f"is neither a policy nor an agent of overcooked_ai (it has no {', '.join(missing)})"
        raise UserError(text, problem, "see popgen.play.policy.Policy")
    if not isinstance(view, str) or view not in env.spec.views:
        raise UserError(text, f"wants the view {view!r}", f"choose among {', '.join(env.spec.views)}")
    return make


def _import_named(text: str) -> Any:
    """What `module:Agent` names; the module is run, and may do anything but end the process."""
    module, _, name = text.partition(":")
    if (here := os.getcwd()) not in sys.path:
        sys.path.insert(0, here)
    try:
        found: Any = import_module(module)
    except ImportError as error:
        raise UserError(text, f"cannot be imported ({error})", "give module:Agent as Python would import it") from None
    except (Exception, SystemExit) as error:
        problem = f"the module {module} fails when it is imported ({_describe_fault(error)})"
        raise UserError(text, problem, f"correct it: python -c 'import {module}' shows where") from error
    try:
        for part in name.split("."):
            found = getattr(found, part)
    except Exception as error:
        problem = f"{name} cannot be found in the module {module} ({_describe_fault(error)})"
        raise UserError(text, problem, "give module:Agent as Python would import it") from None
    return found


def _describe_fault(error: BaseException) -> str:
    """Kind of an error in somebody else's code, and what it says, cut where that is long."""
    said = str(error)
    return shorten(f"{type(error).__name__}: {said}" if said else type(error).__name__, 300, placeholder="...")


def _make_things(found: Any, spec: EnvSpec) -> Callable[[], Any]:
    """() -> a new policy or agent, by a class, a function, or copies of an object."""
    if not callable(found) or _is_foreign(found):
        return lambda: copy.deepcopy(found)
    parameters = inspect.signature(found).parameters.values()
    positional = [one for one in parameters if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)]
    needs_spec = any(one.default is one.empty for one in positional)
    return (lambda: found(spec)) if needs_spec else found


def _is_foreign(thing: Any) -> bool:
    """Whether it is an `Agent` of overcooked_ai; the package is not imported for that."""
    names = {f"{kind.__module__}.{kind.__name__}" for kind in type(thing).__mro__}
    return "overcooked_ai_py.agents.agent.Agent" in names
