"""Whole runs of MAPPO, LIPO and CoMeDi at `scale=smoke`: ledger, population, going on after an interruption."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import ray

from pipelines import baselines
from pipelines.books import Books
from pipelines.population import driver_class, run_population
from popgen.cli import compose
from popgen.config import RunConfig
from popgen.data.ledger import Ledger
from popgen.errors import UserError
from popgen.population import load_population
from popgen.preflight import preflight
from popgen.progress import NullReporter
from popgen.rllib.algorithm import Mappo as Algorithm

HORIZON = 40
SP_STEPS = 240
"""Of each member: three iterations of 4 environments and 20 steps."""


class Killed(RuntimeError):
    """Injected where a driver could be killed."""


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[None]:
    """A Ray of this module's own; its sockets need a short path."""
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


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


def smoke(root: Path, name: str, *overrides: str) -> RunConfig:
    base = ["scale=smoke", "tracking=off", f"env.params.horizon={HORIZON}", "seed=3", "evaluation.episodes=1"]
    return RunConfig.parse(compose([*base, f"run.root={root}", f"run.id={name}", *overrides]))


def launch(root: Path, name: str, *overrides: str, die_at: str = "") -> tuple[dict[str, Any], Counter[tuple[int, str]]]:
    """Run it; also what the algorithms said they stepped. The run dies at the N-th call of METHOD (`METHOD:N`)."""
    calls: Counter[str] = Counter()
    said: Counter[tuple[int, str]] = Counter()

    def called(method: str) -> None:
        calls[method] += 1
        if f"{method}:{calls[method]}" == die_at:
            raise Killed(die_at)

    with pytest.MonkeyPatch.context() as patch:

        def train(self: Algorithm, original: Any = Algorithm.train) -> Any:
            called("train")
            result = original(self)
            for counted in self.report.counted:
                said[counted.owner, str(counted.kind)] += counted.steps
            return result

        def save(folder: Path, state: dict[str, Any], original: Any = baselines.save_state) -> None:
            called("save")
            original(folder, state)

        def add(self: Books, *given: Any, original: Any = Books.add_member, **named: Any) -> None:
            called("add")
            original(self, *given, **named)
            called("added")

        patch.setattr(Algorithm, "train", train)
        patch.setattr(baselines, "save_state", save)
        patch.setattr(Books, "add_member", add)
        return run_population(smoke(root, name, *overrides), reporter=NullReporter()), said


def training(ledger: dict[str, dict[str, int]]) -> dict[tuple[int, str], int]:
    """Steps by member and kind, without evaluation and totals."""
    return {
        (int(member), kind): steps
        for member, row in ledger.items()
        if member != "total"
        for kind, steps in row.items()
        if kind in ("SP", "XP", "MP") and steps
    }


def entries(folder: Path) -> list[tuple[Any, ...]]:
    """The ledger, but for what tells attempts apart."""
    return [(e.member, e.kind, e.sequence, e.steps, e.episodes, e.score) for e in Ledger(folder / "ledger.jsonl")]


def sha256s(folder: Path) -> list[str]:
    return [info.policy_sha256 for info in load_population(folder / "population").members]


SIZES = {"mappo": "population.size=2", "lipo": "population.size=3", "comedi": "population.size=3"}


@pytest.fixture(scope="module")
def runs(root: Path) -> dict[str, tuple[dict[str, Any], Counter[tuple[int, str]]]]:
    return {method: launch(root, method, f"method={method}", size) for method, size in SIZES.items()}


@pytest.mark.parametrize("method", SIZES)
def test_the_ledger_holds_what_the_runners_stepped(method: str, runs: dict[str, Any]) -> None:
    result, said = runs[method]
    assert training(result["ledger"]) == dict(said)
    info = load_population(result["population"]).members
    for member in info:
        row = {kind: steps for (owner, kind), steps in said.items() if owner == member.id}
        assert member.steps == row and row["SP"] == SP_STEPS and member.seed == 3000 + member.id


def test_steps_by_kind(runs: dict[str, Any]) -> None:
    """Cross-play has 4 environments with each partner, mixed play 4 with the strongest; CoMeDi chooses it by an
    episode with each partner in each seat at iterations 1 and 3."""
    assert set(runs["mappo"][1]) == {(1, "SP"), (2, "SP")}
    lipo, comedi = runs["lipo"][1], runs["comedi"][1]
    assert [lipo[m, "XP"] for m in (1, 2, 3)] == [0, SP_STEPS, 2 * SP_STEPS]
    assert [comedi[m, "MP"] for m in (1, 2, 3)] == [0, SP_STEPS, SP_STEPS]
    fresh = 2 * 2 * HORIZON
    assert [comedi[m, "XP"] for m in (1, 2, 3)] == [0, SP_STEPS + fresh, SP_STEPS + 2 * fresh]


