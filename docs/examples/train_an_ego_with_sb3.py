"""An ego trained beside a population by Stable-Baselines3 (pip install stable-baselines3).

    python docs/examples/train_an_ego_with_sb3.py runs/demo 2000

The last word is how many steps; a million is enough to see it learn. `--out FILE` keeps it.
"""

import sys

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from popgen import make_partner_env

population, steps = sys.argv[1], int(sys.argv[2])
envs = make_vec_env(lambda: make_partner_env(population), n_envs=4, seed=0)
ego = PPO("MlpPolicy", envs, n_steps=200, batch_size=200, learning_rate=1e-3, ent_coef=0.01, seed=0, device="cpu")
ego.learn(steps)
mean, deviation = evaluate_policy(ego, envs, n_eval_episodes=8, deterministic=False)
print(f"{mean:.1f} (SD {deviation:.1f}) points of training reward an episode")
if sys.argv[3:4] == ["--out"]:
    ego.save(sys.argv[4])
