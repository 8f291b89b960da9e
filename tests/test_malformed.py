"""Damaged, foreign and hostile configs, populations and checkpoints: one line each, nothing run, nothing overwritten.

What a run of `scale=smoke` left when it died between two iterations is damaged in one way after the other; then it is
continued (or its population shown) as a user would. No process but this one takes part.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from popgen import cli
from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.durable_files import ARRAYS, VALUES, load_state, save_state
from popgen.pipelines import population as main_job
from popgen.progress import NullReporter
from popgen.runs.checkpoints import Checkpoints

RUN = (
    *("scale=smoke", "tracking=off", "population.size=2", "env.params.horizon=20", "seed=3", "run.root=runs"),
    *("run.id=r", "run.transport=inline", "phase1.max_steps=2600", "evaluation.episodes=1"),
)
# What each attempt adds to, damaged run or not.
OF_ATTEMPTS = {"attempts.txt", "provenance.jsonl", "run.lock", "run.log", "state.json"}
HEADER = b'{"a":' + b"[" * 50_000


class Bomb:
    """Makes a folder when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("exploded",)


class Died(RuntimeError):
    """Injected where a driver could be killed."""


@pytest.fixture(scope="module")
def broken_off(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with runs/r, which died in member 1, after a checkpoint between two rounds."""
    folder = tmp_path_factory.mktemp("broken_off")
    saved = Checkpoints.save

    def save_and_die(self: Checkpoints, *given: Any, **named: Any) -> None:
        saved(self, *given, **named)
        if self.count == 3:
            raise Died

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(Checkpoints, "save", save_and_die)
        with pytest.raises(Died):
            main_job.run_population(RunConfig.parse(compose(RUN)), reporter=NullReporter())
    return folder


@pytest.fixture
def here(broken_off: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The present folder: a copy of that, and the run's folder in it."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(broken_off / "runs", "runs")
    return tmp_path / "runs" / "r"


def fingerprint(folder: Path) -> dict[str, str]:
    """Every file's contents and every link's target, but for what each attempt adds to."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.name in OF_ATTEMPTS and path.parent == folder / "runs" / "r":
            continue
        if path.is_symlink():
            found[name] = f"link to {os.readlink(path)}"
        elif path.is_file() and path.stat().st_size < 2**28:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            found[name] = "other"
    return found


# --- ways to damage


def write(name: str, content: bytes) -> Callable[[Path], None]:
    return lambda run: (run / name).write_bytes(content) and None


def cut(name: str, share: float) -> Callable[[Path], None]:
    return lambda run: os.truncate(run / name, int((run / name).stat().st_size * share))


def flip(name: str, share: float) -> Callable[[Path], None]:
    def damage(run: Path) -> None:
        data = bytearray((run / name).read_bytes())
        data[int(len(data) * share)] ^= 0x01
        (run / name).write_bytes(data)

    return damage


def remove(name: str) -> Callable[[Path], None]:
    return lambda run: shutil.rmtree(run / name) if (run / name).is_dir() else (run / name).unlink()


def folder(name: str) -> Callable[[Path], None]:
    def damage(run: Path) -> None:
        if (run / name).exists():
            remove(name)(run)
        (run / name).mkdir()

    return damage


def link(name: str, target: str) -> Callable[[Path], None]:
    def damage(run: Path) -> None:
        remove(name)(run)
        (run / name).symlink_to(target)

    return damage


def archive(name: str) -> Callable[[Path], None]:
    """A megabyte of zeros a thousandfold compressed, as torch.save packs pickles."""

    def damage(run: Path) -> None:
        with zipfile.ZipFile(run / name, "w", zipfile.ZIP_DEFLATED) as file:
            file.writestr("archive/data.pkl", pickle.dumps(Bomb()) + bytes(2**20))

    return damage


def in_json(name: str, change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def damage(run: Path) -> None:
        value = json.loads((run / name).read_text())
        value = change(value) or value
        (run / name).write_text(json.dumps(value))

    return damage


def twice(name: str, key: str) -> Callable[[Path], None]:
    """A key of a JSON object a second time."""
    return lambda run: (run / name).write_text((run / name).read_text().replace("{", f'{{"{key}": 7, ', 1)) and None


def newest(damage: Callable[[str], Callable[[Path], None]]) -> Callable[[Path], None]:
    """Damage done to all checkpoints of the running member."""

    def all_of_them(run: Path) -> None:
        found = sorted((run / "checkpoints").glob("progress_*"))
        assert found
        for path in found:
            damage(path.relative_to(run).as_posix())(run)

    return all_of_them


def in_state(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    """A checkpoint that another program made: with digests that are right."""

    def of(name: str) -> Callable[[Path], None]:
        def damage(run: Path) -> None:
            state = load_state(run / name)
            change(state)
            save_state(run / name, state)

        return damage

    return newest(of)


def ledger(change: Callable[[list[dict[str, Any]]], Any]) -> Callable[[Path], None]:
    def damage(run: Path) -> None:
        rows = [json.loads(line) for line in (run / "ledger.jsonl").read_text().splitlines()]
        change(rows)
        (run / "ledger.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))

    return damage


MANIFEST = "population/manifest.json"
SEGMENTS = "checkpoints/segments_000001"
LENGTH = (2**63 - 1).to_bytes(8, "little")

CASES: dict[str, tuple[Callable[[Path], Any], str]] = {
    # name: (what is done to the run's folder, what the line must name)
    "config empty": (write("config.json", b""), "config.json"),
    "config cut": (cut("config.json", 0.5), "config.json"),
    "config no text": (write("config.json", b"\xff\xfe\x00"), "config.json"),
    "config a list": (write("config.json", b"[]"), "config.json"),
    "config nested": (write("config.json", b"[" * 100_000), "config.json"),
    "config of wrong types": (in_json("config.json", lambda v: v["population"].update(size=[2])), "config.json"),
    "config of another run": (in_json("config.json", lambda v: v["agent"].update(units=8)), "another config"),
    "config of another version": (in_json("config.json", lambda v: v.update(colour=1)), "config.json"),
    "config with a key twice": (twice("config.json", "method"), "config.json"),
    "config a folder": (folder("config.json"), "config.json"),
    "config a link to itself": (link("config.json", "config.json"), "config.json"),
    "attempts a folder": (folder("attempts.txt"), "attempts.txt"),
    "tracking cut": (write("tracking.json", b'{"runs": {'), "tracking.json"),
    "tracking of wrong types": (write("tracking.json", b'["runs"]'), "tracking.json"),
    "ledger flipped": (flip("ledger.jsonl", 0.0), "ledger.jsonl"),
    "ledger no text": (write("ledger.jsonl", b"\xff\xfe\n"), "ledger.jsonl"),
    "ledger nested": (write("ledger.jsonl", b"[" * 100_000 + b"\n"), "ledger.jsonl"),
    "ledger with a step less": (ledger(lambda rows: rows.pop()), "ledger.jsonl"),
    "ledger with another member's": (ledger(lambda rows: rows[0].update(member="x")), "ledger.jsonl"),
    "ledger with negative steps": (ledger(lambda rows: rows[0].update(steps=-1)), "ledger.jsonl"),
    "ledger with a line of two kinds": (ledger(lambda rows: rows.append({**rows[0], "steps": 1})), "ledger"),
    "ledger of an unknown kind": (ledger(lambda rows: rows[0].update(kind="naps")), "ledger.jsonl"),
    "manifest cut": (cut(MANIFEST, 0.9), "manifest.json"),
    "manifest nested": (write(MANIFEST, b"[" * 100_000), "manifest.json"),
    "manifest of a newer version": (in_json(MANIFEST, lambda v: v.update(format_version=2)), "manifest.json"),
    "manifest with a key twice": (twice(MANIFEST, "seed"), "manifest.json"),
    "manifest of another run": (in_json(MANIFEST, lambda v: v.update(config_digest="0" * 64)), "manifest.json"),
    "manifest that leaves its folder": (
        in_json(MANIFEST, lambda v: v.update(members=[{"id": 1, "folder": "../../x", "sha256": "0" * 64}])),
        "manifest.json",
    ),
    "manifest a device": (link(MANIFEST, "/dev/zero"), "manifest.json"),
    "checkpoint's arrays cut": (newest(lambda name: cut(f"{name}/{ARRAYS}", 0.7)), "progress"),
    "checkpoint's arrays flipped": (newest(lambda name: flip(f"{name}/{ARRAYS}", 0.9)), "progress"),
    "checkpoint's header flipped": (newest(lambda name: flip(f"{name}/{ARRAYS}", 0.001)), "progress"),
    "checkpoint's values cut": (newest(lambda name: cut(f"{name}/{VALUES}", 0.5)), "progress"),
    "checkpoint's values flipped": (newest(lambda name: flip(f"{name}/{VALUES}", 0.6)), "progress"),
    "checkpoint's values nested": (newest(lambda name: write(f"{name}/{VALUES}", b"[" * 100_000)), "progress"),
    "checkpoint's values a list": (newest(lambda name: write(f"{name}/{VALUES}", b"[]")), "progress"),
    "checkpoint's values a folder": (newest(lambda name: folder(f"{name}/{VALUES}")), "progress"),
    "checkpoint without arrays": (newest(lambda name: remove(f"{name}/{ARRAYS}")), "progress"),
    "checkpoint a pickle": (
        newest(lambda name: write(f"{name}/{ARRAYS}", pickle.dumps(Bomb(), protocol=2))), "progress"
    ),
    "checkpoint an archive": (newest(lambda name: archive(f"{name}/{ARRAYS}")), "progress"),
    "checkpoint with an endless header": (newest(lambda name: write(f"{name}/{ARRAYS}", LENGTH)), "progress"),
    "checkpoint with a nested header": (
        newest(lambda name: write(f"{name}/{ARRAYS}", len(HEADER).to_bytes(8, "little") + HEADER)), "progress"
    ),
    "checkpoint of another version": (
        newest(lambda name: in_json(f"{name}/{VALUES}", lambda v: v.update(format=99))), "progress"
    ),
    "checkpoint a link to itself": (newest(lambda name: link(f"{name}/{ARRAYS}", ARRAYS)), "progress"),
    "checkpoint of no member": (in_state(lambda s: s.pop("member")), "checkpoint"),
    "checkpoint without its log": (in_state(lambda s: s.pop("log")), "checkpoint"),
    "checkpoint whose log is text": (in_state(lambda s: s.update(log="x")), "checkpoint"),
    "checkpoint with a base elsewhere": (in_state(lambda s: s["log"].update(base="../../../x")), "x"),
    "checkpoint without a learner": (in_state(lambda s: s.pop("agent")), "checkpoint"),
    "checkpoint of other sizes": (in_state(lambda s: shorten(s["model"])), "checkpoint"),
    "checkpoint whose ledger is text": (in_state(lambda s: s.update(ledger="all")), "checkpoint"),
    "checkpoint without its steps": (in_state(lambda s: s.pop("steps")), "checkpoint"),
    "checkpoint with moments of other sizes": (
        in_state(lambda s: shorten(s["agent"]["actor_optimiser"])), "checkpoint"
    ),
    "checkpoint without a moment": (
        in_state(lambda s: s["model"]["learner"]["optimiser"].pop("0.exp_avg")), "checkpoint"
    ),
    "checkpoint with a policy of other sizes": (
        in_state(lambda s: shorten(s["progress"]["published"]["acting"])), "checkpoint"
    ),
    "checkpoint whose counters are text": (
        in_state(lambda s: s["progress"].update(rounds="many")), "checkpoint"
    ),
    "checkpoint with half a generator": (
        in_state(lambda s: s["agent"].update(generator=s["agent"]["generator"][:99])), "checkpoint"
    ),
    "checkpoint that begins after its end": (in_state(lambda s: s["log"].update(first=10**6)), "checkpoint"),
    "segments cut": (cut(SEGMENTS, 0.5), "segments_000001"),
    "segments flipped": (flip(SEGMENTS, 0.8), "segments_000001"),
    "segments missing": (remove(SEGMENTS), "segments_000001"),
    "segments a pickle": (write(SEGMENTS, pickle.dumps(Bomb())), "segments_000001"),
    "segments a folder": (folder(SEGMENTS), "segments_000001"),
    "segments a link to itself": (link(SEGMENTS, "segments_000001"), "segments_000001"),
}  # fmt: skip


def shorten(value: Any) -> None:
    """The first matrix in a nested state loses a row."""
    for key, item in value.items():
        if isinstance(item, np.ndarray) and item.ndim == 2:
            value[key] = item[1:]
            return
        if isinstance(item, dict):
            return shorten(item)


def one_line(code: int, out: str, err: str, told: str) -> None:
    assert code == 2 and out == "", err
    lines = [line for line in err.splitlines() if line.startswith("popgen: error: ")]
    assert len(lines) == 1 and err.splitlines()[-1] == lines[0] and told in lines[0], err
    assert "Traceback" not in err and len(lines[0]) < 700


@pytest.mark.parametrize("case", CASES)
def test_a_damaged_run_is_not_gone_on_with(case: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damage, told = CASES[case]
    damage(here)
    before = fingerprint(here.parent.parent)
    capsys.readouterr()
    code = cli.main(["run", "--quiet", *RUN])
    one_line(code, *capsys.readouterr(), told)
    assert fingerprint(here.parent.parent) == before


@pytest.mark.end_to_end
def test_the_run_can_be_gone_on_with(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Undamaged, it ends well: what is refused above is the damage."""
    assert cli.main(["run", "--quiet", "--json", *RUN]) == 0
    assert json.loads(capsys.readouterr().out)["members"] == 2


HOSTILE: dict[str, tuple[str, str]] = {
    "a layout that is code": ("__import__('os').mkdir('exploded')", "code.layout"),
    "a layout that calls a constructor": ("{'grid': open('exploded', 'w').name}", "code.layout"),
    "a layout that computes": ("{'grid': 'X' * 10**10}", "code.layout"),
    "a layout nested": ("(" * 100_000, "code.layout"),
    "a layout of a million rows": ("{'grid': '''" + "XXXXX\n" * 1_000_000 + "'''}", "cells"),
    "a layout of bytes": ("{'grid': b'XX'}", "code.layout"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_layout_is_not_run(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text, told = HOSTILE[case]
    Path("code.layout").write_text(text)
    code = cli.main(["run", "--dry-run", "scale=smoke", "env.name=overcooked/./code.layout"])
    one_line(code, *capsys.readouterr(), told)
    assert [path.name for path in tmp_path.iterdir()] == ["code.layout"]


SETTINGS = {
    "nested without end": ("env.params.x=" + "[" * 3000 + "]" * 3000, "nested"),
    "a group outside of conf": ("scale=../../../etc/passwd", "scale"),
    "a resolver that runs programs": ("run.id=${exec:ls}", "interpolation"),
    "a reference to itself": ("run.id=${run.id}", "ecursive"),
    "a whole number of 5,000 digits": ("population.size=" + "9" * 5000, "digits"),
    "a variable that is not set": ("run.id=${oc.env:POPGEN_NOWHERE}", "POPGEN_NOWHERE"),
    "a name with a line break": ("run.id='a\nb'", "run.id"),
    "a tracking store without a place": ("tracking.uri=sqlite://", "tracking.uri"),
    "an evaluation without end": (
        "evaluation.episodes=100000 population.size=1000 replay.capacity=1000000",
        "evaluation.episodes",
    ),
    "another environment's parameters": ("env.name=rendezvous/mppmr", "env=NAME"),
}


@pytest.mark.parametrize("case", SETTINGS)
def test_a_hostile_setting_is_refused(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    text, told = SETTINGS[case]
    code = cli.main(["run", "--dry-run", "scale=smoke", *(text.split(" ") if "episodes" in text else [text])])
    one_line(code, *capsys.readouterr(), told)
    assert not list(tmp_path.iterdir())


def test_yaml_of_a_parameter_makes_no_objects(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for value in ("!!python/object/apply:os.mkdir [exploded]", "[" * 5000):
        code = cli.main(["evaluate", str(here / "population"), "--param", f"cooking={value}"])
        assert code == 2 and capsys.readouterr().err.count("\n") == 1
    assert not Path("exploded").exists()
