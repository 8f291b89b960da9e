"""A Ray of the run's own: its size, and starts that fail."""

from __future__ import annotations

import pytest

from popgen.actors import local_ray
from popgen.config.run_config import RunConfig
from popgen.errors import UserError


def config(**cluster: object) -> RunConfig:
    return RunConfig.parse({"env": {"name": "overcooked/cramped_room"}, "cluster": cluster})


def test_a_cluster_that_does_not_answer_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody(**_: object) -> None:
        raise ConnectionError("Could not find any running Ray instance.")

    monkeypatch.setattr(local_ray.ray, "is_initialized", lambda: False)
    monkeypatch.setattr(local_ray.ray, "init", nobody)
    with pytest.raises(UserError, match="cluster.address: no Ray answers"):
        local_ray.start_ray(config(address="auto"))


def test_a_local_ray_has_room_for_all_actors(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[dict] = []
    monkeypatch.setattr(local_ray.ray, "is_initialized", lambda: False)
    monkeypatch.setattr(local_ray.ray, "init", lambda **options: given.append(options))
    monkeypatch.setattr(local_ray, "count_cores", lambda: 1)
    for cluster in ({}, {"samplers": 12, "sampler_cpus": 1.0}, {"num_cpus": 7}):
        assert local_ray.start_ray(config(**cluster))
    assert [options["num_cpus"] for options in given] == [2, 14, 7]


def starting(monkeypatch: pytest.MonkeyPatch, *outcomes: Exception | None) -> list[str]:
    """Ray's starts end as given, one after the other; what was called."""
    calls, left = [], list(outcomes)

    def init(**arguments: object) -> None:
        calls.append("init")
        if (outcome := left.pop(0)) is not None:
            raise outcome

    monkeypatch.setattr(local_ray.ray, "is_initialized", lambda: False)
    monkeypatch.setattr(local_ray.ray, "init", init)
    monkeypatch.setattr(local_ray.ray, "shutdown", lambda: calls.append("shutdown"))
    return calls


LATE = Exception("The current node timed out during startup. This could happen ...")


def test_a_ray_that_gave_up_on_a_busy_machine_is_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = starting(monkeypatch, LATE, LATE, None)
    assert local_ray.start_ray(config())
    assert calls == ["init", "shutdown"] * 2 + ["init"]


def test_a_machine_too_busy_for_ray_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    starting(monkeypatch, *[LATE] * local_ray.STARTS)
    with pytest.raises(UserError, match="did not come up in 4 tries"):
        local_ray.start_ray(config())


def test_another_error_of_ray_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = starting(monkeypatch, RuntimeError("something else"))
    with pytest.raises(RuntimeError, match="something else"):
        local_ray.start_ray(config())
    assert calls == ["init"]
