"""`popgen bench mappo`: what it measures, at the sizes of scale=smoke."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.methods.mappo.algorithm import Counted, Report
from popgen.pipelines.bench_mappo import _train, bench_mappo
from popgen.types import Kind

pytestmark = pytest.mark.usefixtures("cluster")
SMALL = ("scale=smoke", "env.params.horizon=40", "tracking=off")


def config(*overrides: str) -> RunConfig:
    return RunConfig.parse(compose([*SMALL, "method=mappo", *overrides]))


def test_all_that_was_trained_is_in_the_figures() -> None:
    found = bench_mappo(config(), seconds=0.3)
    assert (found["env"], found["envs"], found["runners"], found["threads"]) == ("overcooked/cramped_room", 4, 0, 1)
    assert found["iterations"] >= 1 and found["steps"] == found["iterations"] * 4 * 20
    assert found["steps_per_second"] == pytest.approx(found["steps"] / found["seconds"], rel=0.05)
    assert found["steps_per_cpu_second"] == pytest.approx(found["steps"] / found["cpu_seconds"], rel=0.1)
    assert set(found["shares"]) == {"sampling", "pooling", "gradients", "rllib"}
    assert sum(found["shares"].values()) == pytest.approx(1.0, abs=0.003) and min(found["shares"].values()) >= 0


class Clock:
    """An algorithm of known speed: 1 s sampling, 0.5 s pooling, 2 s gradients, 0.5 s else."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.report = 0.0, Report()
        monkeypatch.setattr("time.perf_counter", lambda: self.now)
        monkeypatch.setattr("time.process_time", lambda: self.now / 2)

    def train(self) -> None:
        self.now += 4.0
        seconds = {"sampling": 1.0, "learning": 2.6, "pooling": 0.5, "gradients": 2.0}
        self.report = Report([Counted(0, 1, Kind.SP, 800, 0, 0.0)], {}, seconds)


def test_shares_and_rates_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three iterations of four seconds pass ten; the one before them is not counted."""
    found = _train(Clock(monkeypatch), 10.0)  # type: ignore[arg-type]
    assert (found["iterations"], found["steps"], found["seconds"], found["cpu_seconds"]) == (3, 2400, 12.0, 6.0)
    assert (found["steps_per_second"], found["steps_per_cpu_second"]) == (200, 400)
    assert found["shares"] == {"sampling": 0.25, "pooling": 0.125, "gradients": 0.5, "rllib": 0.125}


def test_the_command_prints_it(run: Callable[..., tuple[int, str, str]]) -> None:
    code, out, _ = run("bench", "mappo", "--json", "--seconds", "0.1", *SMALL)
    assert code == 0 and json.loads(out)["steps"] > 0
    code, out, _ = run("bench", "mappo", "--seconds", "0.1", *SMALL)
    assert code == 0 and "environment steps a second end to end (sampling " in out and "1 threads" in out


def test_what_is_not_there_is_told_in_one_line() -> None:
    """A Ray of two cores is there already: runners that it has no room for would be waited for, for ever."""
    with pytest.raises(UserError, match="the actors ask for 3 CPU, the cluster has 2"):
        bench_mappo(config("ppo.runners=3", "cluster.sampler_cpus=1", "cluster.wait_seconds=0"), seconds=0.1)
