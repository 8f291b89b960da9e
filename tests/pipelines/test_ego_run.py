"""Whole runs of egos at `scale=smoke`, in this process: what they leave behind, interrupted anywhere, refused."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from support.small import kitchen

from popgen.actors.ego_workers import list_distinct, open_training, read_partner
from popgen.errors import UserError
from popgen.methods.ego.config import EgoRun
from popgen.methods.training import InlineTransport
from popgen.pipelines.ego_training import make_ego_config
from popgen.pipelines.training_driver import TrainingDriver
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.simple_policies import RandomPolicy
from popgen.population import Population, PopulationWriter, load_population
from popgen.progress import NullReporter
from popgen.runs.checkpoints import CheckpointFiles
from popgen.runs.ledger import Ledger
from popgen.runs.preflight import preflight
from popgen.runs.recorder import RunRecorder
from popgen.types import Kind

SETTINGS: dict[str, Any] = {"run.seed": 3, "ego.steps": 640, "tracking.enabled": False, "ego.unroll": 40}
ROUNDS = 4


Run = Callable[..., tuple[int, str, str]]


class Killed(RuntimeError):
    """Injected where a driver could be killed."""


@pytest.fixture(scope="module")
def partners(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two networks and a random player."""
    spec, path = kitchen(horizon=40).spec, tmp_path_factory.mktemp("partners") / "three"
    writer = PopulationWriter(path, spec, method="mappo", config_digest="a" * 64, seed=5)
    for seed in range(2):
        policy = FeedForwardPolicy(spec.views["features"], spec.num_actions, units=4, layers=1, seed=seed)
        writer.add_member(policy, seed=50 + seed, steps={})
    writer.add_member(RandomPolicy(spec.num_actions), seed=52, steps={})
    return path


def launch(root: Path, name: str, config: EgoRun, monkeypatch: pytest.MonkeyPatch, die_at: int = 0) -> Path:
    """Train in this process, a checkpoint after every iteration; the run dies before writing the `die_at`-th."""
    monkeypatch.setattr("popgen.methods.ego.train.ROUND", 1)
    calls: Counter[str] = Counter()

    class Files(CheckpointFiles):
        def save(self, *given: Any, **named: Any) -> None:
            calls["save"] += 1
            if calls["save"] == die_at:
                raise Killed
            super().save(*given, **named)

    config = config.model_copy(update={"run": config.run.model_copy(update={"id": name, "root": str(root)})})
    spec = preflight(config)
    recorder = RunRecorder(config, spec)
    training = open_training(config, spec, f"{recorder.run_id}.{recorder.attempt}", InlineTransport())
    try:
        driver = TrainingDriver(config, recorder, NullReporter(), training, Files(recorder.dir, long=1, seconds=0.0))
        driver.train_members()
    finally:
        recorder.close("FINISHED")
    return root / name


