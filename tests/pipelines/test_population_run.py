"""Whole runs at `scale=smoke` on a local Ray of two cores: member by member, twice, interrupted, continued."""

from __future__ import annotations

import json
import os
import signal
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import ray

from popgen.actors.xpm_wm_workers import open_training
from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.durable_files import load_state
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.methods.training import Collected, InlineTransport, Ready, Round, TrainedMember
from popgen.methods.xpm_wm.phase1 import FirstMemberProgress
from popgen.methods.xpm_wm.phase2 import LaterMemberProgress
from popgen.methods.xpm_wm.real_play import MemberWeights, Tally
from popgen.methods.xpm_wm.replay import KIND_CODE
from popgen.methods.xpm_wm.train import FirstMember, LaterMember
from popgen.methods.xpm_wm.workers import AgentUpdate, ModelTask, ModelUpdate, Setup
from popgen.pipelines import population as main_job
from popgen.pipelines.population import run_population
from popgen.play.partner_strength import PartnerStrength
from popgen.population import Population, load_population
from popgen.progress import NullReporter
from popgen.runs.checkpoints import CheckpointFiles
from popgen.runs.ledger import Ledger
from popgen.runs.recorder import RunRecorder
from popgen.types import Kind

pytestmark = pytest.mark.filterwarnings("ignore:The given NumPy array is not writable")  # as in the actors

HORIZON = 40
THREE = ("cluster.samplers=3", "cluster.sampler_cpus=0.05")


@dataclass
class Run:
    """A finished run: what it returned, and what its samplers said they stepped."""

    result: dict[str, Any]
    collected: list[tuple[int, Collected]]

    @property
    def dir(self) -> Path:
        return Path(self.result["run_dir"])

    @property
    def population(self) -> Population:
        return load_population(self.result["population"])

    def ledger(self) -> list[tuple[Any, ...]]:
        """All entries, but for the run's name and what tells attempts apart: the key's sampler and sequence."""
        entries = Ledger(self.dir / "ledger.jsonl")
        return [(e.member, e.kind, e.sampler.partition(".")[0], e.steps, e.episodes, e.score) for e in entries]


def sha256s(run: Run) -> list[str]:
    return [info.policy_sha256 for info in run.population.members]


class Killed(RuntimeError):
    """Injected where a driver could be killed."""


def kill(work: Any, who: str) -> None:
    """kill -9 of an actor's process."""
    workers = {"sampler": work.pool.samplers[0], "model": work.model, "agent": work.agent, **work.replays}
    handle = workers[who].handle
    os.kill(ray.get(handle.__ray_call__.remote(lambda actor: os.getpid())), signal.SIGKILL)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


def smoke(root: Path, name: str, *overrides: str) -> RunConfig:
    """`scale=smoke`, two members, two rounds of the second, short episodes, all that goes by real play's counts, both
    learners side by side in both phases."""
    base = ["scale=smoke", "tracking=off", "population.size=2", f"env.params.horizon={HORIZON}", "seed=3"]
    base += ["phase2.rounds=2", f"run.root={root}", f"run.id={name}", "agent.advantage_clip=5", "phase1.plateau=2"]
    base += ["phase2.model_lag=1", "phase2.partner_fits=2"]
    base += [f"discovery.{option}" for option in ("count_bonus=1", "trust=2", "rare_events=9", "found_events=1")]
    return RunConfig.parse(compose([*base, *overrides]))


