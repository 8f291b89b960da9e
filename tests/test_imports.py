"""The direction of imports, read from the source."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from conftest import ROOT

# A room may import the rooms above it in this list, never one below.
ORDER = (
    *("types", "errors", "extensions", "jsonable", "durable_files", "progress", "config"),
    *("envs", "nets", "losses"),
    *("play", "policies"),
    "methods",
    "population",
    "humans",
    "evaluation",
    "runs",
    "reports",
    "pages",
    "study",
    "actors",
    "pipelines",
    *("conf", "cli", "__main__"),
)
UPWARD: set[tuple[str, str]] = set()
OWNERS = {  # outside package -> folders and files where it may be imported
    "ray": ("actors", "pipelines", "popgen/methods/mappo", "popgen/runs/recovery.py", "popgen/runs/sinks.py"),
    "hydra": ("popgen/cli/compose.py",),
    "omegaconf": ("popgen/cli/compose.py",),
    "mlflow": ("popgen/runs/mlflow_tracker.py",),
}
TOP = ("popgen", "actors", "pipelines", "conf")


def sources(*folders: str) -> list[Path]:
    found = [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]
    assert found
    return found


def room(path: Path) -> str:
    """The room of a file; actors, pipelines and conf stand at the top level and are linked into popgen."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[1] if parts[0] == "popgen" else parts[0]


@cache
def imports(path: Path) -> list[tuple[int, str]]:
    """(line, dotted module) of every import, also inside functions; `from a import b` gives a and a.b."""
    return [*iter_imports(path)]


def iter_imports(path: Path) -> Iterator[tuple[int, str]]:
    """One after the other, as they stand."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = path.relative_to(ROOT).parts[: -node.level]
                base = ".".join([*package, *([base] if base else [])])
            yield node.lineno, base
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)


def target_room(module: str) -> str | None:
    """The room of an imported module; None for packages of others and for `popgen` itself."""
    first, *rest = module.split(".")
    if first == "popgen":
        is_room = bool(rest) and ((ROOT / "popgen" / rest[0]).is_dir() or (ROOT / "popgen" / f"{rest[0]}.py").is_file())
        return rest[0] if is_room else None
    return first if first in TOP else None


def test_every_room_has_a_place() -> None:
    rooms = {room(path) for path in sources(*TOP)} - {"__init__"}
    assert rooms <= set(ORDER), f"give {sorted(rooms - set(ORDER))} a place in ORDER"


def test_imports_go_one_way() -> None:
    wrong = []
    for path in sources(*TOP):
        here = room(path)
        for line, module in imports(path):
            there = target_room(module)
            if there is None or there == here:
                continue
            upward = here == "__init__" or ORDER.index(there) > ORDER.index(here)
            if upward and (here, there) not in UPWARD:
                wrong.append(f"{path.relative_to(ROOT)}:{line} {here} imports {there}")
    assert not wrong, "\n".join(sorted(set(wrong)))


@pytest.mark.parametrize("package", OWNERS)
def test_heavy_packages_stay_in_their_places(package: str) -> None:
    users = [path for path in sources(*TOP) if any(module.partition(".")[0] == package for _, module in imports(path))]
    owners = [ROOT / name for name in OWNERS[package]]
    used = {owner for owner in owners if any(path.is_relative_to(owner) for path in users)}
    strangers = [path for path in users if not any(path.is_relative_to(owner) for owner in owners)]
    assert used == set(owners) and not strangers


@pytest.mark.parametrize(
    "module", ["popgen.methods.xpm_wm.replay", "popgen.actors.samplers", "popgen.actors.tracker_actor", "popgen.cli"]
)
def test_processes_that_learn_nothing_load_no_torch(module: str) -> None:
    """It takes each of them seconds and 200 MB; a sampler loads it with its first policy that is a network."""
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_the_reader_of_imports_sees_every_form(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    path = tmp_path / "popgen" / "envs" / "x.py"
    path.parent.mkdir(parents=True)
    path.write_text(
        "import a.b\ndef f():\n    from popgen import algos\n    from ..nets import c\n    from . import d\n"
    )
    (tmp_path / "popgen" / "algos").mkdir()
    (tmp_path / "popgen" / "nets").mkdir()
    found = {module for _, module in imports(path)}
    assert {"a.b", "popgen.algos", "popgen.nets", "popgen.nets.c", "popgen.envs.d"} <= found
    assert {target_room(module) for module in found} == {None, "algos", "nets", "envs"}
