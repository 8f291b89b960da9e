"""FCP and MEP in XPM-WM's world model: whole trainings at `scale=smoke` in this process, interrupted ones too."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from popgen.config.run_config import RunConfig
from popgen.durable_files import load_state
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.methods.registry import METHODS, find_method, recipe
from popgen.methods.training import InlineTransport
from popgen.methods.xpm_wm.agent import AgentLearner
from popgen.nets.weights import under
from popgen.pipelines.population import open_training
from popgen.pipelines.training_driver import TrainingDriver
from popgen.population import load_population
from popgen.progress import NullReporter
from popgen.runs.checkpoints import CheckpointFiles
from popgen.runs.ledger import Ledger
from popgen.runs.recorder import RunRecorder
from popgen.types import Kind

HORIZON, ROUNDS = 20, 3
ROOM = "overcooked/cramped_room"


class Killed(RuntimeError):
    """Injected where a driver could be killed."""


def smoke(root: Path, method: str, name: str, size: int, **changes: Any) -> RunConfig:
    """Three rounds of every later member."""
    values = recipe(method, ROOM, "smoke").as_dict()
    values["env"]["params"] = {"horizon": HORIZON}
    values["population"]["size"], values["tracking"]["enabled"] = size, False
    values["run"] |= {"root": str(root), "id": name, "seed": 3, "transport": "inline"}
    values["phase1"] |= {"prefill_steps": 400, "max_steps": 600}
    values["phase2"] |= {"rounds": ROUNDS, "max_rounds": ROUNDS}
    for section, fields in changes.items():
        values[section] |= fields
    return RunConfig.parse(values)


def train(config: RunConfig, die_at: str = "") -> Path:
    """One attempt of a run's driver; it dies at the beginning of the N-th call of METHOD, if that is METHOD:N."""
    calls: Counter[str] = Counter()

    def called(name: str) -> None:
        calls[name] += 1
        if f"{name}:{calls[name]}" == die_at:
            raise Killed(die_at)

    class Mortal(RunRecorder):
        def add_member(self, *given: Any, **named: Any) -> None:
            called("add_member")
            super().add_member(*given, **named)

    class Files(CheckpointFiles):
        def save(self, *given: Any) -> None:
            called("save")
            super().save(*given)

    spec = make_env(config.env.name, 1, **config.env.params).spec
    recorder = Mortal(config, spec)
    training = open_training(config, spec, f"{recorder.run_id}.{recorder.attempt}", InlineTransport())
    files = Files(recorder.dir, long=training.log_rows, seconds=0.0)
    try:
        TrainingDriver(config, recorder, NullReporter(), training, files).train_members()
    finally:
        training.close()
        recorder.close("FINISHED")
    return recorder.dir


def ledger_of(folder: Path) -> list[tuple[Any, ...]]:
    """All entries, but for what tells attempts apart."""
    return [(e.member, e.kind, e.steps, e.episodes, e.score) for e in Ledger(folder / "ledger.jsonl")]


def digests_of(folder: Path) -> list[str]:
    return [info.policy_sha256 for info in load_population(folder / "population").members]


@pytest.fixture(scope="module")
def fcp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(smoke(tmp_path_factory.mktemp("fcp"), "fcp_wm", "skills", 4))


@pytest.fixture(scope="module")
def origin(fcp: Path) -> dict[str, Any]:
    """A population goes on after member 1 of any method of the same world model."""
    return {"init_from": str(fcp), "init_members": 1}


