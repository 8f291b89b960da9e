"""Whole runs of XPM-Sim at `scale=smoke`: the books, twice the same, interrupted anywhere, both schedules."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import ray
from local_crew import Handle

from actors.exact_learner import ExactLearnerActor
from actors.sampler import SamplerActor
from pipelines import population as main_job
from pipelines import xpm_sim as pipeline
from pipelines.books import Books
from pipelines.checkpoints import Checkpoints
from pipelines.play import Players
from pipelines.population import run_population
from pipelines.xpm_sim import Member
from popgen.cli import compose
from popgen.config import RunConfig
from popgen.data.ledger import Ledger
from popgen.population import load_population
from popgen.progress import NullReporter
from popgen.types import Kind

pytestmark = pytest.mark.filterwarnings("ignore:The given NumPy array is not writable")  # as in the actors

HORIZON, ROUNDS = 20, 2


class Killed(RuntimeError):
    """Injected where a driver could be killed."""


class LocalCrew(pipeline.Crew):
    """The actors' objects in this process."""

    @staticmethod
    def hire(config: RunConfig, attempt: str) -> LocalCrew:
        names = [f"sampler{i}.{attempt}" for i in range(config.cluster.samplers)]
        samplers = [Handle(SamplerActor(config.env, name, 1)) for name in names]
        return LocalCrew(Players(samplers), Handle(ExactLearnerActor(config, 1)))

    def dismiss(self) -> None:
        """There is nobody to send away."""


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """A Ray of this module's own; its sockets need a short path."""
    folder = tempfile.mkdtemp(prefix="pg-", dir="/tmp")
    options = {"include_dashboard": False, "log_to_driver": False, "logging_level": "ERROR"}
    ray.init(address="local", num_cpus=2, _temp_dir=folder, **options)
    yield
    ray.shutdown()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, cluster: None) -> Path:
    return tmp_path_factory.mktemp("runs")


def launch(root: Path, name: str, *overrides: str, local: bool = True, die_at: str = "") -> Path:
    """Run three members of two rounds; the run's folder. die_at: METHOD:N of the books or checkpoints, before it."""
    base = ["method=xpm_sim", "scale=smoke", "tracking=off", "population.size=3", f"env.params.horizon={HORIZON}"]
    config = RunConfig.parse(compose([*base, "seed=3", f"run.root={root}", f"run.id={name}", *overrides]))
    method, _, number = die_at.partition(":")
    calls: Counter[str] = Counter()

    def mortal(cls: type, name: str) -> type:
        def called(self: Any, *given: Any, **named: Any) -> Any:
            calls[name] += 1
            if name == method and calls[name] == int(number):
                raise Killed(die_at)
            return getattr(super(dying, self), name)(*given, **named)

        dying = type(cls.__name__, (cls,), {name: called})
        return dying

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(main_job, "Books", mortal(mortal(mortal(Books, "record"), "record_steps"), "add_member"))
        patch.setattr(pipeline, "Checkpoints", mortal(Checkpoints, "save"))
        if local:
            patch.setattr(pipeline, "Crew", LocalCrew)
        return Path(run_population(config, reporter=NullReporter())["run_dir"])


def ledger(run: Path) -> list[tuple[Any, ...]]:
    """All entries, but for the run's name and what tells attempts apart: the key's sampler and sequence."""
    entries = Ledger(run / "ledger.jsonl")
    return [(e.member, e.kind, e.sampler.partition(".")[0], e.steps, e.episodes, e.score) for e in entries]


def weights(run: Path) -> list[str]:
    return [info.policy_sha256 for info in load_population(run / "population").members]


@pytest.fixture(scope="module")
def whole(root: Path) -> Path:
    return launch(root, "whole", local=False)


def test_every_step_is_counted_once_by_kind(whole: Path) -> None:
    books, sims = Ledger(whole / "ledger.jsonl"), 10 * 2 * ROUNDS  # unroll x updates
    for member, columns in ((1, 4), (2, 12), (3, 12)):
        check = 4 * HORIZON // 2 * (1 if member == 1 else 2)
        assert books.steps(member, Kind.SP) == ROUNDS * 2 * HORIZON
        assert books.steps(member, Kind.XP) == (0 if member == 1 else ROUNDS * 2 * HORIZON)
        assert books.steps(member, Kind.SIMULATED) == sims * columns + check
        assert books.episodes(member, Kind.SP) == ROUNDS * 2
    infos = load_population(whole / "population").members
    assert [info.steps for info in infos] == [{"SP": 80}, {"SP": 80, "XP": 80}, {"SP": 80, "XP": 80}]
    assert [info.extra["simulated_steps"] for info in infos] == [books.steps(m, Kind.SIMULATED) for m in (1, 2, 3)]


