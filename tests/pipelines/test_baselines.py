"""Whole runs of MAPPO, LIPO and CoMeDi at `scale=smoke`: ledger, population, going on after an interruption."""

from __future__ import annotations

import json
import shutil
import sqlite3
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
import torch

from popgen.actors.ray_transport import RayTransport
from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.config.sections import ClusterConfig
from popgen.durable_files import load_state, save_state
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.methods.mappo import comedi, lipo
from popgen.methods.mappo.algorithm import Mappo as Algorithm
from popgen.methods.mappo.config import DiversityConfig
from popgen.methods.mappo.objective import SELF_PLAY
from popgen.methods.mappo.train import GroupProgress, check_card, learning_members
from popgen.methods.training import InlineTransport
from popgen.pipelines.population import open_training, run_population
from popgen.pipelines.training_driver import TrainingDriver
from popgen.population import Population, load_population
from popgen.progress import NullReporter
from popgen.runs.checkpoints import CheckpointFiles
from popgen.runs.ledger import Ledger
from popgen.runs.preflight import preflight
from popgen.runs.recorder import RunRecorder
from popgen.types import Kind

HORIZON = 40
SP_STEPS = 240
"""Of each member: three iterations of 4 environments and 20 steps."""


pytestmark = pytest.mark.usefixtures("cluster")


class Killed(RuntimeError):
    """Injected where a driver could be killed."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


def smoke(root: Path, name: str, *overrides: str, scale: str = "smoke") -> RunConfig:
    base = [f"scale={scale}", "tracking=off", f"env.params.horizon={HORIZON}", "seed=3", "evaluation.episodes=1"]
    return RunConfig.parse(compose([*base, f"run.root={root}", f"run.id={name}", *overrides]))


@dataclass
class Run:
    """A finished training: its folder, and what its algorithms said they stepped, by member and kind."""

    dir: Path
    said: Counter[tuple[int, str]]
    notes: list[str] = field(default_factory=list)

    @property
    def population(self) -> Population:
        return load_population(self.dir / "population")

    def ledger(self) -> list[tuple[Any, ...]]:
        """All entries, but for what tells attempts apart."""
        return [(e.member, e.kind, e.sequence, e.steps, e.episodes, e.score) for e in Ledger(self.dir / "ledger.jsonl")]

    def counted(self) -> Counter[tuple[int, str]]:
        """The ledger's totals by member and kind."""
        found: Counter[tuple[int, str]] = Counter()
        for entry in Ledger(self.dir / "ledger.jsonl"):
            found[entry.member, str(entry.kind)] += entry.steps
        return found

    def sha256s(self) -> list[str]:
        return [info.policy_sha256 for info in self.population.members]


class Notes(NullReporter):
    """Keeps what was told."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)


def train_members(config: RunConfig, reporter: NullReporter) -> Path:
    """One attempt of a run's driver; its folder."""
    spec = make_env(config.env.name, 1, **config.env.params).spec
    recorder = RunRecorder(config, spec)
    attempt, transport = f"{recorder.run_id}.{recorder.attempt}", RayTransport(config.cluster)
    training = open_training(config, spec, attempt, transport)
    files = CheckpointFiles(recorder.dir, long=training.log_rows, seconds=config.run.checkpoint_seconds)
    try:
        TrainingDriver(config, recorder, reporter, training, files).train_members()
    finally:
        training.close()
        recorder.close("FINISHED")
    return recorder.dir


