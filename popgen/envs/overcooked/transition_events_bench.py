"""How fast events of transitions are found: `python -m popgen.envs.overcooked.transition_events_bench`."""

from __future__ import annotations

import argparse
import time

import numpy as np

from popgen.envs.env_registry import env_names
from popgen.envs.overcooked.env import OvercookedEnv
from popgen.envs.overcooked.transition_events import find_transition_events

KITCHENS = 1024


def record_random_play(env: OvercookedEnv, steps: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """States (T, N, S) and actions (T, N, 2) of uniformly random players."""
    actions = np.random.default_rng(seed).integers(0, env.spec.num_actions, (steps, env.num_envs, 2), dtype=np.uint8)
    states = np.empty((steps, env.num_envs, env.spec.state_size), np.uint8)
    env.reset()
    for t in range(steps):
        states[t] = env.get_state()
        env.step(actions[t])
    return states, actions


def measure_rate(env: OvercookedEnv, seconds: float) -> float:
    """Transitions a second on one core, in the fastest of the calls that `seconds` have room for."""
    states, actions = record_random_play(env, 200, seed=0)
    find_transition_events(env, states[:1], actions[:1])
    fastest, began = float("inf"), time.perf_counter()
    while (start := time.perf_counter()) - began < seconds:
        find_transition_events(env, states, actions)
        fastest = min(fastest, time.perf_counter() - start)
    return states.shape[0] * states.shape[1] / fastest


def main() -> None:
    """Print the rate in every layout."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1.0, help="time of each measurement (%(default)s)")
    args = parser.parse_args()
    for name in env_names():
        family, _, layout = name.partition("/")
        if family == "overcooked":
            rate = measure_rate(OvercookedEnv(layout, KITCHENS), args.seconds)
            print(f"{layout:26}{rate:14,.0f} transitions a second", flush=True)


if __name__ == "__main__":
    main()