def test_members_act_and_their_figures_are_told(whole: Path) -> None:
    population = load_population(whole / "population")
    assert [info.kind for info in population.members] == ["feed_forward"] * 3
    env = population.make_env(5, 0)
    actions = population[3].act(env.observe(), np.zeros((5, 2), np.uint8), np.ones(5, bool))
    assert actions.shape == (5, 2)
    assert {name.split(".")[1] for name in population.training(3)} == {"self", "cross"}
    rows = [json.loads(line) for line in (whole / "metrics.jsonl").read_text().splitlines()]
    last = [row for row in rows if row["member"] == 3]
    assert [row["updates"] for row in last if "updates" in row] == [2, 4]
    assert {"real_sp", "real_xp", "learner/entropy", "learner/lambda", "simulated_steps"} <= last[1].keys()
    assert "check/score_sp" in last[-1] and "check/score_restart" in last[-1]


def test_a_run_without_processes_and_the_same_seed_give_the_same(whole: Path, root: Path) -> None:
    again = launch(root, "again")
    assert weights(again) == weights(whole)
    assert ledger(again) == ledger(whole)
    other = launch(root, "other", "seed=4", "population.size=1")
    assert weights(other)[0] != weights(whole)[0]


@pytest.mark.parametrize("die_at", ["record:3", "record_steps:2", "record_steps:5", "save:2", "add_member:2"])
def test_interrupted_anywhere_the_run_ends_the_same(whole: Path, root: Path, die_at: str) -> None:
    name = die_at.replace(":", "-")
    with pytest.raises(Killed):
        launch(root, name, die_at=die_at)
    resumed = launch(root, name)
    assert weights(resumed) == weights(whole)
    assert ledger(resumed) == ledger(whole)


def test_a_finished_run_called_again_trains_nothing(whole: Path, root: Path) -> None:
    shutil.copytree(whole, root / "copied")
    shutil.rmtree(root / "copied" / "report")
    config = json.loads((root / "copied" / "config.json").read_text())
    config["run"]["id"] = "copied"
    (root / "copied" / "config.json").write_text(json.dumps(config))
    assert weights(launch(root, "copied")) == weights(whole)


def test_async_overlaps_and_counts_the_same_steps(whole: Path, root: Path) -> None:
    overlapped = launch(root, "async", "run.schedule=async", "population.size=2", "cluster.samplers=2")
    books, other = Ledger(overlapped / "ledger.jsonl"), Ledger(whole / "ledger.jsonl")
    for kind in (Kind.SP, Kind.XP, Kind.SIMULATED):
        assert books.steps(2, kind) == other.steps(2, kind)


def test_rendezvous_and_no_cross_play_pressure(root: Path) -> None:
    run = launch(root, "control", "env=rendezvous/mppmr", "env.params.horizon=20", "xpm_sim.lambda_xp=0")
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert any("learner/simulated_reward_restart" in row for row in rows)
    assert not any("learner/simulated_reward_xp" in row for row in rows)
    assert Ledger(run / "ledger.jsonl").steps(3, Kind.XP) > 0


def driver(members: int, **changes: Any) -> Any:
    base = ["method=xpm_sim", "scale=smoke", *(f"xpm_sim.{name}={value}" for name, value in changes.items())]
    known = {member: {} for member in range(1, members + 1)}
    return SimpleNamespace(config=RunConfig.parse(compose(base)), members=known)


def test_partners_take_turns_in_both_seats() -> None:
    member = Member(driver(3, episodes_xp=4), 4)
    seen: Counter[tuple[int, int]] = Counter()
    for member.round in range(3):
        teams = member._teams()
        assert (teams[0].members, teams[0].envs) == ((4, 4), 2)
        assert sum(team.envs for team in teams[1:]) == 4
        seen.update({team.members: team.envs for team in teams[1:]})
    assert seen == {pair: 2 for k in (1, 2, 3) for pair in ((4, k), (k, 4))}


def test_more_episodes_than_pairs_are_shared_evenly() -> None:
    teams = Member(driver(1, episodes_xp=5), 2)._teams()
    assert {team.members: team.envs for team in teams[1:]} == {(2, 1): 3, (1, 2): 2}
    assert len(Member(driver(0), 1)._teams()) == 1
