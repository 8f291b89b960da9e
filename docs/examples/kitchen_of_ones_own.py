"""A kitchen of one's own: eight copies of it stepped together, and a look at one of them.

python docs/examples/kitchen_of_ones_own.py
"""

import numpy as np

import popgen

GRID = """
XXXPXXX
O 1   D
X  X  X
O   2 S
XXXXXXX
"""

with popgen.make_env("overcooked/alcove", num_envs=8, grid=GRID, horizon=100) as env:
    print(env)
    generator = np.random.default_rng(0)
    env.reset()
    dishes = np.zeros(8)
    for _ in range(200):
        result = env.step(generator.integers(env.spec.num_actions, size=(8, 2)))
        dishes += result.score
        if result.done.any():
            env.reset(indices=np.flatnonzero(result.done))
    print(env.render_text(0))
    print(f"dishes of random play in two episodes of each kitchen: {dishes}")
