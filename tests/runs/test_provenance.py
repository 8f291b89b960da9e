from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

import popgen
from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.methods.registry import recipe
from popgen.runs.provenance import (
    PROVENANCE,
    note_attempt,
    read_attempts,
    read_commit,
    recipe_differences,
    repeat_command,
)


@pytest.mark.parametrize(
    "overrides",
    [
        ["method=lipo", "scale=demo", "seed=3", "population.size=5", "diversity.lambda_xp=0.125"],
        ["env=overcooked/custom", "env.params.grid='XXPXX/O12 D/XXSXX'", "scale=smoke", "run.schedule=async"],
        ["method=xpm_sim", "env=rendezvous/mppmr", "env.params.horizon=40"],
    ],
)
def test_the_command_makes_the_same_run_again(overrides: list[str]) -> None:
    config = RunConfig.parse(compose([*overrides, "run.root=somewhere", "cluster.retries=9"]))
    command = shlex.split(repeat_command(config))
    assert command[:2] == ["popgen", "run"] and not any("somewhere" in word for word in command)
    assert RunConfig.parse(compose(command[2:])).digest() == config.digest()


def test_differences_are_those_that_decide() -> None:
    base = recipe("lipo", "overcooked/cramped_room", "demo")
    values = base.as_dict()
    values["diversity"]["lambda_xp"], values["run"]["seed"], values["run"]["root"] = 0.0, 7, "x"
    found = recipe_differences(RunConfig.parse(values))
    assert found == {"diversity.lambda_xp": (base.as_dict()["diversity"]["lambda_xp"], 0.0), "run.seed": (0, 7)}


def test_every_attempt_has_its_line(tmp_path: Path) -> None:
    assert read_attempts(tmp_path) == []
    note_attempt(tmp_path)
    note_attempt(tmp_path)
    first, second = read_attempts(tmp_path)
    assert first["popgen"] == popgen.__version__ and second["began"] >= first["began"]
    assert {key: first[key] for key in ("commit", "changed")} == read_commit()
    (tmp_path / PROVENANCE).write_text(json.dumps([1]) + "\nnot JSON")
    assert read_attempts(tmp_path) == []


def test_a_package_outside_of_a_checkout_has_no_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(popgen, "__file__", str(tmp_path / "popgen" / "__init__.py"))
    assert read_commit() == {"commit": None, "changed": None}
    (tmp_path / ".git").write_text("gitdir: nowhere")
    assert read_commit() == {"commit": None, "changed": None}
