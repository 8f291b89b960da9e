"""An installed package of others adds an environment and a method: trained, evaluated and compared by command line."""

from __future__ import annotations

import importlib
import json
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

import popgen
from popgen.envs import env_names, env_registry, make_env
from popgen.methods import registry
from popgen.methods.registry import METHODS
from popgen.methods.training import Checkpoint, InlineTransport

Run = Callable[..., tuple[int, str, str]]
ENTRY_POINTS = """\
[popgen.environments]
line = toy_popgen.line_family:FAMILY
broken = toy_popgen.nowhere:FAMILY
rendezvous = toy_popgen.line_family:FAMILY
[popgen.methods]
guess = toy_popgen.guess_method:METHOD
absent = toy_popgen.nowhere:METHOD
"""
PRESET = """\
# @package _global_
scale: quick
population: {size: 2}
evaluation: {episodes: 2, weak_share: 0.0}
guess: {rounds: 3}
run: {transport: inline}
tracking: {enabled: false}
"""


def forget_entries() -> None:
    importlib.invalidate_caches()
    for module in (registry, env_registry):
        module._find_offered.cache_clear()
    registry._load_method.cache_clear()
    env_registry._load_family.cache_clear()


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The toy package on the path, as pip leaves one; a folder with a preset."""
    site = tmp_path / "site"
    shutil.copytree(ROOT / "tests" / "support" / "toy_popgen", site / "toy_popgen")
    info = site / "toy_popgen-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-popgen\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    presets = tmp_path / "presets"
    (presets / "scale").mkdir(parents=True)
    (presets / "scale" / "quick.yaml").write_text(PRESET)
    monkeypatch.syspath_prepend(str(site))
    forget_entries()
    yield presets
    monkeypatch.undo()
    for name in [name for name in sys.modules if name.partition(".")[0] == "toy_popgen"]:
        del sys.modules[name]
    forget_entries()


@pytest.mark.end_to_end
def test_a_toy_method_on_a_toy_environment_from_the_command_line(installed: Path, run: Run) -> None:
    given = ("method=guess", "env=line/short", "scale=quick", "--config-dir", str(installed), "--quiet", "--json")
    folders = []
    for name, weight in (("with", 0.5), ("without", 0.0)):
        code, out, err = run("run", *given, f"run.id={name}", f"guess.lambda_xp={weight}")
        assert code == 0, err
        result = json.loads(out)
        assert result["members"] == 2 and np.shape(result["matrix"]["mean"]) == (2, 2)
        assert result["ledger"]["1"]["SP"] == 3 * 4 * 10 and result["ledger"]["2"]["XP"] == 3 * 2 * 4 * 10
        folders.append(result["run_dir"])
    code, out, err = run("evaluate", folders[0], "--episodes", "3", "--json", "--quiet")
    assert code == 0 and json.loads(out)["episodes"] == 3, err
    code, out, err = run(
        "compare", folders[0], f"plain={folders[1]}", "--no-tracking", "--sp", "1", "--xp", "1", "--json", "--quiet"
    )
    assert code == 0, err
    assert {entry["method"] for entry in json.loads(out)["runs"]} == {"guess"}


def test_its_training_continues_from_a_checkpoint(installed: Path) -> None:
    config = popgen.recipe("guess", "line/short")

    def begin() -> Any:
        training = METHODS["guess"].load_training()(config, make_env("line/short").spec, "a.1", InlineTransport())
        training.begin(1)
        return training

    whole, first, second = begin(), begin(), begin()
    trained = list(whole.train())[-1]
    rounds = first.train()
    for _ in range(6):  # the phase and five rounds
        next(rounds)
    state = first.checkpoint()
    state["samplers"] = [pending.result() for pending in state["samplers"]]
    second.restore(Checkpoint(state))
    again = list(second.train())[-1]
    assert np.array_equal(trained.policy.weights()["probabilities"], again.policy.weights()["probabilities"])
    assert second.steps == whole.steps == 12 * 4 * 10


def test_its_settings_are_shown_with_their_reasons(installed: Path, run: Run) -> None:
    code, out, _ = run("config", "guess", "env=line/long", "--json")
    rows = {row["name"]: row for row in json.loads(out)["fields"]}
    assert code == 0 and rows["env.name"]["source"] == "preset env=line/long"
    shown = rows["guess.rounds"]
    assert (shown["value"], shown["default"], shown["source"]) == (30, 8, "layout row of laptop")
    assert shown["reason"] == "chance seldom meets on a long line"
    code, _, err = run("run", "method=guess", "env=line/short", "scale=paper", "--dry-run")
    assert code == 2 and "guess has no recipe 'paper'" in err  # not the laptop's under another name
    code, _, err = run("config", "guess", "agent.lambda_xp=1")
    assert code == 2 and "guess does not have" in err


def test_its_environment_keeps_the_contract_and_a_broken_one_spoils_nothing(installed: Path, run: Run) -> None:
    assert [name for name in env_names() if name.startswith("line/")] == ["line/short", "line/long"]
    env = make_env("line/short", 2)
    batch = env.step(np.array([[2, 0], [1, 1]]))
    assert batch.reward.tolist() == [1.0, 0.0] and env.get_state().tolist() == [[1, 1, 1], [0, 2, 1]]
    assert env.encode(env.get_state())[1].tolist() == [[0, 2], [2, 0]]
    assert make_env("rendezvous/mppmr").spec.name == "rendezvous/mppmr"
    for name, told in (("broken/x", "repair its package"), ("line/round", "choose line/short or line/long")):
        code, _, err = run("run", "--dry-run", f"env.name={name}")
        assert code == 2 and told in err and err.count("\n") == 1