def launch(
    root: Path, name: str, *overrides: str, local: bool = True, die_at: str = "", kills: dict[str, str] | None = None
) -> Run:
    """Run it, listening to what the samplers say; without processes of its own if `local`.

    die_at: METHOD:N of the recorder or the checkpoints; the run dies at the beginning of the N-th call of it.
    kills: METHOD:N -> the actor whose process is killed then.
    """
    config = smoke(root, name, *overrides, f"run.transport={'inline' if local else 'ray'}")
    collected: list[tuple[int, Collected]] = []
    calls: Counter[str] = Counter()
    trainings: list[Any] = []

    def called(name: str) -> None:
        calls[name] += 1
        now = f"{name}:{calls[name]}"
        if now == die_at:
            raise Killed(die_at)
        if kills and now in kills:
            kill(trainings[-1].work, kills[now])

    open_training = main_job.open_training

    def opened(*arguments: Any) -> Any:
        trainings.append(open_training(*arguments))
        return trainings[-1]

    class Listening(RunRecorder):
        def record_sampling(self, member: int, sampled: Collected) -> None:
            called("record")
            collected.append((member, sampled))
            super().record_sampling(member, sampled)

        def add_member(self, *given: Any, **named: Any) -> None:
            called("add_member")
            super().add_member(*given, **named)

    class Mortal(CheckpointFiles):
        def save(self, *given: Any) -> None:
            called("save")
            super().save(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(main_job, "RunRecorder", Listening)
        patch.setattr(main_job, "CheckpointFiles", Mortal)
        patch.setattr(main_job, "open_training", opened)
        return Run(run_population(config, reporter=NullReporter()), collected)


@pytest.fixture(scope="module")
def whole(cluster: None, root: Path) -> Run:
    return launch(root, "whole", "tracking.enabled=true", local=False)


@pytest.fixture(scope="module")
def continued(whole: Run, root: Path) -> Run:
    """Member 2 trained in a new run that continues from member 1 of another."""
    return launch(root, "continued", f"population.init_from={whole.dir}", "population.init_members=1")


@pytest.fixture(scope="module")
def overlapped(cluster: None, root: Path) -> Run:
    return launch(root, "overlapped", "run.schedule=async", "population.size=1", *THREE, local=False)


def check_ledger(run: Run) -> None:
    """The ledger holds what the samplers counted, nothing else, and what the buffers hold."""
    said: Counter[tuple[int, str]] = Counter()
    for member, collected in run.collected:
        for kind, _, _, steps in collected.counts:
            said[member, str(kind)] += steps
    table = Ledger(run.dir / "ledger.jsonl").table()
    assert table == run.result["ledger"]
    counted = {
        (int(member), kind): steps
        for member, row in table.items()
        if member not in ("total", "population")
        for kind, steps in row.items()
        if kind not in ("total", "evaluation")
    }
    assert counted == dict(said) and min(counted.values()) > 0
    held: Counter[tuple[int, str]] = Counter()
    last = sorted((run.dir / "checkpoints").glob("member_*"))[-1]
    for name in ("replay_sp", "replay_xp"):
        arrays = load_state(last)[name]["replay"]["arrays"]
        assert not arrays["terminal"].any()  # every row is a step, none an arrival
        for kind, code in KIND_CODE.items():
            for owner in (1, 2):
                rows = int(((arrays["kind"] == code) & (arrays["owner"] == owner)).sum())
                if rows:
                    held[owner, str(kind)] += rows
                    assert (name == "replay_xp") == (kind is Kind.XP)
    assert dict(held) == counted


def test_every_step_is_in_the_ledger_and_in_the_buffers(whole: Run) -> None:
    check_ledger(whole)
    table = whole.result["ledger"]
    config = RunConfig.parse(json.loads((whole.dir / "config.json").read_text()))
    assert table["1"]["random"] == config.phase1.prefill_steps
    assert table["1"]["SP"] + table["1"]["random"] >= config.phase1.max_steps
    assert table["2"]["SP"] == config.phase2.rounds * config.phase2.episodes_sp * HORIZON
    assert table["2"]["XP"] == config.phase2.rounds * config.phase2.episodes_xp * HORIZON
    assert table["population"]["evaluation"] == whole.result["evaluation"]["steps"]["evaluation"] > 0
    assert table["population"]["total"] == 0 and "evaluation" not in table["2"]
    assert table["total"]["total"] == sum(info.total_steps for info in whole.population.members)


def test_the_population_holds_both_members_and_their_steps(whole: Run) -> None:
    population, table = whole.population, whole.result["ledger"]
    assert len(population) == whole.result["members"] == 2
    for member, info in enumerate(population.members, start=1):
        row = {kind: steps for kind, steps in table[str(member)].items() if kind not in ("total", "evaluation")}
        assert info.steps == row and info.seed == 3000 + member
        training = population.training(member)
        assert training is not None
        critics = {name.split(".")[1] for name in training if name.startswith("critics.")}
        assert critics == {str(k) for k in range(member)}  # self-play, and one per predecessor
        assert any(name.startswith("model.decoders.") for name in training)
        assert {"sp", "xp", "seconds", "world_model"} <= info.extra.keys()
    assert np.shape(whole.result["matrix"]["mean"]) == (2, 2)
    assert all(Path(path).exists() for path in whole.result["files"].values())


def test_the_mlflow_run_holds_what_the_run_leaves_behind(whole: Run, tmp_path: Path) -> None:
    from mlflow.tracking import MlflowClient

    client = MlflowClient(tracking_uri=f"sqlite:///{whole.dir.parent}/mlflow.db")
    runs = json.loads((whole.dir / "tracking.json").read_text())["runs"]
    assert runs.keys() == {"parent", "member_001", "member_002"}
    assert {client.get_run(run).info.status for run in runs.values()} == {"FINISHED"}
    got = Path(client.download_artifacts(runs["parent"], "", str(tmp_path)))
    assert {path.name for path in got.iterdir()} == {
        "config.json",
        "ledger.jsonl",
        "ledger.csv",
        "population",
        "report",
    }
    for path in (path for path in got.rglob("*") if path.is_file()):
        assert path.read_bytes() == (whole.dir / path.relative_to(got)).read_bytes()
    assert {path.name for path in (got / "report").iterdir()} == {Path(p).name for p in whole.result["files"].values()}
    assert [info.policy_sha256 for info in load_population(got / "population").members] == sha256s(whole)
    rows = (got / "ledger.csv").read_text().splitlines()[1:]
    total = whole.result["ledger"]["total"]
    assert sum(int(row.split(",")[2]) for row in rows) == total["total"] + total["evaluation"]


def test_episodes_are_those_of_the_steps(whole: Run) -> None:
    ledger = Ledger(whole.dir / "ledger.jsonl")
    for kind in (Kind.SP, Kind.XP):
        assert ledger.episodes(2, kind) * HORIZON == ledger.steps(2, kind)
    pairs = Counter(members for member, said in whole.collected for kind, members, *_ in said.counts if kind is Kind.XP)
    assert set(pairs) == {(1, 2), (2, 1)}


def test_metrics_tell_what_training_did(whole: Run) -> None:
    rows = [json.loads(line) for line in (whole.dir / "metrics.jsonl").read_text().splitlines()]
    for member, wanted in (
        (1, {"model/loss_observation", "agent/entropy", "agent/return_scale", "real_shaped_sp", "final_sp"}),
        (2, {"agent/imagined_shaped_sp", "agent/imagined_shaped_xp", "real_sp", "real_xp_max", "final_xp"}),
    ):
        names = set().union(*(row.keys() for row in rows if row["member"] == member))
        assert wanted <= names and {"event_recall_step1", "event_precision_step4", "exact_posterior"} <= names


DEATHS = {
    "in the random play": ("record:1", 0),
    "before the first checkpoint": ("save:1", 1),
    "in the first round of member 1": ("record:2", 0),
    "before the checkpoint of its third round": ("save:4", 1),
    "when member 1 is added": ("add_member:1", 0),
    "in the first round of member 2": ("record:6", 0),
    "before the checkpoint of that": ("save:6", 3),
    "when member 2 is added": ("add_member:2", 3),
}
"""Where a run dies, and how many ledger entries no checkpoint holds then. The calls of a smoke run are: random play; a
checkpoint; four rounds of one entry, each with a checkpoint; two rounds of three entries, with one between them."""


@pytest.mark.parametrize("death", DEATHS)
def test_a_killed_run_ends_as_one_that_was_not(death: str, whole: Run, root: Path) -> None:
    name, (die_at, lost) = death.replace(" ", "_"), DEATHS[death]
    with pytest.raises(Killed):
        launch(root, name, die_at=die_at)
    run = launch(root, name)
    assert sha256s(run) == sha256s(whole) and len(set(sha256s(whole))) == 2
    assert run.ledger() == whole.ledger()
    assert len((run.dir / "attempts.txt").read_text().splitlines()) == 2
    aside = run.dir / "ledger.lost.jsonl"
    assert (len(Ledger(aside)) if aside.exists() else 0) == lost


def test_a_run_goes_on_by_itself_when_its_actors_are_killed(whole: Run, root: Path) -> None:
    """The calls go on over all attempts. Save 5 is after the last round of member 1, 6 after the first of member 2."""
    kills = {"record:2": "sampler", "save:5": "model", "save:6": "agent", "record:8": "replay_xp"}
    run = launch(root, "bereaved", local=False, kills=kills)
    assert sha256s(run) == sha256s(whole)
    assert run.ledger() == whole.ledger() and run.result["ledger"] == whole.result["ledger"]
    assert len((run.dir / "attempts.txt").read_text().splitlines()) == 1 + len(kills)
    rows = [json.loads(line) for line in (run.dir / "run.log").read_text().splitlines()]
    assert sum(row["event"] == "lost" for row in rows) == len(kills)
    assert rows[-1]["event"] == "end" and rows[-1]["status"] == "FINISHED"


def test_an_evaluation_that_is_done_again_counts_once(whole: Run, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(main_job, "write_run_figures", lambda *given, **named: (_ for _ in ()).throw(Killed()))
        launch(root, "evaluated")
    before = Ledger(root / "evaluated" / "ledger.jsonl").table()
    run = launch(root, "evaluated")
    assert run.result["ledger"] == before == whole.result["ledger"]
    assert sha256s(run) == sha256s(whole)
    assert launch(root, "evaluated").result["ledger"] == before  # and a run that is complete is left as it is


def test_both_transports_give_the_same_weights(whole: Run, root: Path) -> None:
    """Actors of Ray's, and objects of this process."""
    inline = launch(root, "inline")
    assert sha256s(inline) == sha256s(whole) and inline.ledger() == whole.ledger()
    assert inline.result["matrix"] == whole.result["matrix"]


def test_a_ring_that_is_full_is_restored_from_a_whole_copy(cluster: None, root: Path) -> None:
    small = ("replay.capacity=1700", "population.size=1")
    unbroken = launch(root, "unbroken_ring", *small)
    with pytest.raises(Killed):
        launch(root, "ring", *small, die_at="save:4")
    names = {path.name for path in (root / "ring" / "checkpoints").iterdir()}
    kept = {"progress_000002", "progress_000003", "base_000001"}
    assert names == kept | {"segments_000001", "segments_000002", "segments_000003"}
    assert sha256s(launch(root, "ring", *small)) == sha256s(unbroken)


def test_several_samplers_share_the_work_and_give_the_same_twice(cluster: None, root: Path) -> None:
    runs = [launch(root, f"shared{number}", *THREE) for number in range(2)]
    assert sha256s(runs[0]) == sha256s(runs[1]) and runs[0].ledger() == runs[1].ledger()
    steps: Counter[tuple[int, str]] = Counter()
    for entry in Ledger(runs[0].dir / "ledger.jsonl"):
        steps[entry.member, entry.sampler.partition(".")[0]] += entry.steps
    # Four environments make shares of 2, 1 and 1 in member 1's 2,400 steps, four episodes the same for member 2's.
    assert [steps[1, f"sampler{i}"] for i in range(3)] == [1200, 600, 600]
    assert [steps[2, f"sampler{i}"] for i in range(3)] == [2 * 2 * HORIZON, 2 * HORIZON, 2 * HORIZON]
    check_ledger(runs[0])


def test_a_damaged_checkpoint_is_told_in_one_line(whole: Run, root: Path) -> None:
    with pytest.raises(Killed):
        launch(root, "damaged", die_at="save:3")
    segments = root / "damaged" / "checkpoints" / "segments_000001"
    whole_file = segments.read_bytes()
    segments.write_bytes(whole_file[:100])
    with pytest.raises(UserError, match="segments_000001"):
        launch(root, "damaged")
    segments.write_bytes(whole_file)
    with pytest.raises(UserError, match=r"cluster.samplers: 2, but the checkpoint is of 1"):
        launch(root, "damaged", "cluster.samplers=2")


def test_a_checkpoint_waits_for_its_time(cluster: None, root: Path) -> None:
    with pytest.raises(Killed):
        launch(root, "seldom", "run.checkpoint_seconds=3600", die_at="record:4")
    state = load_state(root / "seldom" / "checkpoints" / "progress_000001")
    assert state["progress"]["rounds"] == 0  # that before the rounds


def test_a_run_id_belongs_to_one_configuration(whole: Run, root: Path) -> None:
    with pytest.raises(UserError, match="whole exists with another config"):
        launch(root, "whole", "agent.lambda_xp=0.125")


def test_a_run_can_go_on_from_a_member_of_another(whole: Run, continued: Run) -> None:
    assert sha256s(continued) == sha256s(whole)
    assert {member for member, _ in continued.collected} == {2}
    # Member 1's steps were another run's: they stand in its record, not in this ledger.
    assert "1" not in continued.result["ledger"]
    assert continued.population.info(1).steps == whole.population.info(1).steps
    assert continued.result["ledger"]["2"] == whole.result["ledger"]["2"]


def test_a_run_that_continues_another_can_be_interrupted_before_its_first_own_member(whole: Run, root: Path) -> None:
    """Until there is a checkpoint of its own, the other run's counts."""
    more = (f"population.init_from={whole.dir}", "population.init_members=1")
    with pytest.raises(Killed):
        launch(root, "early", *more, die_at="record:1")
    assert len(load_population(root / "early" / "population")) == 1
    run = launch(root, "early", *more)
    assert sha256s(run) == sha256s(whole) and {member for member, _ in run.collected} == {2}


def later_member(root: Path, member: int, *overrides: str) -> LaterMember:
    config = smoke(root, "unused", *overrides)
    spec = make_env(config.env.name, 1, **config.env.params).spec
    archive: Any = dict.fromkeys(range(1, member))
    progress = LaterMemberProgress(PartnerStrength("max_window"))
    work: Any = None  # nothing is asked of it
    return LaterMember(Setup(work, config, spec, member, 0, archive), progress)


def test_every_partner_is_met_in_both_seats(root: Path) -> None:
    later = later_member(root, 4, "phase2.episodes_xp=2", "phase2.rounds=9", "phase2.max_steps=640")
    assert set(later.pairs) == {(4, 1), (1, 4), (4, 2), (2, 4), (4, 3), (3, 4)}
    assert later.episodes_xp == 6 and later.most_rounds == 640 // ((2 + 6) * HORIZON)


@pytest.mark.parametrize("lag", [0, 1])
def test_the_agent_imagines_before_or_beside_the_world_models_update(root: Path, lag: int) -> None:
    """In a later round; start states are from the newest real episodes in both cases."""
    later = later_member(root, 2, f"phase2.model_lag={lag}", "phase2.updates_per_round=2")
    later.progress.rounds = 1
    asked: list[str] = []

    def answer(name: str, result: Any) -> Callable[..., Ready[Any]]:
        return lambda *_: (asked.append(name), Ready(result))[1]

    names = {name: answer(name, None) for name in ("cache_starts", "model_weights", "fit_partners")}
    model = ModelUpdate(Ready({}), None, {"loss": 1.0})
    learned = AgentUpdate(MemberWeights(Ready({}), Ready({}), Ready({})), {"entropy": 0.5})
    later.work = SimpleNamespace(
        **names,
        update_world_model=answer("update_world_model", model),
        update_agent=answer("update_agent", learned),
        tally=lambda member: Ready(None),
    )
    loop, figures = later.train(), []
    while len(asked) < 5 or len(figures) < 2:
        record = next(loop)
        figures += [name for name in getattr(record, "figures", {}) if name in ("model/loss", "agent/entropy")]
    states, update, imagine = [*names], ["update_world_model"], ["update_agent"]
    assert asked == ([*states, *update, *imagine] if lag else [*update, *states, *imagine])
    assert figures == ["agent/entropy", "model/loss"]


@pytest.mark.parametrize(
    ("event_starts", "plays", "chosen"), [("playing", False, False), ("playing", True, True), ("always", False, True)]
)
def test_imagination_starts_from_windows_of_an_event_once_self_play_has_started(
    root: Path, event_starts: str, plays: bool, chosen: bool
) -> None:
    config = smoke(root, "unused", f"phase1.event_starts={event_starts}")
    asked: list[ModelTask] = []
    none = np.zeros(0, np.int64)
    tally = Tally(np.array([9, 8, 9, 9, 0]), np.zeros(5, np.int64), 0, none, none, ())
    work: Any = SimpleNamespace(update_world_model=asked.append, tally=lambda member: Ready(tally))
    progress = FirstMemberProgress(16, self_play_has_begun=plays)
    spec = make_env(config.env.name, 1).spec
    FirstMember(Setup(work, config, spec, 1, 0, {}), progress).update_world_model(7)
    rows = config.phase1.envs * config.phase1.steps_per_iteration
    assert asked == [ModelTask(7, config.agent.starts_sp, chosen, (1, 4), rows)]


def test_every_look_at_the_last_policy_has_fresh_episodes(root: Path) -> None:
    """So has the play between two looks."""
    config = smoke(root, "unused")
    seeds: list[tuple[int, bool]] = []
    work: Any = SimpleNamespace(start_episodes=lambda matches, policies, seed, stagger: seeds.append((seed, stagger)))
    weights: Any = SimpleNamespace(acting=None)
    spec = make_env(config.env.name, 1).spec
    first = FirstMember(Setup(work, config, spec, 1, 3001, {}), FirstMemberProgress(16))
    first.progress.published = weights
    first.start_self_play()
    for first.progress.confirmations in (1, 2):
        first.start_self_play(stagger=False)
        first.start_self_play()
    assert [stagger for _, stagger in seeds] == [True, False, True, False, True]
    assert len({seed for seed, _ in seeds}) == 5


def test_a_loop_runs_without_anything_written(root: Path) -> None:
    """As in a notebook: workers in this process, records one after the other."""
    config = smoke(root, "notebook", "population.size=1")
    spec = make_env(config.env.name, 1, **config.env.params).spec
    training = open_training(config, spec, "notebook.1", InlineTransport())
    assert training.begin(1) == (1,)
    records = list(training.train())
    rounds = [record for record in records if isinstance(record, Round)]
    assert [record.number for record in rounds] == list(range(len(rounds))) and rounds[-1].at_rest
    (trained,) = (record for record in records if isinstance(record, TrainedMember))
    assert trained.member == 1 and trained.policy.weights() and not (root / "notebook").exists()


def test_the_first_member_is_the_same_however_many_follow(whole: Run, root: Path) -> None:
    assert sha256s(launch(root, "alone", "population.size=1")) == sha256s(whole)[:1]


def test_overlapping_work_is_counted_exactly(overlapped: Run) -> None:
    check_ledger(overlapped)
    assert len(overlapped.population) == 1
