"""Small sizes, buffers and segments for the tests of XPM-Sim."""

from __future__ import annotations

import numpy as np

from popgen.envs import BatchedEnv, make_env
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_sim.simulation_starts import StartStates
from popgen.types import Kind, Segment

CONFIG = XpmSimConfig(
    horizon=7, restart_horizon=3, xp_horizon=4, unroll=10, sims_sp=3, sims_restart=2, sims_xp=4, xp_initial=0.0
)


def filled(env: BatchedEnv, config: XpmSimConfig = CONFIG, steps: int = 12) -> StartStates:
    """Buffers with random self-play of member 3, and cross-play with members 1 and 2."""
    starts = StartStates(config, env, 3, 0)
    rng = np.random.default_rng(1)
    for number, members in enumerate(((3, 3), (3, 1), (2, 3))):
        starts.add([segment(env, members, rng, steps, number)])
    return starts


def segment(env: BatchedEnv, members: tuple[int, int], rng: np.random.Generator, steps: int, number: int) -> Segment:
    env.reset(seed=number)
    columns: list[list[np.ndarray]] = [[] for _ in range(8)]
    for _ in range(steps):
        states = env.get_state()
        actions = rng.integers(0, env.spec.num_actions, (env.num_envs, 2)).astype(np.uint8)
        result = env.step(actions)
        row = (states, env.get_state(), actions, result.reward, result.score, result.events)
        for column, value in zip(columns, (*row, result.terminated, result.truncated), strict=True):
            column.append(value)
        if result.done.any():
            env.reset(indices=np.flatnonzero(result.done))
    kind = Kind.SP if members[0] == members[1] else Kind.XP
    return Segment(kind, members, *(np.stack(column) for column in columns), sampler="test", sequence=number)


def kitchen() -> BatchedEnv:
    return make_env("overcooked/cramped_room", 4, horizon=30)
