"""What a command writes replaces nothing of a run, and what it reads of an unfinished run is told."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.policies.simple_policies import RandomPolicy
from popgen.population import PopulationWriter

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run that was interrupted after two of three members."""
    words = ["method=lipo", "env=rendezvous/mppmr", "population.size=3", "env.params.horizon=4"]
    config = RunConfig.parse(compose(words))
    folder = tmp_path / "night"
    spec = make_env(config.env.name, 1, **config.env.params).spec
    writer = PopulationWriter(folder / "population", spec, method="lipo", config_digest="d", seed=0)
    for seed in (1, 2):
        writer.add_member(RandomPolicy(5), seed=seed, steps={"SP": 10})
    (folder / "config.json").write_text(json.dumps(config.as_dict()))
    (folder / "ledger.jsonl").write_text("")
    (folder / "state.json").write_text(json.dumps({"state": "interrupted", "attempt": 1, "seconds": 1.0}))
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ("report", "{run}", "--out", "{run}/ledger.jsonl"),
        ("play", "{run}", "--html", "{run}/population/manifest.json"),
        ("play", "{run}", "--gif", "{run}/config.json"),
        ("evaluate", "{run}", "--out", "{run}"),
        ("evaluate", "{run}", "--out", "{run}/population"),
        ("diversity", "{run}", "--out", "{run}/population/member_001"),
        ("conventions", "{run}", "--out", "{run}"),
        ("compare", "{run}", "--out", "{run}"),
        ("reproduce", "ego", "--results", "{run}/config.json"),
    ],
)
def test_what_a_run_consists_of_is_not_written_over(run: Run, folder: Path, words: tuple[str, ...]) -> None:
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    code, out, err = run(*(word.format(run=folder) for word in words))
    assert code == 2 and out == "" and f"popgen: error: {words[-2]}: " in err, err
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_members_of_an_unfinished_run_are_told_as_such(run: Run, folder: Path) -> None:
    for words in (("show", str(folder)), ("evaluate", f"{folder}/population:2,1", "--episodes", "1", "--quiet")):
        code, _, err = run(*words)
        assert code == 0 and "is interrupted: 2 of 3 members are there" in err, err


def test_an_earlier_report_is_not_replaced_without_a_word(run: Run, folder: Path) -> None:
    words = ("evaluate", str(folder), "--episodes", "1", "--json", "--out", "mine")
    assert "earlier report" not in run(*words)[2]
    code, out, err = run(*words, "--members", "2")
    assert code == 0 and "note: mine holds an earlier report, which is replaced" in err
    assert len(json.loads(out)["matrix"]["mean"]) == 1
    assert "earlier report" not in run(*words, "--quiet")[2]


def test_members_are_named_once(run: Run, folder: Path) -> None:
    code, _, err = run("evaluate", f"{folder}:1", "--members", "2")
    assert code == 2 and "--members" in err and err.count("popgen: error") == 1