@pytest.fixture(scope="module")
def mep(origin: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(smoke(tmp_path_factory.mktemp("mep"), "mep_wm", "surprised", 3, population=origin))


def test_a_seed_gives_three_members_and_its_steps_are_the_final_ones(fcp: Path) -> None:
    extra = [info.extra for info in load_population(fcp / "population").members]
    assert [one["skill"] for one in extra] == ["final", "initial", "half", "final"]
    assert [one.get("of_member") for one in extra] == [None, 4, 4, None]
    steps = Counter[tuple[int, str]]()
    for member, kind, count, *_ in ledger_of(fcp):
        steps[member, str(kind)] += count
    episodes = recipe("fcp_wm", ROOM, "smoke").as_dict()["phase2"]["episodes_sp"]
    assert set(steps) == {(1, "random"), (1, "SP"), (4, "SP")}
    assert steps[4, "SP"] == ROUNDS * episodes * HORIZON
    assert extra[1]["at_steps"] == 0 < extra[2]["at_steps"] <= steps[4, "SP"]
    assert [one["seconds"] for one in extra[1:3]] == [0.0, 0.0] and "seconds" in extra[3]


def test_the_initial_member_is_the_untrained_actor_on_member_ones_world_model(fcp: Path) -> None:
    population, config = load_population(fcp / "population"), smoke(fcp.parent, "fcp_wm", "skills", 4)
    spec = population.make_env().spec
    fresh = AgentLearner(config.agent, config.world_model, spec, 4, config.run.seed * 1000 + 4)  # type: ignore[attr-defined]
    for name, value in fresh.actor_weights().items():
        assert np.array_equal(under("actor", population[2].weights())[name], value)
    left = under("filter", load_state(fcp / "checkpoints" / "member_001")["model"]["learner"]["model"])
    seen = under("filter", population[2].weights())
    assert all(np.array_equal(value, seen[name]) for name, value in left.items())


def test_members_of_mep_meet_nobody_and_are_paid_for_surprise(fcp: Path, mep: Path) -> None:
    assert {(member, kind) for member, kind, *_ in ledger_of(mep)} == {(2, Kind.SP), (3, Kind.SP)}
    assert digests_of(mep)[0] == digests_of(fcp)[0]
    metrics = (mep / "metrics.jsonl").read_text()
    paid = [line for line in metrics.splitlines() if "agent/surprise_bonus" in line]
    assert paid and not any('"member": 1,' in line for line in paid)


@pytest.mark.end_to_end
@pytest.mark.parametrize(
    ("method", "size", "death"),
    [
        ("fcp_wm", 4, "add_member:3"),  # the initial member is kept, the half trained one not
        ("mep_wm", 3, "save:4"),  # after the second round of the last member
    ],
)
def test_a_killed_run_ends_as_one_that_was_not(
    method: str, size: int, death: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    whole, origin = (request.getfixturevalue(name) for name in (method.partition("_")[0], "origin"))
    config = smoke(tmp_path, method, "killed", size, population=origin if method == "mep_wm" else {})
    with pytest.raises(Killed):
        train(config, death)
    kept = len(load_population(tmp_path / "killed" / "population").members)
    assert 0 < kept < size
    folder = train(config)
    assert digests_of(folder) == digests_of(whole) and ledger_of(folder) == ledger_of(whole)


@pytest.mark.parametrize(("field", "values"), [("size", {"size": 3}), ("init_members", {"init_members": 2})])
def test_half_seeds_are_refused(field: str, values: dict[str, Any], tmp_path: Path) -> None:
    population = {"size": 7, "init_from": str(tmp_path), **values}
    config, spec = smoke(tmp_path, "fcp_wm", "none", 7, population=population), make_env(ROOM, 1).spec
    with pytest.raises(UserError) as caught:
        find_method("fcp_wm").check(config, spec)
    assert caught.value.field == f"population.{field}" and "set it to 4" in str(caught.value)


def test_sizes_that_fit_a_methods_groups() -> None:
    assert [METHODS["fcp_wm"].fit_size(least) for least in (1, 2, 4, 5, 8)] == [1, 4, 4, 7, 10]
    assert [METHODS["fcp"].fit_size(least) for least in (1, 3, 4)] == [3, 3, 6]
    assert METHODS["mep_wm"].fit_size(5) == 5


def test_cross_play_pressure_without_cross_play_is_refused() -> None:
    with pytest.raises(UserError) as caught:
        RunConfig.parse({"agent": {"lambda_xp": 0.2}, "phase2": {"episodes_xp": 0}})
    assert "phase2.episodes_xp" in str(caught.value) and "agent.lambda_xp=0" in str(caught.value)
