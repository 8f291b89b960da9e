"""Whole runs of XPM-Sim at `scale=smoke`: the recorder, twice the same, interrupted anywhere, both schedules."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray

from popgen.actors.actor_setup import build_env
from popgen.actors.xpm_sim_workers import open_training
from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.methods.training import InlineTransport
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_sim.round_rules import (
    MemberProgress,
    round_matches,
    score_round,
    seatings,
    updates_of_round,
)
from popgen.pipelines.population import run_population
from popgen.pipelines.training_driver import TrainingDriver
from popgen.play.episodes import Episode
from popgen.population import load_population
from popgen.progress import NullReporter
from popgen.runs.checkpoints import CheckpointFiles
from popgen.runs.ledger import Ledger
from popgen.runs.preflight import preflight
from popgen.runs.recorder import RunRecorder
from popgen.types import Kind

pytestmark = pytest.mark.filterwarnings("ignore:The given NumPy array is not writable")  # as in the actors

HORIZON, ROUNDS = 20, 2


class Killed(RuntimeError):
    """Injected where a driver could be killed."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


def configured(root: Path, name: str, *overrides: str) -> RunConfig:
    """Three members of two rounds."""
    base = ["method=xpm_sim", "scale=smoke", "tracking=off", "population.size=3", f"env.params.horizon={HORIZON}"]
    return RunConfig.parse(compose([*base, "seed=3", f"run.root={root}", f"run.id={name}", *overrides]))


def launch(root: Path, name: str, *overrides: str, die_at: str = "") -> Path:
    """Train in this process, without Ray; the run's folder.

    die_at: METHOD:N of the recorder or checkpoints; the run dies before the N-th call of it.
    """
    config = configured(root, name, *overrides)
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

    spec = build_env(config.env, 1).spec
    kind = mortal(mortal(mortal(RunRecorder, "record_sampling"), "record_step_count"), "add_member")
    recorder = kind(config, spec)
    training = open_training(config, spec, f"{recorder.run_id}.{recorder.attempt}", InlineTransport())
    files = mortal(CheckpointFiles, "save")(recorder.dir, long=training.log_rows, seconds=0.0)
    try:
        TrainingDriver(config, recorder, NullReporter(), training, files).train_members()
    finally:
        recorder.close("FINISHED")
    return root / name


def ledger(run: Path) -> list[tuple[Any, ...]]:
    """Entries of training, but for the run's name and what tells attempts apart: the key's sampler and sequence."""
    entries = [entry for entry in Ledger(run / "ledger.jsonl") if entry.kind is not Kind.EVALUATION]
    return [(e.member, e.kind, e.sampler.partition(".")[0], e.steps, e.episodes, e.score) for e in entries]


def weights(run: Path) -> list[str]:
    return [info.policy_sha256 for info in load_population(run / "population").members]


@pytest.fixture(scope="module")
def whole(root: Path) -> Path:
    return launch(root, "whole")


def test_every_step_is_counted_once_by_kind(whole: Path) -> None:
    recorder, sims = Ledger(whole / "ledger.jsonl"), 10 * 2 * ROUNDS  # unroll x updates
    for member, columns in ((1, 4), (2, 12), (3, 12)):
        check = 4 * HORIZON // 2 * (1 if member == 1 else 2)
        assert recorder.steps(member, Kind.SP) == ROUNDS * 2 * HORIZON
        assert recorder.steps(member, Kind.XP) == (0 if member == 1 else ROUNDS * 2 * HORIZON)
        assert recorder.steps(member, Kind.SIMULATED) == sims * columns + check
        assert recorder.episodes(member, Kind.SP) == ROUNDS * 2
    infos = load_population(whole / "population").members
    assert [info.steps for info in infos] == [{"SP": 80}, {"SP": 80, "XP": 80}, {"SP": 80, "XP": 80}]
    assert [info.extra["simulated_steps"] for info in infos] == [recorder.steps(m, Kind.SIMULATED) for m in (1, 2, 3)]


def test_members_act_and_their_figures_are_told(whole: Path) -> None:
    population = load_population(whole / "population")
    assert [info.kind for info in population.members] == ["feed_forward"] * 3
    env = population.make_env(5, 0)
    member = population[3]
    member.reset(batch=5, seed=0)
    actions = member.act(env.observe(), np.zeros((5, 2), np.uint8), np.ones(5, bool))
    assert actions.shape == (5, 2)
    assert {name.split(".")[1] for name in population.training(3)} == {"self", "cross"}
    rows = [json.loads(line) for line in (whole / "metrics.jsonl").read_text().splitlines()]
    last = [row for row in rows if row["member"] == 3]
    assert [row["updates"] for row in last if "updates" in row] == [0, 2]
    assert {"real_sp", "real_xp", "learner/entropy", "learner/lambda", "simulated_steps"} <= last[1].keys()
    played, columns = [row["simulated_steps"] for row in last[:2]], 12
    assert played == [0, 10 * 2 * columns]  # before the updates that the row tells of
    assert "check/score_sp" in last[-1] and "check/score_restart" in last[-1]


def test_the_same_seed_gives_the_same_on_a_real_ray_too(whole: Path, root: Path) -> None:
    folder = tempfile.mkdtemp(prefix="pg-", dir="/tmp")  # Ray's sockets need a short path
    options = {"include_dashboard": False, "log_to_driver": False, "logging_level": "ERROR"}
    ray.init(address="local", num_cpus=2, _temp_dir=folder, **options)
    try:
        result = run_population(configured(root, "real"), reporter=NullReporter())
    finally:
        ray.shutdown()
        shutil.rmtree(folder, ignore_errors=True)
    real = Path(result["run_dir"])
    assert weights(real) == weights(whole)
    assert ledger(real) == ledger(whole)
    assert result["members"] == 3 and result["ledger"]["total"]["simulated"] > 0
    assert {"random", "idle"} == set(result["evaluation"]["beside"])


