"""The scripts and the notebook in docs/examples run as they are, from the folder that they name."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT

EXAMPLES = ROOT / "docs" / "examples"
SAYS = {
    "measure_population.py": ["<Population of 2 members", "seat_1", "member 2 beside a random partner: <5 episodes"],
    "partner_for_an_agent.py": ["episode 0: ", "episode 1: ", "score"],
    "kitchen_of_ones_own.py": ["<OvercookedEnv overcooked/alcove: 8 environments", "dishes of random play"],
    "my_agent.py": ["beside XPM-WM 1: ", "beside XPM-WM 2: ", "dishes in seat 0"],
    "prepare_a_hold_out_set.py": ["held out: XPM-WM=", "two_random:", "beside 1 of 2 partners, in both seats"],
    "train_an_ego_with_sb3.py": ["points of training reward an episode"],
}


def test_every_script_is_here() -> None:
    assert SAYS.keys() == {path.name for path in EXAMPLES.glob("*.py")}


@pytest.mark.end_to_end
@pytest.mark.parametrize("name", SAYS)
def test_scripts_run_as_their_first_lines_say(name: str, random_population: Path) -> None:
    text = (EXAMPLES / name).read_text()
    command = next(line.split() for line in text.splitlines() if line.strip().startswith("python docs/"))
    words = [str(random_population) if word == "runs/demo" else word for word in command[1:]]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, *words], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert all(fragment in done.stdout for fragment in SAYS[name]), done.stdout


def test_the_notebook_runs_from_top_to_bottom(random_population: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POPULATION", str(random_population))
    cells = json.loads((EXAMPLES / "population.ipynb").read_text())["cells"]
    assert all(cell.get("outputs", []) == [] for cell in cells)  # results are not kept in the repository
    names: dict[str, Any] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert names["matrix"].to_frame().shape == (2, 2) and names["picture"].shape[2] == 3