def launch(
    root: Path,
    name: str,
    *overrides: str,
    die_at: str = "",
    scale: str = "smoke",
    before: Callable[[int, Algorithm], None] = lambda iteration, algorithm: None,
) -> Run:
    """Train without the evaluation after it. It dies at the beginning of the N-th call of METHOD (`METHOD:N`)."""
    config, reporter = smoke(root, name, *overrides, scale=scale), Notes()
    calls: Counter[str] = Counter()
    said: Counter[tuple[int, str]] = Counter()

    def called(method: str) -> None:
        calls[method] += 1
        if f"{method}:{calls[method]}" == die_at:
            raise Killed(die_at)

    with pytest.MonkeyPatch.context() as patch:

        def train(self: Algorithm, original: Any = Algorithm.train) -> Any:
            called("train")
            before(calls["train"], self)
            result = original(self)
            for counted in self.report.counted:
                said[counted.owner, str(counted.kind)] += counted.steps
            return result

        def save(self: CheckpointFiles, *given: Any, original: Any = CheckpointFiles.save) -> None:
            called("save")
            original(self, *given)

        def save_member(self: CheckpointFiles, *given: Any, original: Any = CheckpointFiles.save_member) -> None:
            called("save")
            original(self, *given)

        def add(self: RunRecorder, *given: Any, original: Any = RunRecorder.add_member, **named: Any) -> None:
            called("add")
            original(self, *given, **named)
            called("added")

        patch.setattr(Algorithm, "train", train)
        patch.setattr(CheckpointFiles, "save", save)
        patch.setattr(CheckpointFiles, "save_member", save_member)
        patch.setattr(RunRecorder, "add_member", add)
        folder = train_members(config, reporter)
    return Run(folder, said, reporter.notes)


SIZES = {"mappo": "population.size=2", "lipo": "population.size=3", "comedi": "population.size=3"}


@pytest.fixture(scope="module")
def runs(root: Path) -> dict[str, Run]:
    return {method: launch(root, method, f"method={method}", size) for method, size in SIZES.items()}


@pytest.mark.parametrize("method", SIZES)
def test_the_ledger_holds_what_the_runners_stepped(method: str, runs: dict[str, Run]) -> None:
    run = runs[method]
    assert run.counted() == run.said
    for member in run.population.members:
        row = {kind: steps for (owner, kind), steps in run.said.items() if owner == member.id}
        assert member.steps == row and row["SP"] == SP_STEPS and member.seed == 3000 + member.id


def test_steps_by_kind(runs: dict[str, Run]) -> None:
    """Cross-play has 4 environments with each partner, mixed play 4 with the strongest; CoMeDi chooses it by an
    episode with each partner in each seat at iterations 1 and 3."""
    assert set(runs["mappo"].said) == {(1, "SP"), (2, "SP")}
    lipo, comedi = runs["lipo"].said, runs["comedi"].said
    assert [lipo[m, "XP"] for m in (1, 2, 3)] == [0, SP_STEPS, 2 * SP_STEPS]
    assert [comedi[m, "MP"] for m in (1, 2, 3)] == [0, SP_STEPS, SP_STEPS]
    fresh = 2 * 2 * HORIZON
    assert [comedi[m, "XP"] for m in (1, 2, 3)] == [0, SP_STEPS + fresh, SP_STEPS + 2 * fresh]


def test_members_act_without_rllib(runs: dict[str, Run]) -> None:
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
    subprocess.run([sys.executable, "-c", code, str(runs["lipo"].dir / "population")], check=True, timeout=240)


def test_critics_are_kept_by_kind_and_partner(runs: dict[str, Run]) -> None:
    expected = {
        "mappo": [{"SP"}, {"SP"}],
        "lipo": [{"SP", "XP_2", "XP_3"}, {"SP", "XP_1", "XP_3"}, {"SP", "XP_1", "XP_2"}],
        "comedi": [{"SP"}, {"SP", "XP_1", "MP_1"}, {"SP", "XP_1", "XP_2", "MP_1", "MP_2"}],
    }
    for method, names in expected.items():
        tensors = [runs[method].population.training(m) or {} for m in range(1, len(names) + 1)]
        assert [{name.split(".")[1] for name in found} for found in tensors] == names


def test_members_differ(runs: dict[str, Run]) -> None:
    for run in runs.values():
        found = run.sha256s()
        assert len(set(found)) == len(found)


def test_metrics_tell_what_training_did(runs: dict[str, Run]) -> None:
    rows = [json.loads(line) for line in (runs["comedi"].dir / "metrics.jsonl").open()]
    last = [row for row in rows if row["member"] == 3]
    wanted = {"ppo/entropy", "ppo/xp_reward", "ppo/mp_reward", "ppo/kl", "ppo/update_ms", "real_xp"}
    assert len(last) == 3 and wanted <= set().union(*last)
    assert last[-1]["step"] == sum(steps for (m, _), steps in runs["comedi"].said.items() if m == 3)


