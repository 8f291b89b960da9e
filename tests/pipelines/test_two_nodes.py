"""Two nodes emulated on this machine: actors go where their resources are, and a node's death changes nothing."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import ray
from ray.cluster_utils import Cluster

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.methods.training import Collected
from popgen.pipelines import population as main_job
from popgen.pipelines.population import run_population
from popgen.population import load_population
from popgen.progress import NullReporter
from popgen.runs.ledger import Ledger
from popgen.runs.recorder import RunRecorder

pytestmark = pytest.mark.timeout(1800)  # it may wait for the other file that starts nodes
QUICK = {"health_check_initial_delay_ms": 1000, "health_check_period_ms": 500, "health_check_failure_threshold": 4}
"""A dead node is noticed in seconds."""


@pytest.fixture(scope="module")
def nodes(one_cluster_at_a_time: None) -> Iterator[Cluster]:
    """A head that has no room for actors, and a node that has."""
    folder = tempfile.mkdtemp(prefix="pg-", dir="/tmp")  # Ray's sockets need a short path
    head = {"num_cpus": 0, "temp_dir": folder, "include_dashboard": False, "_system_config": QUICK}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    cluster.add_node(num_cpus=4, resources={"far": 100})
    yield cluster
    ray.shutdown()
    cluster.shutdown()
    shutil.rmtree(folder, ignore_errors=True)


def run(cluster: Cluster, root: Path, name: str, at_record: Callable[[int, Any], None]) -> Path:
    """A run of one member with two samplers; `at_record` is called with the number of each round taken in, before it
    is. Its folder."""
    overrides = ["scale=smoke", "tracking=off", "population.size=1", "env.params.horizon=40", "seed=3"]
    overrides += [f"cluster.address={cluster.address}", "cluster.resources.far=1", "cluster.samplers=2"]
    overrides += ["evaluation.episodes=1", f"run.root={root}", f"run.id={name}"]
    trainings: list[Any] = []
    calls: list[int] = []
    open_training = main_job.open_training

    def opened(*arguments: Any) -> Any:
        trainings.append(open_training(*arguments))
        return trainings[-1]

    class Listening(RunRecorder):
        def record_sampling(self, member: int, sampled: Collected) -> None:
            calls.append(member)
            at_record(len(calls), trainings[-1].work)
            super().record_sampling(member, sampled)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(main_job, "open_training", opened)
        patch.setattr(main_job, "RunRecorder", Listening)
        run_population(RunConfig.parse(compose(overrides)), reporter=NullReporter())
    return root / name


def outcome(folder: Path) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Weights and ledger, but for what tells runs and attempts apart."""
    entries = Ledger(folder / "ledger.jsonl")
    weights = [info.policy_sha256 for info in load_population(folder / "population").members]
    return weights, [(e.member, e.kind, e.sampler.partition(".")[0], e.steps, e.episodes, e.score) for e in entries]


def node_of(actor: Any) -> str:
    return ray.get(actor.__ray_call__.remote(lambda _: ray.get_runtime_context().get_node_id()))


def test_a_run_spreads_over_nodes_and_outlives_one(nodes: Cluster, tmp_path: Path) -> None:
    """All actors are on the second node. It is killed in the third round; another one comes."""
    placed: set[str] = set()

    def look(call: int, work: Any) -> None:
        if call == 1:
            workers = (*work.pool.samplers, *work.replays.values(), work.model, work.agent)
            placed.update(node_of(worker.handle) for worker in workers)
            placed.add(f"driver {ray.get_runtime_context().get_node_id()}")

    def strike(call: int, work: Any) -> None:
        if call == 5:
            (far,) = nodes.worker_nodes
            nodes.remove_node(far, allow_graceful=False)
            nodes.add_node(num_cpus=4, resources={"far": 100})

    whole = run(nodes, tmp_path, "whole", look)
    assert len(placed) == 2 and len({name.removeprefix("driver ") for name in placed}) == 2
    struck = run(nodes, tmp_path, "struck", strike)
    assert outcome(struck) == outcome(whole)
    events = [json.loads(line) for line in (struck / "run.log").read_text().splitlines()]
    assert [row["event"] for row in events].count("lost") == 1 and events[-1]["status"] == "FINISHED"
    assert len((struck / "attempts.txt").read_text().splitlines()) == 2
