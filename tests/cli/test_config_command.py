"""`popgen config`: what is shown, and where it says that values come from."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.methods.registry import METHODS

Run = Callable[..., tuple[int, str, str]]


def fields(run: Run, *words: str) -> dict[str, dict[str, Any]]:
    code, out, err = run("config", *words, "--json")
    assert code == 0, err
    return {row["name"]: row for row in json.loads(out)["fields"]}


@pytest.mark.parametrize("method", METHODS)
def test_it_shows_what_the_same_words_would_run(run: Run, method: str) -> None:
    words = ["scale=demo", "env=overcooked/coordination_ring", "seed=3"]
    shown = fields(run, method, *words)
    values = RunConfig.parse(compose([f"method={method}", *words])).as_dict()
    for name, row in shown.items():
        value: Any = values
        for part in name.split("."):
            value = value[part]
        assert row["value"] == value, name


def test_a_value_comes_from_the_last_that_sets_it(run: Run) -> None:
    shown = fields(run, "phase1.model_updates=30", "agent.lam=0.95")
    assert {
        name: shown[name]["source"]
        for name in ("agent.units", "phase1.max_steps", "agent.entropy", "phase1.model_updates", "agent.lam")
    } == {
        "agent.units": "schema",
        "phase1.max_steps": "layout row of laptop",
        "agent.entropy": "recipe laptop",
        "phase1.model_updates": "command line",
        "agent.lam": "command line",
    }
    assert (shown["agent.entropy"]["value"], shown["agent.entropy"]["default"]) == (0.04, 0.02)
    assert "first soups" in shown["agent.entropy"]["reason"] and not shown["agent.entropy"]["ours"]
    assert shown["env.name"]["source"] == "preset env=overcooked/cramped_room"
    assert fields(run, "scale=paper")["phase1.patience"]["ours"]


def test_a_preset_of_ones_own_is_named(run: Run, tmp_path: Path) -> None:
    preset = tmp_path / "mine" / "scale" / "tiny.yaml"
    preset.parent.mkdir(parents=True)
    preset.write_text("# @package _global_\nscale: tiny\nagent:\n  units: 24\n")
    given = ("scale=tiny", "--config-dir", str(tmp_path / "mine"))
    shown = fields(run, *given)
    assert (shown["agent.units"]["value"], shown["agent.units"]["source"]) == (24, "preset scale=tiny")
    assert shown["agent.layers"]["source"] == "schema"
    code, out, _ = run("run", "--dry-run", "--json", *given)
    assert code == 0 and json.loads(out)["agent"]["units"] == 24


@pytest.mark.parametrize("method", METHODS)
def test_the_table_fits_eighty_columns_and_tells_everything(
    run: Run, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = run("config", method, "scale=paper")
    assert code == 0 and max(map(len, out.splitlines())) <= 80
    squeezed = "".join(out.split())
    for row in fields(run, method, "scale=paper").values():
        cells = [row["name"].rpartition(".")[2], row["source"]]
        assert all("".join(cell.split()) in squeezed for cell in cells), row["name"]


def test_a_section_alone(run: Run) -> None:
    assert {name.partition(".")[0] for name in fields(run, "lipo", "--section", "diversity")} == {"diversity"}
    assert set(fields(run, "--section", "general")) == {"method", "scale"}
    code, out, err = run("config", "mappo", "--section", "agent")
    assert code == 2 and out == "" and "choose one of general, env" in err and err.count("\n") == 1


def test_only_what_is_changed(run: Run) -> None:
    words = ("xpm_wm", "env=overcooked/forced_coordination", "agent.units=64")
    shown, changed = fields(run, *words), fields(run, *words, "--changed")
    assert changed == {name: row for name, row in shown.items() if row["value"] != row["default"]}
    assert {"phase1.prefill_steps", "agent.units"} <= set(changed) and len(changed) < len(shown) / 5
    assert all(row["reason"] for row in changed.values() if row["source"] == "recipe laptop")


def test_mistakes_are_those_of_run(run: Run) -> None:
    for words in (["lipo2"], ["agent.lamda_xp=1"], ["agent.lambda_xp=-1"], ["a", "b"]):
        code, out, err = run("config", *words)
        assert code == 2 and out == "" and err.startswith("popgen: error: ") and err.count("\n") == 1, err


def test_a_preset_that_is_no_whole_configuration_is_told(run: Run, tmp_path: Path) -> None:
    (tmp_path / "scale").mkdir()
    (tmp_path / "scale" / "mine.yaml").write_text("phase1: {target_score: 5}\n")  # without its first line
    code, _, err = run("run", "scale=mine", "--config-dir", str(tmp_path), "--dry-run")
    assert code == 2 and "begin its file with: # @package _global_" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"# @package _global_\nagent: [\n", "is no YAML (line 3"),
        (b"\xff\xfe\x00\x93", "cannot be read"),
        (b"# @package _global_\n- 1\n", "holds no settings"),
        (b"# @package _global_\nphase1: {target_score: 5}\n", "add a line such as scale: laptop"),
        (b"# @package _global_\ndefaults: [other]\n", "other.yaml is no YAML (line 1"),
    ],
)
def test_a_preset_that_cannot_be_read_is_one_line(run: Run, tmp_path: Path, content: bytes, told: str) -> None:
    (tmp_path / "scale").mkdir()
    (tmp_path / "scale" / "mine.yaml").write_bytes(content)
    (tmp_path / "scale" / "other.yaml").write_text("a: }")
    code, out, err = run("run", "scale=mine", "--config-dir", str(tmp_path), "--dry-run")
    assert code == 2 and out == "" and told in err and err.count("\n") == 1, err


def test_methods_and_presets_are_listed_as_words_that_run_takes(run: Run, tmp_path: Path) -> None:
    (tmp_path / "scale").mkdir()
    (tmp_path / "scale" / "mine.yaml").write_text("# @package _global_\nscale: mine\n")
    code, out, _ = run("config", "--list", "--json", "--config-dir", str(tmp_path))
    found = json.loads(out)
    assert code == 0 and set(found["methods"]) == set(METHODS)
    assert all("mine" in one["scales"] and one["title"] and one["summary"] for one in found["methods"].values())
    assert {"overcooked/cramped_room", "rendezvous/mppmr"} <= set(found["presets"]["env"])
    code, out, _ = run("config", "--list")
    assert code == 0 and "method=lipo\n" in out and max(map(len, out.splitlines())) <= 80
