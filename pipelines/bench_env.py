"""How fast an environment is on one core, with the reference implementation measured in the same run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import redirect_stderr
from io import StringIO
from typing import Any

import numpy as np

from popgen.envs import BatchedEnv, make_env
from popgen.envs.env_registry import env_names
from popgen.errors import UserError
from popgen.runs.preflight import memory_bytes

ROUND = 64  # joint actions drawn beforehand, and steps between two looks at the clock


def bench_env(name: str, *, num_envs: int = 1024, seconds: float = 2.0) -> dict[str, Any]:
    """Measure random play with all observations of both players encoded after every step.

    Args:
        name: registry name.
        num_envs: environments stepped together.
        seconds: time of each measurement.

    Returns:
        env, num_envs, seconds; step_only_per_second; steps_per_second, with every view of the environment;
        reference_steps_per_second of the reference implementation with its own encoding of both players, and
        ratio: both None where there is none. All in environment steps a second.

    Raises:
        UserError: an unknown environment, or more of them than fit into this machine's memory.
    """
    _check_memory(name, num_envs)
    env = make_env(name, num_envs)
    actions = np.random.default_rng(0).integers(0, env.spec.num_actions, (ROUND, num_envs, env.spec.num_players))
    actions = actions.astype(np.uint8)
    views = {view: env.observe(view) for view in env.spec.views}
    step_only = _rate(lambda: _play(env, actions, {}), ROUND * num_envs, seconds)
    with_views = _rate(lambda: _play(env, actions, views), ROUND * num_envs, seconds)
    make_reference = REFERENCES.get(name.partition("/")[0])
    reference = None
    if make_reference is not None and name in env_names():  # the reference knows no files of users
        reference = _rate(make_reference(name.partition("/")[2], env.spec.horizon), ROUND, seconds)
    return {
        "env": name,
        "num_envs": num_envs,
        "seconds": seconds,
        "step_only_per_second": round(step_only),
        "steps_per_second": round(with_views),
        "reference_steps_per_second": None if reference is None else round(reference),
        "ratio": None if reference is None else round(with_views / reference, 1),
    }


def _check_memory(name: str, num_envs: int) -> None:
    """Told before anything is allocated: the system would hand out more than there is, and run out of it later."""
    spec = make_env(name, 1).spec
    views = sum(math.prod(view.shape) * np.dtype(view.dtype).itemsize for view in spec.views.values())
    each = spec.state_size * np.dtype(spec.state_dtype).itemsize + spec.num_players * (views + ROUND)
    needed, have = num_envs * each, memory_bytes()
    if needed > have:
        problem = f"{num_envs:,} need about {needed / 2**30:.1f} GiB of memory, this machine has {have / 2**30:.1f}"
        raise UserError("--envs", problem, "lower it")


def _rate(play: Callable[[], None], steps: int, seconds: float) -> float:
    """Steps a second of the fastest of the calls that `seconds` have room for, each of which takes `steps`.

    The first call (compilation) does not count. The fastest, as in `timeit`: other work on the machine only ever
    slows a call down.
    """
    play()
    fastest, began = math.inf, time.perf_counter()
    while (start := time.perf_counter()) - began < seconds:
        play()
        fastest = min(fastest, time.perf_counter() - start)
    return steps / fastest


def _play(env: BatchedEnv, actions: np.ndarray, views: dict[str, np.ndarray]) -> None:
    for joint in actions:
        done = env.step(joint).done
        if done.any():
            env.reset(indices=np.flatnonzero(done))
        for view, out in views.items():
            env.observe(view, out)


def _overcooked_reference(layout: str, horizon: int) -> Callable[[], None]:
    """ROUND steps of overcooked_ai: its transition and its lossless encoding, which is of both players."""
    with redirect_stderr(StringIO()):  # gym, which overcooked_ai imports, prints that it is no longer maintained
        from overcooked_ai_py.mdp.actions import Action
        from overcooked_ai_py.mdp.overcooked_mdp import OvercookedGridworld

    mdp = OvercookedGridworld.from_layout_name(layout)
    choices = np.random.default_rng(0).integers(0, len(Action.ALL_ACTIONS), (ROUND, 2))
    joints = [tuple(Action.ALL_ACTIONS[choice] for choice in row) for row in choices]
    state, passed = mdp.get_standard_start_state(), 0

    def play() -> None:
        nonlocal state, passed
        for joint in joints:
            state, _ = mdp.get_state_transition(state, joint)
            mdp.lossless_state_encoding(state, horizon=horizon)
            passed += 1
            if passed % horizon == 0:
                state = mdp.get_standard_start_state()

    return play


REFERENCES: dict[str, Callable[[str, int], Callable[[], None]]] = {"overcooked": _overcooked_reference}
"""Family -> makes a function that plays ROUND steps of the reference."""
