"""A PettingZoo environment in which a member of a population plays one seat and an agent of yours the other.

    python docs/examples/partner_for_an_agent.py runs/demo

The observations are float32, which the default networks of RLlib and Stable-Baselines3 take. Replace `choose_action` by
your own agent; with a member drawn anew for every episode it has to adapt to partners.
"""

import sys

import numpy as np

import popgen
from popgen.envs.parallel import PopgenParallelEnv

EPISODES = 2
population = popgen.load_population(sys.argv[1])
generator = np.random.default_rng(0)


def choose_action(observation: np.ndarray) -> int:
    """Your agent in place of this one, which does anything."""
    return int(generator.integers(population.spec.num_actions))


env = PopgenParallelEnv(population.make_env(), dtype="float32")
for episode in range(EPISODES):
    partner = population[int(generator.integers(len(population))) + 1]
    partner.reset(batch=1, seed=episode)
    observations, _ = env.reset()
    actions, first, score = np.zeros((1, 2), np.uint8), np.ones(1, bool), 0.0
    while env.agents:
        seen = env.env.observe(partner.view)  # the partner's own view, of both seats
        answer = partner.act(seen, actions, first)[0, 1]
        joint = {"player_0": choose_action(observations["player_0"]), "player_1": int(answer)}
        observations, rewards, terminations, truncations, infos = env.step(joint)
        actions, first = np.array([list(joint.values())], np.uint8), np.zeros(1, bool)
        score += infos["player_0"]["score"]
    print(f"episode {episode}: {partner}, score {score:g}")
env.close()