def test_members_act_without_rllib(runs: dict[str, Any]) -> None:
    """Loaded and played in a process that then holds neither Ray nor RLlib."""
    code = (
        "import sys, numpy as np, popgen\n"
        "population = popgen.load_population(sys.argv[1])\n"
        "env = population.make_env(4)\n"
        "for policy in population:\n"
        "    policy.reset(4, 0)\n"
        "    actions = policy.act(env.observe(policy.view), np.zeros((4, 2), np.uint8), np.ones(4, bool))\n"
        "    assert actions.shape == (4, 2)\n"
        "assert not {'ray', 'mlflow', 'hydra'} & set(sys.modules)\n"
    )
    for method in ("lipo", "comedi"):
        subprocess.run([sys.executable, "-c", code, runs[method][0]["population"]], check=True, timeout=120)


def test_critics_are_kept_by_kind_and_partner(runs: dict[str, Any]) -> None:
    expected = {
        "mappo": [{"SP"}, {"SP"}],
        "lipo": [{"SP", "XP_2", "XP_3"}, {"SP", "XP_1", "XP_3"}, {"SP", "XP_1", "XP_2"}],
        "comedi": [{"SP"}, {"SP", "XP_1", "MP_1"}, {"SP", "XP_1", "XP_2", "MP_1", "MP_2"}],
    }
    for method, names in expected.items():
        population = load_population(runs[method][0]["population"])
        assert [
            {name.split(".")[1] for name in population.training(m) or {}} for m in range(1, len(names) + 1)
        ] == names


def test_members_differ(runs: dict[str, Any]) -> None:
    for result, _ in runs.values():
        found = sha256s(Path(result["run_dir"]))
        assert len(set(found)) == len(found)


def test_metrics_tell_what_training_did(runs: dict[str, Any]) -> None:
    rows = [json.loads(line) for line in (Path(runs["comedi"][0]["run_dir"]) / "metrics.jsonl").open()]
    last = [row for row in rows if row["member"] == 3]
    wanted = {"ppo/entropy", "ppo/xp_reward", "ppo/mp_reward", "ppo/kl", "real_xp"}
    assert len(last) == 3 and wanted <= set().union(*last)
    assert last[-1]["step"] == sum(steps for (m, _), steps in runs["comedi"][1].items() if m == 3)


def test_sequential_lipo_meets_its_predecessors_only(root: Path) -> None:
    result, said = launch(root, "sequential", "method=lipo", "population.size=2", "diversity.order=sequential")
    assert said == {(1, "SP"): SP_STEPS, (2, "SP"): SP_STEPS, (2, "XP"): SP_STEPS}
    assert "XP_1" in str(load_population(result["population"]).training(2).keys())


DEATHS = {
    "mappo": ("train:2", "save:1", "save:4", "add:1", "added:1", "train:4"),
    "lipo": ("train:3", "add:1", "added:1", "added:2"),
    "comedi": ("train:5", "save:7", "added:2"),
}
"""Before an iteration; before its checkpoint is written; before and after a member is added."""


@pytest.mark.parametrize(("method", "die_at"), [(m, at) for m, points in DEATHS.items() for at in points])
def test_a_killed_run_ends_as_one_that_was_not(method: str, die_at: str, root: Path, runs: dict[str, Any]) -> None:
    whole, name = Path(runs[method][0]["run_dir"]), f"{method}_{die_at.replace(':', '_')}"
    with pytest.raises(Killed):
        launch(root, name, f"method={method}", SIZES[method], die_at=die_at)
    result, _ = launch(root, name, f"method={method}", SIZES[method])
    assert sha256s(root / name) == sha256s(whole)
    assert entries(root / name) == entries(whole)
    assert training(result["ledger"]) == training(runs[method][0]["ledger"])


def test_what_cannot_be_is_refused_before_anything_starts(root: Path) -> None:
    def refusal(*overrides: str) -> str:
        with pytest.raises(UserError) as caught:
            preflight(smoke(root, "refused", *overrides))
        return caught.value.field

    assert refusal("method=comedi", "diversity.order=concurrent") == "diversity.order"
    grid = ("ppo.view=lossless", "ppo.cnn_kernels=[3]")
    assert refusal("method=mappo", "env=rendezvous/mppmr", "~env.params.horizon", *grid) == "ppo.view"
    assert refusal("method=mappo", "ppo.runners=3", "cluster.num_cpus=1", "cluster.sampler_cpus=0.5") == (
        "cluster.num_cpus"
    )


def test_every_method_has_its_driver() -> None:
    found = {method: driver_class(method) for method in SIZES}
    assert found == {"mappo": baselines.Mappo, "lipo": baselines.Lipo, "comedi": baselines.CoMeDi}
