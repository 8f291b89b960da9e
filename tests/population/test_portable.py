"""A saved member plays where only the library's core can be imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

PROGRAM = """
import sys

BLOCKED = {"ray", "hydra", "omegaconf", "mlflow", "pettingzoo", "gymnasium", "matplotlib"}
OURS = {"popgen.algos", "popgen.rllib", "popgen.runs.mlflow_tracker", "popgen.cli", "actors", "pipelines"}


class Blocker:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name in BLOCKED | OURS:
            raise ImportError(f"{name} is blocked")


sys.meta_path.insert(0, Blocker)
try:
    import ray
except ImportError:
    pass
else:
    raise SystemExit("ray was not blocked")
import numpy as np
import popgen
from popgen.play.rollout import play

population = popgen.load_population(sys.argv[1])
env = population.make_env(2, seed=0)
played = play(env, [population[1], population[2]], np.array([[0, 1], [1, 0]]), seed=0)
loaded = {name.partition(".")[0] for name in sys.modules} & (BLOCKED | {"overcooked_ai_py"})
assert not loaded, loaded
print(population.info(1).kind, played.length.tolist(), played.steps)
"""


@pytest.mark.end_to_end
def test_a_fresh_interpreter_without_the_training_stack(model_run: Path) -> None:
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", PROGRAM, str(model_run / "population")]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["world_model", "[400,", "400]", "800"]
