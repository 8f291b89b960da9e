"""The comparison of two recordings; recording itself takes minutes and is a command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from house.golden import METHODS, RESUMED, compare_files, list_differences, read_figures
from popgen.methods.registry import BUILT_IN

FIGURES = {"weights": {"a": "1", "b": "2"}, "ledger": "3", "steps": {"member 1 SP": 10}, "matrix": "4"}


def test_what_is_recorded_are_built_in_methods() -> None:
    assert set(METHODS) <= set(BUILT_IN)


@pytest.mark.parametrize("kind", FIGURES)
def test_each_difference_is_named(kind: str) -> None:
    before = {"xpm_wm": FIGURES, "lipo": FIGURES}
    after = {name: dict(figures) for name, figures in before.items()}
    assert list_differences(before, after) == []
    after["lipo"][kind] = {**FIGURES[kind], "c": "5"} if isinstance(FIGURES[kind], dict) else "5"
    assert list_differences(before, after) == [
        f"lipo: {kind}: c" if isinstance(FIGURES[kind], dict) else f"lipo: {kind}"
    ]
    assert list_differences(before, {"lipo": FIGURES}) == ["xpm_wm: recorded in one file only"]


def test_a_resumed_run_must_be_the_undisturbed_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"xpm_wm": FIGURES, RESUMED: FIGURES}))
    assert compare_files(path, path) == 0 and "equal: 2 cases, 4 weight files" in capsys.readouterr().out
    path.write_text(json.dumps({"xpm_wm": FIGURES, RESUMED: {**FIGURES, "ledger": "9"}}))
    assert compare_files(path, path) == 1 and "the resumed run differs" in capsys.readouterr().out


def test_the_ledgers_digest_knows_no_attempts(tmp_path: Path) -> None:
    digests = []
    for name, sampler in (("whole", "sampler0.x.1"), ("resumed", "sampler0.x.2")):
        folder = tmp_path / name
        (folder / "population" / "member_001").mkdir(parents=True)
        (folder / "population" / "member_001" / "policy.safetensors").write_bytes(b"weights")
        row = {"run": name, "member": 1, "kind": "SP", "sampler": sampler, "sequence": 0, "steps": 8}
        (folder / "ledger.jsonl").write_text(json.dumps({**row, "episodes": 1, "score": 0.5}) + "\n")
        digests.append(read_figures(folder, {"matrix": {"mean": [[1.0]]}}))
        with (folder / "ledger.jsonl").open("a") as file:
            file.write(json.dumps({**row, "kind": "evaluation", "episodes": 1, "score": float(len(digests))}) + "\n")
        assert read_figures(folder, {"matrix": {"mean": [[1.0]]}})["ledger"] == digests[-1]["ledger"]
    assert digests[0] == digests[1] and digests[0]["steps"] == {"member 1 SP": 8}
