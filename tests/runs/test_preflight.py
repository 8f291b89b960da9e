"""What is refused up front for want of room, and storages: in one line, before anything starts."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.runs import preflight as module
from popgen.runs import sizes
from popgen.runs.preflight import memory_bytes, preflight

GIB = 2**30


def configured(root: Path, *overrides: str) -> RunConfig:
    return RunConfig.parse(compose(["tracking=off", f"run.root={root}/runs", *overrides]))


def needed(config: RunConfig) -> tuple[int, int]:
    """The folder's bytes and its copy's."""
    spec = make_env(config.env.name, 1, **config.env.params).spec
    needs = sizes.needs_of(config, spec)
    return sizes.disk_bytes(config, needs), sizes.copy_bytes(config, needs)


def refusal(config: RunConfig) -> UserError:
    with pytest.raises(UserError) as caught:
        preflight(config)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.fixture
def free(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Sets the bytes that any disk has left."""

    def have(count: int) -> None:
        monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=count))

    return have


@pytest.fixture
def memory(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Sets the bytes of memory that this machine has."""
    return lambda count: monkeypatch.setattr(module, "memory_bytes", lambda: count)


@pytest.mark.parametrize("uri", ["bad", "bad://x", "s3:///", "file:///proc/nothing/below", "file://"])
def test_a_storage_that_cannot_be_is_refused(uri: str, tmp_path: Path) -> None:
    assert refusal(configured(tmp_path, f"run.storage={uri}")).field == "run.storage"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("uri", ["file://{}/store", "local://{}/store", "memory://popgen/store"])
def test_a_storage_that_can_be_is_taken_and_left_alone(uri: str, tmp_path: Path) -> None:
    preflight(configured(tmp_path, f"run.storage={uri.format(tmp_path)}"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("uri", ["file://{}/store", "local://{}/store"])
def test_a_copy_on_the_same_disk_needs_room_beside_the_run(uri: str, tmp_path: Path, free: Any) -> None:
    alone, copied = configured(tmp_path), configured(tmp_path, f"run.storage={uri.format(tmp_path)}")
    folder, copy = needed(alone)
    free(folder)
    preflight(alone)
    assert refusal(copied).field == "run.storage"
    free(folder + copy - 1)
    assert refusal(copied).field == "run.storage"
    free(folder + copy)
    preflight(copied)
    free(folder - 1)
    assert refusal(alone).field == "run.root"


def test_a_copy_on_another_disk_needs_its_own_room(tmp_path: Path, free: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    config = configured(tmp_path, f"run.storage=file://{tmp_path}/elsewhere")
    monkeypatch.setattr(module, "_device", lambda path: int("elsewhere" in path.name))
    free(max(needed(config)))
    preflight(config)
    free(max(needed(config)) - 1)
    assert refusal(config).field == "run.storage"


def test_mlflows_copy_of_the_population_needs_room(tmp_path: Path, free: Any) -> None:
    plain = configured(tmp_path)
    tracked = plain.model_copy(update={"tracking": plain.tracking.model_copy(update={"enabled": True})})
    free(needed(plain)[0])
    preflight(plain)
    assert refusal(tracked).field == "run.root" and needed(tracked)[0] > needed(plain)[0]


@pytest.mark.parametrize(
    ("overrides", "field"),
    [
        (["replay.capacity=40000000"], "replay.capacity"),
        (["method=xpm_sim", "xpm_sim.capacity=40000000"], "xpm_sim.capacity"),
        (["agent.horizon=1000", "agent.starts_sp=10000"], "agent.horizon"),
        (["method=xpm_sim", "xpm_sim.unroll=100000", "xpm_sim.sims_sp=1000"], "xpm_sim.unroll"),
        (["method=lipo", "ppo.envs=10000", "ppo.steps=4000"], "ppo.envs"),
        (["cluster.object_store_bytes=9000000000"], "cluster.object_store_bytes"),
    ],
)
def test_what_the_memory_cannot_hold_is_refused(
    overrides: list[str], field: str, tmp_path: Path, memory: Any, free: Any
) -> None:
    config = configured(tmp_path, *overrides)
    free(2**50)
    memory(8 * GIB)
    assert refusal(config).field == field
    memory(2**50)
    preflight(config)
    memory(8 * GIB)
    elsewhere = config.model_copy(update={"cluster": config.cluster.model_copy(update={"address": "auto"})})
    if config.method == "lipo":  # learns in the driver's process, in a cluster too
        assert refusal(elsewhere).field == field
    else:
        preflight(elsewhere)


def test_an_object_store_of_rays_choice_must_be_large_enough(tmp_path: Path, memory: Any) -> None:
    config = configured(tmp_path, "replay.capacity=1000000")
    spec = make_env(config.env.name, 1, **config.env.params).spec
    enough = sizes.store_bytes(sizes.needs_of(config, spec))
    memory(int(enough / module.RAYS_SHARE) - 2**20)
    told = refusal(config)
    assert (told.field, told.fix) == ("cluster.object_store_bytes", "set it, or lower replay.capacity")
    for given, taken in ((enough - 1, False), (enough, True)):
        cluster = config.cluster.model_copy(update={"object_store_bytes": given})
        fixed = config.model_copy(update={"cluster": cluster})
        if taken:
            preflight(fixed)
        else:
            assert refusal(fixed).field == "cluster.object_store_bytes"


def test_a_container_has_the_memory_of_its_limit(tmp_path: Path) -> None:
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limits = {"none": "max\n", "small": "123456789\n", "huge": f"{2**62}\n"}
    for name, text in limits.items():
        (tmp_path / name).write_text(text)
    assert memory_bytes([str(tmp_path / "none"), str(tmp_path / "gone")]) == physical
    assert memory_bytes([str(tmp_path / "none"), str(tmp_path / "small")]) == 123456789
    assert memory_bytes([str(tmp_path / "huge")]) == physical
