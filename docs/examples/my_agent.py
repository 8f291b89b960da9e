"""Test an agent of your own beside the members of a population.

    python docs/examples/my_agent.py runs/demo

On the command line the same is `popgen evaluate Mine=my_agent:MyAgent --with runs/demo`, in the folder of this file.
The first step is tried before anything is played; what is no action is refused in one line.
"""

import sys

import numpy as np

from popgen.envs import EnvSpec, make_env
from popgen.evaluation.holdout import Casting, evaluate_holdout
from popgen.evaluation.holdout_players import open_sides
from popgen.reports.method_titles import title_of


class MyAgent:
    """Repeats its last action half of the time; replace `act` by your own."""

    view = "features"

    def __init__(self, spec: EnvSpec) -> None:
        self.actions = spec.num_actions

    def reset(self, batch: int, seed: int) -> None:
        """So many new episodes."""
        self.generator = np.random.default_rng(seed)

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """Choose an action for each row and each seat, as if it sat in both."""
        drawn = self.generator.integers(self.actions, size=previous_actions.shape)
        again = (self.generator.random(previous_actions.shape) < 0.5) & ~is_first[:, None]
        return np.where(again, previous_actions, drawn)


if __name__ == "__main__":
    sides = open_sides({"ego": [("Mine", "my_agent:MyAgent")], "partner": [(None, sys.argv[1])]}, title_of)
    info, (partners,) = sides.environment, sides.sides["partner"]
    result = evaluate_holdout(
        Casting(sides.sides["ego"], (partners,)),
        info,
        lambda num_envs, seed: make_env(info.name, num_envs, seed=seed, **info.params),
        episodes=5,
        seed=0,
    )
    for partner, scores in zip(partners.players, result.scores[0].mean(-1), strict=True):
        print(f"beside {partner.name}: {scores[0]:.2f} {info.score_name} in seat 0, {scores[1]:.2f} in seat 1")
