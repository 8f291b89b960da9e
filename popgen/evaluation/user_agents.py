"""A user's own agent as a policy: `module:Agent`, of popgen's contract or of overcooked_ai's.

The name stands for a policy, for a class, or for a function that makes one; a callable with an argument gets the
environment's `EnvSpec`. What it makes is a `popgen.play.policy.Policy` or an `Agent` of overcooked_ai. Either is
checked at every step (`checked_policies`), but for popgen's own policies.
"""

from __future__ import annotations

import copy
import inspect
import os
import sys
from collections.abc import Callable
from importlib import import_module
from textwrap import shorten
from typing import Any

import numpy as np

from popgen.envs.contract import BatchedEnv, EnvSpec
from popgen.envs.overcooked import OvercookedEnv
from popgen.errors import UserError
from popgen.evaluation.checked_policies import CheckedPolicy, describe_fault
from popgen.play.policy import Policy

PLAYS = ("view", "reset", "act")
"""What a policy needs to play; all else of the contract is for saving it."""

_FOREIGN = "as overcooked_ai's Agent has it"
"""How a method of an agent is defined."""


class _ForeignAgents:
    """Agents of overcooked_ai in a batch: one for each row and seat, each looking at overcooked_ai's own states.

    What an agent draws from a generator of its own is not seeded here.

    Args:
        name: `module:Agent`, for messages.
        make_agent: () -> a new agent.
        env: of the layout and cooking mode that is played; used for its rules only.
    """

    view = "features"

    def __init__(self, name: str, make_agent: Callable[[], Any], env: OvercookedEnv) -> None:
        from popgen.envs.overcooked.bridge import to_overcooked_mdp

        self._name, self._make_agent, self._env, self._mdp = name, make_agent, env, to_overcooked_mdp(env)
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
                chosen[row, seat] = self._read_answer(agent.action(state))
        self._time += 1
        return chosen

    def _read_answer(self, answer: Any) -> int:
        """Number of the action."""
        from overcooked_ai_py.mdp.actions import Action

        if isinstance(answer, tuple | list) and len(answer) == 2:
            for number, known in enumerate(Action.ALL_ACTIONS):
                if isinstance(answer[0], type(known)) and answer[0] == known:
                    return number
        fix = "give (action, info), the action one of overcooked_ai's Action.ALL_ACTIONS"
        raise UserError(self._name, f"action gives {shorten(repr(answer), 60, placeholder='...')}", fix)


def is_agent_name(text: str) -> bool:
    """Whether this is `module:Agent` and no folder."""
    module, colon, name = text.partition(":")
    words = [*module.split("."), *name.split(".")]
    return bool(colon) and all(word.isidentifier() for word in words) and not os.path.exists(text)


def open_user_agent(text: str, env: BatchedEnv) -> Callable[[], Policy]:
    """A maker of policies from `module:Agent`; the module is imported, also from the working folder.

    Args:
        text: `module:Agent`.
        env: of the rules that it is to play by, for a step of trial; it is reset.

    Raises:
        UserError: no such module or name, a module that cannot be run, it makes something else than a policy or an
            agent, or that fails in its first step. So do the policies, later.
    """
    found = _import_named(text)
    try:
        make = _make_things(found, env.spec)
        first = make()
        foreign = _is_foreign(first)
        missing = [] if foreign else [part for part in PLAYS if not hasattr(first, part)]
        view = _ForeignAgents.view if foreign else None if missing else first.view
    except (Exception, SystemExit) as error:  # of the user's own code
        raise UserError(text, f"cannot be made ({describe_fault(error)})", "see docs/evaluation.md") from error
    if missing:
        problem = f"is neither a policy nor an agent of overcooked_ai (it has no {', '.join(missing)})"
        raise UserError(text, problem, "see popgen.play.policy.Policy")
    if foreign and not isinstance(env, OvercookedEnv):
        raise UserError(text, f"is an agent of overcooked_ai, {env.spec.name} is another game", "give a policy")
    if not isinstance(view, str) or view not in env.spec.views:
        raise UserError(text, f"wants the view {view!r}", f"choose among {', '.join(env.spec.views)}")

    def make_policy() -> Policy:
        if foreign and isinstance(env, OvercookedEnv):
            agents = _ForeignAgents(text, lambda: _make_separate(text, make, first), env)
            return CheckedPolicy(text, agents, view, env.spec, _FOREIGN)
        thing = _make_separate(text, make, first)
        return thing if _is_own(thing) else CheckedPolicy(text, thing, view, env.spec)

    _try_step(make_policy(), env)
    return make_policy


def _make_separate(text: str, make: Callable[[], Any], first: Any) -> Any:
    """A policy or agent with a memory of its own: a copy of `first`, which nobody plays, where that is made each time.

    Raises:
        UserError: it cannot be made, or not be copied.
    """
    try:
        thing = make()
        return copy.deepcopy(first) if thing is first else thing
    except (Exception, SystemExit) as error:  # of the user's own code
        problem = f"cannot be made anew ({describe_fault(error)})"
        raise UserError(text, problem, "give a class, or a function that makes a new agent at each call") from error


def _try_step(policy: Policy, env: BatchedEnv) -> None:
    """Its first step, before anything is played."""
    rows = env.num_envs
    env.reset(seed=0)
    policy.reset(rows, 0)
    policy.act(env.observe(policy.view), np.zeros((rows, env.spec.num_players), np.uint8), np.ones(rows, bool))


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
        problem = f"the module {module} fails when it is imported ({describe_fault(error)})"
        raise UserError(text, problem, f"correct it: python -c 'import {module}' shows where") from error
    try:
        for part in name.split("."):
            found = getattr(found, part)
    except Exception as error:
        problem = f"{name} cannot be found in the module {module} ({describe_fault(error)})"
        raise UserError(text, problem, "give module:Agent as Python would import it") from None
    return found


def _make_things(found: Any, spec: EnvSpec) -> Callable[[], Any]:
    """() -> a new policy or agent, by a class, a function, or copies of an object that plays itself (a network can be
    called too)."""
    plays = not isinstance(found, type) and all(hasattr(found, part) for part in PLAYS)
    if plays or not callable(found) or _is_foreign(found):
        return lambda: copy.deepcopy(found)
    parameters = inspect.signature(found).parameters.values()
    positional = [one for one in parameters if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)]
    needs_spec = any(one.default is one.empty for one in positional)
    return (lambda: found(spec)) if needs_spec else found


def _is_foreign(thing: Any) -> bool:
    """Whether it is an `Agent` of overcooked_ai; the package is not imported for that."""
    names = {f"{kind.__module__}.{kind.__name__}" for kind in type(thing).__mro__}
    return "overcooked_ai_py.agents.agent.Agent" in names


def _is_own(thing: Any) -> bool:
    """Whether it is a policy of popgen's own, such as a member that somebody's function loads."""
    return type(thing).__module__.partition(".")[0] == "popgen"