def test_sequential_lipo_meets_its_predecessors_only(root: Path) -> None:
    run = launch(root, "sequential", "method=lipo", "population.size=2", "diversity.order=sequential")
    assert run.said == {(1, "SP"): SP_STEPS, (2, "SP"): SP_STEPS, (2, "XP"): SP_STEPS}
    assert "critics.XP_1.mean" in (run.population.training(2) or {})


def test_fcp_keeps_a_seed_at_three_skills(root: Path) -> None:
    """Killed at the second iteration and gone on with: the same members, none of whose steps is counted twice. The half
    trained one is a policy that has played: the second or the third, not the final one."""
    overrides = ("method=fcp", "population.size=3")
    whole = launch(root, "fcp", *overrides)
    with pytest.raises(Killed):
        launch(root, "fcp_again", *overrides, die_at="train:2")
    again = launch(root, "fcp_again", *overrides)
    assert again.sha256s() == whole.sha256s() and len(set(whole.sha256s())) == 3
    assert whole.said == whole.counted() == again.counted() == {(3, "SP"): SP_STEPS}
    extra = [whole.population.info(member).extra for member in (1, 2, 3)]
    assert [one["skill"] for one in extra] == ["initial", "half", "final"]
    assert extra[0]["at_steps"] == 0 and extra[1]["at_steps"] in (80, 160) and extra[1]["of_member"] == 3
    assert [one["seconds"] for one in extra[:2]] == [0.0, 0.0] and "seconds" in extra[2]


def test_members_that_are_paid_for_diversity_learn_together(root: Path) -> None:
    """TrajeDi's weight of 0 gives the weights of MEP's weight of 0, and another one others."""
    runs = {
        name: launch(root, name, f"method={name.partition('_')[0]}", "population.size=2", *overrides)
        for name, overrides in {
            "mep_0": ("mep.alpha=0",),
            "trajedi_0": ("trajedi.alpha=0",),
            "trajedi_1": ("trajedi.alpha=1",),
        }.items()
    }
    assert runs["mep_0"].sha256s() == runs["trajedi_0"].sha256s() != runs["trajedi_1"].sha256s()
    for run in runs.values():
        assert run.counted() == run.said == {(1, "SP"): SP_STEPS, (2, "SP"): SP_STEPS}
    rows = [json.loads(line) for line in (runs["trajedi_1"].dir / "metrics.jsonl").open()]
    assert all(np.isfinite(row["ppo/bonus"]) and row["ppo/bonus"] != 0.0 for row in rows)


WITHOUT_WEIGHT = {
    "mep": ("mep.alpha=0",),
    "trajedi": ("trajedi.alpha=0",),
    "e3t": ("e3t.epsilon=0",),
    "hsp": ("hsp.members=partners", "hsp.pool=1", "hsp.spread=0"),
}


def test_a_weight_of_zero_is_mappo_bit_for_bit(root: Path) -> None:
    """One member of each; HSP's utility is the true reward then, and one policy has both seats."""
    plain = launch(root, "plain", "method=mappo", "population.size=1")
    for method, overrides in WITHOUT_WEIGHT.items():
        run = launch(root, f"{method}_without", f"method={method}", "population.size=1", *overrides)
        assert run.sha256s() == plain.sha256s(), method
        assert run.ledger() == plain.ledger(), method


def test_brdiv_keeps_pairs_and_counts_their_cross_play(root: Path) -> None:
    """Two pairs; killed between two members, it ends the same. Cross-play of 4 environments a confederate counts for
    it, the pair's own play for its best response."""
    overrides = ("method=brdiv", "population.size=4")
    whole = launch(root, "brdiv", *overrides)
    with pytest.raises(Killed):
        launch(root, "brdiv_again", *overrides, die_at="added:1")
    again = launch(root, "brdiv_again", *overrides)
    assert again.sha256s() == whole.sha256s() and again.ledger() == whole.ledger()
    extra = [whole.population.info(member).extra for member in (1, 2, 3, 4)]
    assert [(one["role"], one["pair"]) for one in extra] == [
        *(("confederate", 1), ("partner", 1)),
        *(("confederate", 2), ("partner", 2)),
    ]
    own, crossed = {(m, "SP"): SP_STEPS for m in (2, 4)}, {(m, "XP"): SP_STEPS for m in (1, 3)}
    assert whole.counted() == own | crossed and whole.counted().total() == whole.said.total()


