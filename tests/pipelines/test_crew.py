from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from popgen.actors.sampler_actor import PolicySnapshot
from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.pipelines import crew
from popgen.pipelines import sampler_pool as play
from popgen.pipelines.sampler_pool import seed_of
from popgen.play.sampler import Match
from popgen.types import Kind


def config(**cluster: object) -> RunConfig:
    return RunConfig.parse({"env": {"name": "overcooked/cramped_room"}, "cluster": cluster})


def test_a_cluster_that_does_not_answer_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody(**_: object) -> None:
        raise ConnectionError("Could not find any running Ray instance.")

    monkeypatch.setattr(crew.ray, "is_initialized", lambda: False)
    monkeypatch.setattr(crew.ray, "init", nobody)
    with pytest.raises(UserError, match="cluster.address: no Ray answers"):
        crew.start_ray(config(address="auto"))


def test_a_local_ray_has_room_for_all_actors(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[dict] = []
    monkeypatch.setattr(crew.ray, "is_initialized", lambda: False)
    monkeypatch.setattr(crew.ray, "init", lambda **options: given.append(options))
    monkeypatch.setattr(crew.os, "cpu_count", lambda: 1)
    for cluster in ({}, {"samplers": 12, "sampler_cpus": 1.0}, {"num_cpus": 7}):
        assert crew.start_ray(config(**cluster))
    assert [options["num_cpus"] for options in given] == [2, 14, 7]


def test_weights_are_stored_once_for_each_version_whoever_plays_with_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samplers get references: what is behind one goes to a node once."""
    stored: list[object] = []
    opened: list[dict] = []
    monkeypatch.setattr(play.ray, "put", lambda value: stored.append(value) or f"reference {len(stored)}")
    monkeypatch.setattr(play.ray, "get", lambda references: None)

    class Sampler:
        open = SimpleNamespace(remote=lambda matches, parts, seed, stagger: opened.append(parts))

    players = play.SamplerPool([Sampler()] * 3)
    matches = [Match(Kind.XP, (1, 2), 6)]
    old, first, second = ({"w": np.zeros(3)} for _ in range(3))
    for newest in (first, first, second):
        players.open(matches, {1: PolicySnapshot("k", {}, old), 2: PolicySnapshot("k", {}, newest)}, seed=0)
    assert [parts.weights for parts in stored] == [old, first, second]
    a, b, c = "reference 1", "reference 2", "reference 3"
    assert opened == [{1: a, 2: b}] * 6 + [{1: a, 2: c}] * 3


def test_samplers_have_seeds_of_their_own() -> None:
    assert seed_of(7, 0) == 7
    assert len({seed_of(seed, index) for seed in range(20) for index in range(20)}) == 400


def starting(monkeypatch: pytest.MonkeyPatch, *outcomes: Exception | None) -> list[str]:
    """Ray's starts end as given, one after the other; what was called."""
    calls, left = [], list(outcomes)

    def init(**arguments: object) -> None:
        calls.append("init")
        if (outcome := left.pop(0)) is not None:
            raise outcome

    monkeypatch.setattr(crew.ray, "is_initialized", lambda: False)
    monkeypatch.setattr(crew.ray, "init", init)
    monkeypatch.setattr(crew.ray, "shutdown", lambda: calls.append("shutdown"))
    return calls


LATE = Exception("The current node timed out during startup. This could happen ...")


def test_a_ray_that_gave_up_on_a_busy_machine_is_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = starting(monkeypatch, LATE, LATE, None)
    assert crew.start_ray(config())
    assert calls == ["init", "shutdown"] * 2 + ["init"]


def test_a_machine_too_busy_for_ray_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    starting(monkeypatch, *[LATE] * crew.STARTS)
    with pytest.raises(UserError, match="did not come up in 4 tries"):
        crew.start_ray(config())


def test_another_error_of_ray_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = starting(monkeypatch, RuntimeError("something else"))
    with pytest.raises(RuntimeError, match="something else"):
        crew.start_ray(config())
    assert calls == ["init"]
