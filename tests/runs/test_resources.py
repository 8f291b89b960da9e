"""What the actors of each method ask for, and where they find room."""

from __future__ import annotations

from typing import Any

import pytest

from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.runs.preflight import check_cluster
from popgen.runs.resources import check_room, demands, places, total

NODES = [{"CPU": 6.0, "simulation": 6.0}, {"CPU": 2.0, "GPU": 1.0}]


def config(method: str = "xpm_wm", runners: int = 0, **cluster: Any) -> RunConfig:
    env = {"name": "overcooked/cramped_room"}
    own = {"ppo": {"runners": runners}} if runners else {}
    return RunConfig.parse({"method": method, "env": env, **own, "cluster": cluster})


@pytest.mark.parametrize(
    ("method", "asked"),
    [
        ("xpm_wm", {"CPU": 3 * 0.5 + 2 * 0.25 + 0.75 + 1.0, "GPU": 1.5, "disk": 7.0}),
        ("xpm_sim", {"CPU": 3 * 0.5 + 1.0, "disk": 4.0}),
        ("lipo", {"CPU": 5 * 0.5, "disk": 5.0}),
    ],
)
def test_each_method_asks_for_its_own_actors_alone(method: str, asked: dict[str, float]) -> None:
    runners = 5 if method == "lipo" else 0
    cpus = {"sampler_cpus": 0.5, "replay_cpus": 0.25, "model_cpus": 0.75, "agent_cpus": 1.0}
    wanted = config(method, runners, samplers=3, model_gpus=1.0, agent_gpus=0.5, resources={"disk": 1.0}, **cpus)
    assert total(demands(wanted)) == asked


def test_nodes_that_have_room_are_taken() -> None:
    check_room(demands(config(samplers=2, sampler_cpus=3.0, agent_cpus=0.5)), NODES)
    check_room(demands(config(samplers=4, sampler_cpus=1.0, model_gpus=0.5, agent_gpus=0.5)), NODES)
    check_room(demands(config("xpm_sim", agent_gpus=4.0)), NODES)
    check_room(demands(config("mappo", model_gpus=4.0, agent_gpus=4.0, model_cpus=99.0)), NODES)


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"samplers": 8, "sampler_cpus": 1.0}, "cluster: the actors ask for 9.8 CPU, the cluster has 8"),
        ({"model_gpus": 1.0, "agent_gpus": 1.0}, "2 GPU, the cluster has 1"),
        ({"samplers": 3, "resources": {"simulation": 1.0}}, "7 simulation, the cluster has 6"),
        ({"resources": {"tpu": 0.1}}, "0.5 tpu, the cluster has 0"),
        ({"agent_cpus": 6.5}, "cluster.agent_cpus: 1 of 6.5 CPU each, the nodes have room for 0"),
        ({"model_cpus": 2.5, "model_gpus": 1.0}, "cluster.model_cpus: 1 of 2.5 CPU and 1 GPU each, .* room for 0"),
        ({"samplers": 2, "sampler_cpus": 3.1, "agent_cpus": 0.1}, "cluster.sampler_cpus: 2 of 3.1 CPU .* room for 1"),
        ({"method": "lipo", "runners": 9, "sampler_cpus": 1.0}, "the actors ask for 9 CPU, the cluster has 8"),
    ],
)
def test_actors_that_would_wait_for_ever_are_refused(asked: dict[str, Any], told: str) -> None:
    with pytest.raises(UserError, match=told):
        check_room(demands(config(**asked)), NODES)


def test_places_are_counted_node_by_node() -> None:
    nodes = [{"CPU": 2.0, "card": 1.0}, {"CPU": 1.5}, {}]
    assert places({"CPU": 1.0}, nodes, 9) == 3
    assert places({"CPU": 0.1}, nodes, 99) == 35 and places({"CPU": 0.1}, nodes, 4) == 4
    assert places({"CPU": 1.0, "card": 1.0}, nodes, 9) == 1
    assert places({}, nodes, 9) == 9


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"num_cpus": 1}, "cluster.num_cpus: 1, but the actors ask for 1.9"),
        ({"method": "mappo", "runners": 3, "num_cpus": 1, "sampler_cpus": 0.5}, "the actors ask for 1.5"),
        ({"model_gpus": 64.0}, "cluster.model_gpus: the learners ask for 64 GPUs"),
        ({"method": "xpm_sim", "resources": {"tpu": 1.0}}, "cluster.resources.tpu: is a resource"),
    ],
)
def test_a_local_ray_is_compared_before_it_starts(asked: dict[str, Any], told: str) -> None:
    with pytest.raises(UserError, match=told):
        check_cluster(config(**asked))
    asked["address"] = "auto"
    check_cluster(config(**asked))