@pytest.mark.end_to_end
@pytest.mark.parametrize("method", ["hipt", "fcp", "sp_aug"])
def test_a_run_that_was_killed_ends_as_one_that_was_not(
    method: str, partners: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {**SETTINGS, "env.params": {"horizon": 40}}
    named = [] if method == "sp_aug" else [str(partners)]
    config = make_ego_config(method, named, settings, scale="smoke")
    whole = launch(tmp_path, "whole", config, monkeypatch)
    with pytest.raises(Killed):
        launch(tmp_path, "killed", config, monkeypatch, die_at=3)
    launch(tmp_path, "killed", config, monkeypatch)
    egos = [load_population(run / "population").info(1) for run in (whole, tmp_path / "killed")]
    assert egos[0].policy_sha256 == egos[1].policy_sha256 and egos[0].training_sha256 == egos[1].training_sha256
    kind = Kind.SP if method == "sp_aug" else Kind.XP
    ledgers = [Ledger(run / "ledger.jsonl") for run in (whole, tmp_path / "killed")]
    assert [ledger.steps(1, kind) for ledger in ledgers] == [640, 640]
    assert ledgers[0].episodes(1, kind) == ledgers[1].episodes(1, kind) > 0
    moved = [ledger.steps(1, Kind.SIMULATED) for ledger in ledgers]  # augmented starts
    assert moved[0] == moved[1] and (moved[0] > 0) == (method == "sp_aug")


def test_an_ego_says_what_it_was_trained_with_and_plays_as_a_member(
    partners: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = launch(tmp_path, "ego", make_ego_config("fcp", [f"{partners}:1,3"], SETTINGS, scale="smoke"), monkeypatch)
    ego, source = load_population(run), load_population(partners)
    (told,) = ego.info(1).extra["trained_with"]
    assert (told["method"], told["seed"], told["members"]) == ("mappo", 5, [1, 3])
    assert told["policy_sha256"] == [source.info(member).policy_sha256 for member in (1, 3)]
    assert ego.manifest.environment.fingerprint == source.manifest.environment.fingerprint
    response = make_ego_config("br", [str(run)], SETTINGS, scale="smoke")  # egos are partners like others
    launch(tmp_path, "response", response, monkeypatch)


def test_what_cannot_be_trained_is_told_in_one_line(partners: Path) -> None:
    for method, named, settings, field in (
        ("br", [str(partners)], {}, "ego.partners"),
        ("fcp", [f"{partners}:4"], {}, "ego.partners"),
        ("fcp", [f"{partners}:1,1"], {}, "ego.partners"),
        ("fcp", [f"{partners}:1", f"{partners}:1,2"], {}, "ego.partners"),
        ("sp", [], {"ego.other_starts": 0.5}, "ego.other_starts"),
        ("sp_aug", [], {"ego.sampling": "prioritised"}, "ego.sampling"),
        ("fcp", [str(partners)], {"run.seed.deeper": 1}, "run.seed.deeper"),
        ("sp", [str(partners)], {}, "ego.partners"),
        ("hipt", [], {}, "ego.partners"),
        ("mappo", [], {}, "method"),
        ("fcp", [str(partners)], {"ego.sequence": 7}, "ego.sequence"),
        ("hipt", [str(partners)], {"hipt.duration_most": 50}, "ego.unroll"),
        ("fcp", [str(partners)], {"cluster.agent_gpus": 1.0}, "cluster.agent_gpus"),
    ):
        with pytest.raises(UserError) as caught:
            preflight(make_ego_config(method, named, {**SETTINGS, **settings}, scale="smoke"))
        assert caught.value.field == field


@pytest.mark.parametrize(
    "word", ["ego.partners=[elsewhere]", "+ego.partners=[elsewhere]", "ego={partners:[elsewhere]}", "ego.pinned=[abc]"]
)
def test_what_follows_from_the_populations_is_not_given_beside_them(run: Run, partners: Path, word: str) -> None:
    given = ("ego", "train", "scale=smoke", word, "run.transport=inline", "--dry-run")
    for words in ((*given, f"{partners}:1"), given):
        code, _, err = run(*words)
        assert code == 2 and len(err.splitlines()) == 1, err
        assert "follows from the populations that are named" in err or word.startswith("+"), err
    with pytest.raises(UserError, match=r"ego.pinned: follows from"):
        make_ego_config("fcp", [str(partners)], {"ego.pinned": ["abc"]}, scale="smoke")


def test_a_folder_is_a_population_whatever_its_name(
    run: Run, partners: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("seed=1", "a:b=c"):
        shutil.copytree(partners, tmp_path / name)
    given = ("ego", "train", "scale=smoke", "seed=4", "run.transport=inline", "--dry-run", "--json")
    for words in (["seed=1"], ["seed=1:2", "a:b=c:1"], [str(tmp_path / "seed=1")]):
        code, out, err = run(*given, *words)
        told = json.loads(out)
        assert (code, err, told["ego"]["partners"], told["run"]["seed"]) == (0, "", words, 4)
    assert run(*given, "seed=1:4")[0] == 2


def test_a_population_means_each_of_its_policies_once(tmp_path: Path) -> None:
    """A half trained checkpoint may be the final one; random players have no weights to be told by."""
    spec = kitchen(horizon=40).spec
    writer = PopulationWriter(tmp_path / "skills", spec, method="fcp", config_digest="a" * 64, seed=5)
    for seed in (0, 1, 1):
        policy = FeedForwardPolicy(spec.views["features"], spec.num_actions, units=4, layers=1, seed=seed)
        writer.add_member(policy, seed=seed, steps={})
    for _ in range(2):
        writer.add_member(RandomPolicy(spec.num_actions), seed=9, steps={})
    assert read_partner(str(tmp_path / "skills")).members == (1, 2, 4, 5)
    config = make_ego_config("fcp", [str(tmp_path / "skills")], SETTINGS, scale="smoke")
    preflight(config)
    with pytest.raises(UserError, match="a member twice"):
        preflight(make_ego_config("fcp", [f"{tmp_path / 'skills'}:2,3"], SETTINGS, scale="smoke"))


def test_one_network_with_other_settings_is_another_partner(partners: Path) -> None:
    """Clones of people may share a network and act differently."""
    population = load_population(partners)
    info = population.info(1)
    infos = [info, info.model_copy(update={"config": {**info.config, "greedy": True}}), info.model_copy()]
    three = SimpleNamespace(members=infos, env_info=population.env_info)
    assert list_distinct(cast(Population, three)) == (1, 2)


def test_partners_that_changed_are_refused(partners: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = make_ego_config("fcp", [str(partners)], SETTINGS, scale="smoke")
    other = config.ego.model_copy(update={"pinned": ("0" * 64,)})
    with pytest.raises(UserError, match="has changed"):
        launch(tmp_path, "changed", config.model_copy(update={"ego": other}), monkeypatch)
    both = make_ego_config("fcp", [f"{partners}:1", f"{partners}:2"], SETTINGS, scale="smoke")
    for number, (pinned, told) in enumerate(
        ((("0" * 64, both.ego.pinned[0]), "has changed"), (both.ego.pinned[:1], "1 digests for 2"))
    ):
        other = both.ego.model_copy(update={"pinned": pinned})
        with pytest.raises(UserError, match=told):
            launch(tmp_path, f"changed{number}", both.model_copy(update={"ego": other}), monkeypatch)