def test_hsp_keeps_pairs_with_their_roles_and_counts_the_whole_pool(root: Path) -> None:
    """One pair of three, evenly counted; killed at the second iteration, or between two members, it ends the same."""
    overrides = ("method=hsp", "population.size=2", "hsp.pool=3")
    whole = launch(root, "hsp", *overrides)
    for name, die_at in (("hsp_early", "train:2"), ("hsp_late", "added:1")):
        with pytest.raises(Killed):
            launch(root, name, *overrides, die_at=die_at)
        again = launch(root, name, *overrides)
        assert again.sha256s() == whole.sha256s() and again.ledger() == whole.ledger()
    assert whole.said == {(pair, "SP"): SP_STEPS for pair in (1, 2, 3)}
    assert whole.counted() == {(member, "SP"): 3 * SP_STEPS // 2 for member in (1, 2)}
    assert any(note.startswith("3 of 3 pairs with a score of at most 0.1 dishes") for note in whole.notes)
    biased, partner = (whole.population.info(member).extra for member in (1, 2))
    assert (biased["role"], partner["role"]) == ("biased", "partner")
    assert biased["pair"] == partner["pair"] and biased["utility"] == partner["utility"]
    assert 0 < sum(biased["events"].values()) != sum(partner["events"].values())


def test_beside_a_mixture_partner_a_run_ends_as_any(root: Path) -> None:
    run = launch(root, "e3t", "method=e3t", "population.size=1")
    assert run.counted() == run.said == {(1, "SP"): SP_STEPS}
    rows = [json.loads(line) for line in (run.dir / "metrics.jsonl").open()]
    assert "real_sp_noisy" in rows[-1] and "sp_noisy" in run.population.info(1).extra
    assert run.sha256s() != launch(root, "e3t_none", "method=e3t", "population.size=1", "e3t.epsilon=0").sha256s()


METHODS = {
    "concurrent": ("method=lipo",),
    "sequential": ("method=lipo", "diversity.order=sequential"),
    "comedi": ("method=comedi",),
}


@pytest.mark.parametrize("kind", METHODS)
def test_rendezvous(kind: str, root: Path) -> None:
    """An environment without weighted events, whose episodes can terminate."""
    run = launch(root, f"rendezvous_{kind}", *METHODS[kind], "env=rendezvous/mppmr", "population.size=3")
    assert run.counted() == run.said and len(set(run.sha256s())) == 3
    fresh = 2 * 2 * HORIZON * (kind == "comedi")
    strongest = kind == "comedi"  # alone is met in training
    for member in (1, 2, 3):
        partners = member - 1
        assert run.said[member, "SP"] == SP_STEPS
        met = min(partners, 1) if strongest else partners
        assert run.said[member, "XP"] == met * SP_STEPS + partners * fresh
        assert run.said[member, "MP"] == (SP_STEPS if strongest and partners else 0)
    env = run.population.make_env(2)
    for policy in run.population:
        policy.reset(2, 0)
        actions = policy.act(env.observe(policy.view), np.zeros((2, 2), np.uint8), np.ones(2, bool))
        assert actions.shape == (2, 2)


def test_without_weight_there_is_no_mixed_play(root: Path) -> None:
    run = launch(root, "unmixed", "method=comedi", "population.size=2", "diversity.lambda_mp=0")
    assert run.said == {(1, "SP"): SP_STEPS, (2, "SP"): SP_STEPS, (2, "XP"): SP_STEPS + 2 * 2 * HORIZON}


PAPER_BUT_SHORT = (
    *("ppo.envs=2", "ppo.steps=10", "ppo.epochs=1", "ppo.minibatches=2", "ppo.max_steps=40"),
    "population.size=2",
)
FEW_PARTNERS = ("diversity.xp_envs=2", "diversity.mp_envs=2", "diversity.select_episodes=1")


@pytest.mark.parametrize("method", ["mappo", "lipo", "comedi"])
def test_the_papers_sizes_train(method: str, root: Path) -> None:
    """The convolutional networks of `scale=paper`, for a few steps; the member acts on the grid."""
    partners = () if method == "mappo" else FEW_PARTNERS
    run = launch(root, f"paper_{method}", f"method={method}", *PAPER_BUT_SHORT, *partners, scale="paper")
    assert run.counted() == run.said and run.said[2, "SP"] == 40
    policy = run.population[2]
    assert policy.view == "lossless" and policy.config()["kernels"] == [5, 3, 3] and policy.config()["units"] == 512
    env = run.population.make_env(2)
    policy.reset(2, 0)
    actions = policy.act(env.observe("lossless"), np.zeros((2, 2), np.uint8), np.ones(2, bool))
    assert actions.shape == (2, 2)
    rows = [json.loads(line) for line in (run.dir / "metrics.jsonl").open()]
    assert len(rows) == 4  # two iterations of each member
    assert all(np.isfinite(row["ppo/policy_loss"]) and row["ppo/value_loss"] > 0 for row in rows)


def test_a_killed_runner_costs_no_step_and_counts_none_twice(root: Path) -> None:
    """Two remote runners, one of them killed in the second iteration: the ledger is what came back, and reaches the
    budget."""

    def kill(iteration: int, algorithm: Algorithm) -> None:
        if iteration == 2:
            ray.kill(algorithm.env_runner_group._worker_manager.actors()[2], no_restart=False)

    overrides = ("method=lipo", "population.size=2", "ppo.runners=2", "cluster.sampler_cpus=0.1", "ppo.max_steps=400")
    run = launch(root, "shot", *overrides, before=kill)
    assert run.counted() == run.said
    samplers = {entry.sampler.split(".")[0] for entry in Ledger(run.dir / "ledger.jsonl")}
    assert samplers == {"runner1", "runner2"} and len(run.population) == 2
    for member in (1, 2):  # an iteration is 80 steps, of which a lost share may be missing
        assert 400 <= run.said[member, "SP"] < 480
    assert run.said[2, "XP"] == run.said[2, "SP"]
    # Each runner has half of both members' self-play and of their cross-play: three entries of 40 steps.
    steps = [entry.steps for entry in Ledger(run.dir / "ledger.jsonl")]
    told = [text for text in run.notes if text.startswith("runner 2 was lost")]
    iterations = sum(json.loads(line)["member"] == 1 for line in (run.dir / "metrics.jsonl").open())
    assert steps == [40] * (6 * iterations - 3 * len(told)) and told


def test_a_whole_run_is_evaluated(root: Path) -> None:
    overrides = ("method=lipo", "population.size=2", "tracking.enabled=true")
    result = run_population(smoke(root, "whole", *overrides), reporter=NullReporter())
    table = result["ledger"]
    assert {kind: table["2"][kind] for kind in ("SP", "XP")} == {"SP": SP_STEPS, "XP": SP_STEPS}
    assert table["population"]["evaluation"] > 0 and np.shape(result["matrix"]["mean"]) == (2, 2)
    with sqlite3.connect(root / "mlflow.db") as store:
        statuses = [status for (status,) in store.execute("select status from runs")]
        points = dict(store.execute("select key, count(*) from metrics group by key"))
    assert statuses == ["FINISHED"] * 3  # the population, and each member nested in it
    assert points["ppo/kl"] == 6 and points["real_sp"] > 0 and points["sp"] == points["xp"] == 1


@pytest.mark.parametrize(
    ("target", "aim"), [(10, "25% of its target, 10.00"), (1000, "no better than with a random partner, 0.00")]
)
def test_members_that_all_stand_still_are_named(target: int, aim: str, root: Path) -> None:
    """Measured by each other they would be alike; `popgen run` ends with 3 where any is named."""
    overrides = ("method=mappo", "population.size=2", "evaluation.weak_share=0.25", f"ppo.target_score={target}")
    result = run_population(smoke(root, f"still_{target}", *overrides), reporter=NullReporter())
    assert [line.partition(":")[0] for line in result["weak_members"]] == [f"member {m} does not play" for m in (1, 2)]
    assert all(aim in line for line in result["weak_members"])


DEATHS = {"mappo": ("train:2", "save:4", "added:1"), "lipo": ("train:3", "added:2"), "comedi": ("train:5", "save:7")}
"""Before an iteration; before its checkpoint is written; before a member's; after a member was added."""


@pytest.mark.parametrize(("method", "die_at"), [(m, at) for m, points in DEATHS.items() for at in points])
def test_a_killed_run_ends_as_one_that_was_not(method: str, die_at: str, root: Path, runs: dict[str, Run]) -> None:
    whole, name = runs[method], f"{method}_{die_at.replace(':', '_')}"
    with pytest.raises(Killed):
        launch(root, name, f"method={method}", SIZES[method], die_at=die_at)
    run = launch(root, name, f"method={method}", SIZES[method])
    assert run.sha256s() == whole.sha256s() and run.ledger() == whole.ledger()


def interrupted(root: Path, name: str) -> Path:
    """A run of MAPPO that died before its third iteration, with two checkpoints."""
    with pytest.raises(Killed):
        launch(root, name, "method=mappo", SIZES["mappo"], die_at="train:3")
    folder = root / name / "checkpoints"
    assert len(list(folder.glob("progress_*"))) == 2
    return folder


def damage(folder: Path) -> None:
    path = folder / "arrays.safetensors"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(bytes(data))


def test_a_damaged_checkpoint_gives_way_to_the_one_before(root: Path, runs: dict[str, Run]) -> None:
    folder = interrupted(root, "damaged")
    damage(max(folder.glob("progress_*")))
    run = launch(root, "damaged", "method=mappo", SIZES["mappo"])
    assert any("the checkpoint before it counts" in text for text in run.notes)
    assert run.sha256s() == runs["mappo"].sha256s() and run.ledger() == runs["mappo"].ledger()


def test_without_a_whole_checkpoint_it_is_told_in_one_line(root: Path) -> None:
    folder = interrupted(root, "ruined")
    for path in folder.glob("progress_*"):
        damage(path)
    with pytest.raises(UserError, match="unreadable checkpoint"):
        launch(root, "ruined", "method=mappo", SIZES["mappo"])


def test_a_ledger_that_lacks_entries_is_refused(root: Path) -> None:
    interrupted(root, "short")
    path = root / "short" / "ledger.jsonl"
    path.write_text(path.read_text().splitlines(keepends=True)[0])
    with pytest.raises(UserError, match="the checkpoint knows 2") as caught:
        launch(root, "short", "method=mappo", SIZES["mappo"])
    assert caught.value.field.endswith("ledger.jsonl")


def test_a_checkpoint_of_other_sizes_is_refused(root: Path) -> None:
    interrupted(root, "other")
    for path in (root / "other" / "checkpoints").glob("progress_*"):
        state = load_state(path)
        state["algorithm"]["learner"]["modules"]["1"]["actor.0.weight"] = np.zeros((3, 3), np.float32)
        save_state(path, state)
    with pytest.raises(UserError, match="does not fit this run"):
        launch(root, "other", "method=mappo", SIZES["mappo"])
    shutil.rmtree(root / "other")


def test_a_card_that_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    check_card(ClusterConfig())
    with pytest.raises(UserError, match="cluster.agent_gpus: 1, but the driver.* sees no GPU"):
        check_card(ClusterConfig(agent_gpus=1.0))


def test_runners_that_find_no_room_are_refused(root: Path) -> None:
    """RLlib would wait for them for ever."""
    few = ("ppo.runners=3", "cluster.sampler_cpus=1", "cluster.wait_seconds=0")
    with pytest.raises(UserError, match="the actors ask for 3 CPU, the cluster has 2"):
        launch(root, "no_room", "method=mappo", *few)


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


def test_rllib_needs_ray(root: Path) -> None:
    config = smoke(root, "inline", "method=lipo")
    spec = make_env(config.env.name, 1, **config.env.params).spec
    with pytest.raises(UserError, match="run.transport: is inline, but RLlib needs Ray"):
        preflight(smoke(root, "inline", "method=lipo", "run.transport=inline"))
    with pytest.raises(UserError, match="run.transport: is inline, but RLlib needs Ray"):
        open_training(config, spec, "inline.1", InlineTransport())


def test_objectives_say_what_is_sampled_and_its_sign() -> None:
    recipe, unmixed = DiversityConfig(lambda_xp=0.5, lambda_mp=0.25), DiversityConfig(lambda_xp=0.0, lambda_mp=0.0)

    def signed(terms: Any) -> dict[str, float]:
        return {str(term.kind): term.sign * term.weight(recipe) for term in terms}

    assert signed(SELF_PLAY.terms) == {}
    assert signed(lipo.OBJECTIVE.terms) == {"XP": -0.5}
    assert signed(comedi.OBJECTIVE.terms) == {"MP": 0.25, "XP": -0.5}
    for objective, samples in ((SELF_PLAY, ()), (lipo.OBJECTIVE, ("XP",)), (comedi.OBJECTIVE, ("XP", "MP"))):
        assert [kind for kind in ("XP", "MP") if objective.samples(Kind(kind), recipe)] == list(samples)
    assert comedi.OBJECTIVE.samples(Kind.XP, unmixed) and not comedi.OBJECTIVE.samples(Kind.MP, unmixed)


def test_who_learns_together(root: Path) -> None:
    together = smoke(root, "group", "method=lipo", "population.size=3")
    alone = smoke(root, "group", "method=lipo", "population.size=3", "diversity.order=sequential")
    assert learning_members(lipo.OBJECTIVE, together, 2) == (1, 2, 3)
    assert learning_members(lipo.OBJECTIVE, alone, 2) == (2,)
    assert learning_members(SELF_PLAY, together, 2) == (2,)


def test_progress_is_read_by_name() -> None:
    progress = GroupProgress(sequence=4, seconds=1.5, steps={2: 80, 3: 160})
    saved = {"sequence": 4, "seconds": 1.5, "steps": {"2": 80, "3": 160}}
    assert GroupProgress.from_state(saved) == progress
    with pytest.raises(KeyError):
        GroupProgress.from_state({"sequence": 4})


PAPER = {
    "overcooked/cramped_room": (6e6, 6e-4, 3e-3),
    "overcooked/asymmetric_advantages": (6e6, 1e-3, 4e-3),
    "overcooked/coordination_ring": (6e6, 8e-4, 5e-3),
    "overcooked/forced_coordination": (6e6, 6e-4, 8e-3),
    "overcooked/counter_circuit_o_1order": (6e6, 6e-4, 8e-3),
    "rendezvous/mppmr": (8e5, 5e-4, 1e-4),
}
"""Environment -> steps, learning rate and entropy of the paper's tables."""


@pytest.mark.parametrize("env", PAPER)
def test_the_papers_numbers(env: str) -> None:
    lipo = RunConfig.parse(compose(["method=lipo", "scale=paper", f"env={env}"]))
    comedi = RunConfig.parse(compose(["method=comedi", "scale=paper", f"env={env}"]))
    assert lipo.ppo == comedi.ppo and (lipo.ppo.max_steps, lipo.ppo.learning_rate, lipo.ppo.entropy) == PAPER[env]
    assert (lipo.diversity.lambda_xp, comedi.diversity.lambda_xp, comedi.diversity.lambda_mp) == (0.25, 0.5, 0.25)
    ppo, flat = lipo.ppo, env.startswith("rendezvous")
    assert (ppo.units, ppo.layers, ppo.cnn_kernels, ppo.activation) == (
        (512, 5, (), "leaky_relu") if flat else (512, 3, (5, 3, 3), "leaky_relu")
    )
    # As many fresh steps with each partner, in both seatings, as self-play has in an iteration.
    horizon = make_env(lipo.env.name, 1, **lipo.env.params).spec.horizon
    assert 2 * comedi.diversity.select_episodes * horizon == ppo.envs * ppo.steps
    assert comedi.diversity.order == "sequential" and lipo.diversity.order == "concurrent"