def test_another_seed_gives_another_population(whole: Path, root: Path) -> None:
    other = launch(root, "other", "seed=4", "population.size=1")
    assert weights(other)[0] != weights(whole)[0]


@pytest.mark.parametrize(
    "die_at", ["record_sampling:3", "record_step_count:2", "record_step_count:5", "save:2", "save:4", "add_member:2"]
)
def test_interrupted_anywhere_the_run_ends_the_same(whole: Path, root: Path, die_at: str) -> None:
    name = die_at.replace(":", "-")
    with pytest.raises(Killed):
        launch(root, name, die_at=die_at)
    resumed = launch(root, name)
    assert weights(resumed) == weights(whole)
    assert ledger(resumed) == ledger(whole)


def test_a_finished_run_called_again_trains_nothing(whole: Path, root: Path) -> None:
    shutil.copytree(whole, root / "copied")
    config = json.loads((root / "copied" / "config.json").read_text())
    config["run"]["id"] = "copied"
    (root / "copied" / "config.json").write_text(json.dumps(config))
    assert weights(launch(root, "copied")) == weights(whole)


def test_async_overlaps_and_counts_the_same_steps(whole: Path, root: Path) -> None:
    overlapped = launch(root, "async", "run.schedule=async", "population.size=2", "cluster.samplers=2")
    recorder, other = Ledger(overlapped / "ledger.jsonl"), Ledger(whole / "ledger.jsonl")
    for kind in (Kind.SP, Kind.XP, Kind.SIMULATED):
        assert recorder.steps(2, kind) == other.steps(2, kind)


def test_overlapping_and_interrupted_it_ends_the_same(root: Path) -> None:
    overrides = ("run.schedule=async", "population.size=2")
    never = launch(root, "never", *overrides)
    with pytest.raises(Killed):
        launch(root, "once", *overrides, die_at="record_step_count:5")
    assert weights(launch(root, "once", *overrides)) == weights(never)
    assert ledger(root / "once") == ledger(never)


def test_rendezvous_and_no_cross_play_pressure(root: Path) -> None:
    run = launch(root, "control", "env=rendezvous/mppmr", "env.params.horizon=20", "xpm_sim.lambda_xp=0")
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert any("learner/simulated_reward_restart" in row for row in rows)
    assert not any("learner/simulated_reward_xp" in row for row in rows)
    assert Ledger(run / "ledger.jsonl").steps(3, Kind.XP) > 0


def test_partners_take_turns_in_both_seats() -> None:
    config, pairs = XpmSimConfig(episodes_sp=2, episodes_xp=4), seatings(4, [1, 2, 3], 3004)
    met: Counter[tuple[int, int]] = Counter()
    for number in range(3):
        matches = round_matches(config, 4, pairs, number)
        assert (matches[0].members, matches[0].envs) == ((4, 4), 2)
        assert sum(match.envs for match in matches[1:]) == 4
        met.update({match.members: match.envs for match in matches[1:]})
    assert met == {pair: 2 for k in (1, 2, 3) for pair in ((4, k), (k, 4))}


def test_more_episodes_than_pairs_are_shared_evenly() -> None:
    config, pairs = XpmSimConfig(episodes_xp=5), seatings(2, [1], 3002)
    shares = {match.members: match.envs for match in round_matches(config, 2, pairs, 0)[1:]}
    assert shares == dict(zip(pairs, (3, 2), strict=True)) and set(pairs) == {(2, 1), (1, 2)}
    assert len(round_matches(config, 1, seatings(1, [], 3001), 0)) == 1


def test_the_last_round_has_the_updates_that_are_left() -> None:
    config = XpmSimConfig(updates=7, updates_per_round=3)
    assert [updates_of_round(config, done) for done in (0, 3, 6, 7)] == [3, 3, 1, 0]


def test_scores_of_partners_that_a_round_did_not_meet_stay() -> None:
    episodes = [Episode(Kind.SP, (3, 3), score, 0.0) for score in (4.0, 6.0)]
    episodes += [Episode(Kind.XP, (3, 1), 2.0, 0.0), Episode(Kind.XP, (1, 3), 3.0, 0.0)]
    assert score_round({}, episodes[:2], []) == {"sp": 5.0}
    scores = score_round({"sp": 1.0, "xp/1": 9.0, "xp/2": 1.5, "xp": 9.0}, episodes, [1, 2])
    assert scores == {"sp": 5.0, "xp/1": 2.5, "xp/2": 1.5, "xp": 2.5}


def test_progress_is_read_by_name() -> None:
    progress = MemberProgress(rounds=2, updates=10, steps=80, simulated=400, scores={"sp": 1.5})
    assert MemberProgress.from_state(json.loads(json.dumps(asdict(progress)))) == progress
    with pytest.raises(KeyError):
        MemberProgress.from_state({"rounds": 1})


def test_buffers_that_cannot_hold_a_round_are_refused(root: Path) -> None:
    with pytest.raises(UserError, match="80 rows"):  # 2 episodes of 20 steps, each of which may end one
        preflight(configured(root, "refused", "xpm_sim.capacity=79"))
    preflight(configured(root, "refused", "xpm_sim.capacity=80"))
