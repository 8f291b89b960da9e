"""popgen installed from a wheel beside a project with rooms of the same names, and uploaded to a cluster by Ray."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from conftest import ROOT

SOURCES = (
    "popgen",
    "actors",
    "pipelines",
    "conf",
    "pyproject.toml",
    "README.md",
    "LICENSE",
    ".gitignore",
    ".rayignore",
)
ROOMS = ("actors", "pipelines", "conf")  # at the top level, linked into popgen/
RUN = ("run", "method=mappo", "scale=smoke", "population.size=1", "run.root=runs", "run.id=one", "tracking=off")


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sources alone, links kept, as in a new clone."""
    folder = tmp_path_factory.mktemp("checkout")
    for name in SOURCES:
        path = ROOT / name
        if path.is_dir():
            shutil.copytree(
                path, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", "*.nb[ic]")
            )
        else:
            shutil.copy(path, folder / name)
    return folder


@pytest.fixture(scope="module")
def wheel(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel that pip builds."""
    folder = tmp_path_factory.mktemp("wheels")
    options = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(folder))
    subprocess.run([sys.executable, "-m", "pip", "wheel", *options, str(checkout)], check=True, timeout=240)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's project whose own packages have the names of popgen's rooms."""
    folder = tmp_path_factory.mktemp("project")
    for name in ROOMS:
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text("raise ImportError('this package belongs to somebody else')\n")
    return folder


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment variables of a process that finds the installed popgen and not this checkout."""
    target = tmp_path_factory.mktemp("site")
    options = ("--quiet", "--no-deps", "--no-index", "--target", str(target))
    subprocess.run([sys.executable, "-m", "pip", "install", *options, str(wheel)], check=True, timeout=240)
    return {**os.environ, "PYTHONPATH": str(target)}


def run_popgen(words: tuple[str, ...], folder: Path, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """`python -m popgen WORDS` in a folder, which Python searches first."""
    command = [sys.executable, "-m", "popgen", *words]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=240, check=False
    )


def test_the_wheel_holds_every_file_of_the_rooms(wheel: Path, checkout: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    wanted = {
        path.relative_to(checkout).as_posix()
        for room in (*ROOMS, *(f"popgen/{path.name}" for path in (checkout / "popgen").iterdir() if path.is_dir()))
        for path in (checkout / room).rglob("*")
        if path.suffix in (".py", ".yaml", ".layout", ".txt")
    }
    wanted = {name if name.startswith("popgen/") else f"popgen/{name}" for name in wanted} | {"popgen/py.typed"}
    assert wanted <= names, sorted(wanted - names)[:9]
    assert {name.partition("/")[0] for name in names if not name.startswith("popgen_zsc-")} == {"popgen"}


@pytest.mark.end_to_end
def test_every_group_of_the_configuration_is_found_beside_other_packages(
    project: Path, environment: dict[str, str]
) -> None:
    program = "import popgen.conf, popgen.actors, popgen.pipelines, sys; print(popgen.conf.DIRECTORY)"
    where = subprocess.run(
        [sys.executable, "-c", program], cwd=project, env=environment, capture_output=True, text=True, check=True
    )
    assert Path(where.stdout.strip()) == Path(environment["PYTHONPATH"]) / "popgen" / "conf"
    done = run_popgen(("run", "--dry-run", "scale=smoke"), project, environment)
    assert done.returncode == 0, done.stderr


@pytest.mark.ray
def test_a_run_beside_other_packages(project: Path, environment: dict[str, str]) -> None:
    done = run_popgen(RUN, project, environment)
    assert done.returncode == 0, done.stderr
    assert (project / "runs" / "one" / "population" / "manifest.json").is_file()


def test_rays_upload_follows_the_links(checkout: Path, tmp_path: Path) -> None:
    from ray._private.runtime_env.packaging import create_package

    create_package(str(checkout), tmp_path / "upload.zip", include_gitignore=True)
    names = set(zipfile.ZipFile(tmp_path / "upload.zip").namelist())
    for room in ROOMS:
        assert f"popgen/{room}/__init__.py" in names
    assert {f"popgen/{path.relative_to(checkout)}" for path in (checkout / "conf").rglob("*.yaml")} <= names
