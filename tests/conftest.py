"""Shared by all tests: a quiet, offline, single-threaded process, and a small population on disk."""

from __future__ import annotations

import gc
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import support.checked_shapes  # noqa: F401  (before anything of popgen)
from filelock import FileLock
from support.stores import keep_tables

for _name, _value in {
    "RAY_USAGE_STATS_ENABLED": "0",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "OMP_NUM_THREADS": "1",
    "MPLBACKEND": "Agg",
}.items():
    os.environ.setdefault(_name, _value)

ROOT = Path(__file__).resolve().parent.parent
IN_MEMORY = Path("/dev/shm")  # tests sync and remove thousands of small files, slowly on a disk
if IN_MEMORY.is_dir() and shutil.disk_usage(IN_MEMORY).free > 4 * 2**30:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(IN_MEMORY))
WITH_CLUSTERS = ("test_service.py", "test_two_nodes.py")  # start clusters of processes and nodes


gc.disable()  # until all tests are imported: what they and their libraries are made of is never garbage


def pytest_collection_finish() -> None:
    """The collector runs again, and does not look at what was imported."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what needs Ray."""
    for item in items:
        if needs_ray(item):
            item.add_marker(pytest.mark.ray)


def needs_ray(item: pytest.Item) -> bool:
    """Whether a test uses a Ray of its module, or stands in a file that imports Ray or starts clusters."""
    assert isinstance(item, pytest.Function)
    return "cluster" in item.fixturenames or hasattr(item.module, "ray") or item.path.name in WITH_CLUSTERS


@pytest.fixture(scope="module")
def one_cluster_at_a_time(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """For files that start nodes: one that starves beside another worker's cluster counts as dead."""
    with FileLock(tmp_path_factory.getbasetemp().parent / "clusters.lock"):
        yield


@pytest.fixture(scope="session", autouse=True)
def kept_tables(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """MLflow, once a test needs it, makes the tables of a store once."""
    from popgen.runs.mlflow_tracker import Tracker

    open_store, kept = Tracker._open_store, tmp_path_factory.mktemp("mlflow") / "tables.db"

    def open_with_tables(tracker: Tracker) -> None:
        Tracker._open_store = open_store  # from now on it is MLflow that is other
        keep_tables(kept)
        open_store(tracker)

    Tracker._open_store = open_with_tables
    yield
    Tracker._open_store = open_store


@pytest.fixture(scope="session")
def random_population(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two uniformly random members for cramped_room with automatic cooking and episodes of 20 steps."""
    from popgen.envs import make_env
    from popgen.policies.simple_policies import RandomPolicy
    from popgen.population import PopulationWriter

    path = tmp_path_factory.mktemp("population") / "two_random"
    spec = make_env("overcooked/cramped_room", 1, cooking="auto", events="dispenser", horizon=20).spec
    writer = PopulationWriter(path, spec, method="xpm_wm", config_digest="0" * 64, seed=0)
    for member in (1, 2):
        writer.add_member(RandomPolicy(spec.num_actions), seed=member, steps={"SP": 100 * member, "XP": 10})
    return path


@pytest.fixture(scope="session")
def model_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's folder with two untrained members of the sizes of scale=smoke, and a checkpoint folder of the first."""
    from popgen.cli.compose import compose
    from popgen.config.run_config import RunConfig
    from popgen.envs import make_env
    from popgen.methods.xpm_wm.actor_critic import WorldModelPolicy
    from popgen.population import PopulationWriter

    run = tmp_path_factory.mktemp("run") / "old"
    (run / "checkpoints" / "member_001").mkdir(parents=True)
    config = RunConfig.parse(compose(["scale=smoke"]))
    spec = make_env(config.env.name, 1, **config.env.params).spec
    writer = PopulationWriter(run / "population", spec, method="xpm_wm", config_digest=config.digest(), seed=0)
    for member in (1, 2):
        writer.add_member(WorldModelPolicy(config.world_model, config.agent, spec), seed=member, steps={"SP": 1})
    (run / "config.json").write_text(json.dumps(config.model_dump(mode="json")))
    return run


@pytest.fixture
def run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[..., tuple[int, str, str]]:
    """`run(*argv)` in an empty folder -> exit code, stdout, stderr."""
    from popgen import cli

    monkeypatch.chdir(tmp_path)

    def call(*argv: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = cli.main(argv)
        out, err = capsys.readouterr()
        return code, out, err

    return call


@pytest.fixture
def quick_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Charts are drawn coarsely and without fitting their parts, for tests that look at other things; tests/reports
    draws them as users get them."""
    from matplotlib.figure import Figure

    save = Figure.savefig

    def save_coarsely(figure: Figure, path: Path, **options: Any) -> None:
        figure.set_layout_engine("none")
        save(figure, path, **{**options, "dpi": 40})

    monkeypatch.setattr(Figure, "savefig", save_coarsely)


@pytest.fixture
def new_parser() -> Iterator[None]:
    """The command line takes in a command that the test replaces, and forgets it after the test."""
    from popgen.cli.parser import _parser

    _parser.cache_clear()
    yield
    _parser.cache_clear()


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """A Ray of the module's own; its sockets need a short path."""
    import ray

    folder = tempfile.mkdtemp(prefix="pg-", dir="/tmp")
    ray.init(
        address="local",
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=False,
        logging_level="ERROR",
        _temp_dir=folder,
    )
    yield
    ray.shutdown()
    shutil.rmtree(folder, ignore_errors=True)
