"""`popgen compare` and `popgen experiment self-sabotage`, on runs that a stand-in for training writes at once."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.finished import CRAMPED, finished_run

import popgen.pipelines as pipelines
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.evaluation.sabotage import measure_sabotage
from popgen.pipelines.experiments import open_sources, sample_pair
from popgen.pipelines.run_batch import check_different, named, run_all
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy
from popgen.population import PopulationWriter, load_population
from popgen.progress import NullReporter
from popgen.runs.ledger import Ledger
from popgen.runs.mlflow_tracker import SCALING_METRIC

pytestmark = pytest.mark.usefixtures("quick_pictures")

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[RunConfig]:
    """Training that takes no time; the configs it was called with."""
    calls: list[RunConfig] = []

    def train(config: RunConfig, *, reporter: Any) -> None:
        calls.append(config)
        steps = [{"SP": 100 * member, "XP": 10 * (member - 1)} for member in range(1, config.population.size + 1)]
        name, params = config.env.name, dict(config.env.params)
        root, seed = Path(config.run.root), config.run.seed
        finished_run(root, str(config.run.id), steps, method=config.method, seed=seed, env=name, params=params)

    module = type(sys)("popgen.pipelines.population")
    module.run_population = train  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "popgen.pipelines.population", module)
    monkeypatch.setattr(pipelines, "population", module, raising=False)
    monkeypatch.setitem(sys.modules, "ray", None)
    return calls


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Finished runs of two methods on the cramped room, two seeds of one of them."""
    root = tmp_path_factory.mktemp("finished")
    curves = {1: [(300, 9.0, None)], 2: [(40, 9.0, 1.0)]}
    model = [{"random": 500, "SP": 500}, {"SP": 30, "XP": 20}]
    lipo = [{"SP": 800}, {"SP": 800, "XP": 400}]
    return {
        "model": finished_run(root, "model", model, curves=curves),
        "model1": finished_run(root, "model1", model, curves=curves, seed=1),
        "lipo": finished_run(root, "lipo", lipo, method="lipo", curves={1: [(500, 9.0, None)]}),
    }


def refused(result: tuple[int, str, str], *fragments: str) -> None:
    code, out, err = result
    assert code == 2 and out == "" and err.startswith("popgen: error: ") and err.count("\n") == 1, err
    for fragment in fragments:
        assert fragment in err


# --- popgen compare


def test_compare_gives_tables_charts_and_mlflow_metrics_by_number_of_agents(run: Run, runs: dict[str, Path]) -> None:
    from mlflow.tracking import MlflowClient

    words = ("--agents", "4", "--sp", "0", "--xp", "9", "--episodes", "2", "--out", "out", "--quiet", "--json")
    code, out, _ = run("compare", *map(str, runs.values()), *words)
    told = json.loads(out)
    assert {row["held_episodes"] for row in told["runs"]} == {2}  # the same for every method
    assert code == 0 and [row["label"] for row in told["runs"]] == ["xpm_wm", "xpm_wm", "lipo"]
    assert all(Path(path).stat().st_size for path in told["files"].values())
    client = MlflowClient(tracking_uri="sqlite:///out/mlflow.db")
    experiment = client.get_experiment_by_name("popgen-compare")
    found = {one.info.run_name: one for one in client.search_runs([experiment.experiment_id])}
    assert set(found) == {f"xpm_wm/{CRAMPED}/s0", f"xpm_wm/{CRAMPED}/s1", f"lipo/{CRAMPED}/s0", "comparison"}

    def history(name: str, metric: str) -> list[tuple[int, float]]:
        points = client.get_metric_history(found[name].info.run_id, metric)
        return sorted((point.step, point.value) for point in points)

    lipo = f"lipo/{CRAMPED}/s0"
    assert history(lipo, SCALING_METRIC) == [(0, 0), (1, 800), (2, 2000)]
    assert history("comparison", f"environment_steps/{lipo}") == [(0, 0), (1, 800), (2, 2000)]
    parent = found["comparison"].info.run_id
    place = f"experiments/{experiment.experiment_id}/runs/{parent}?workflowType=machine_learning"
    assert told["tracking"]["address"] == f"http://127.0.0.1:5000/#/{place}"
    assert all(found[name].data.tags["mlflow.parentRunId"] == parent for name in found if name != "comparison")
    assert all(
        any(point.value for point in client.get_metric_history(one.info.run_id, metric))
        for one in found.values()
        for metric in one.data.metrics
    )  # no empty charts
    assert (
        all(one.data.metrics for one in found.values())
        and "get-artifact" in (found["comparison"].data.tags["mlflow.note.content"])
    )
    assert history(lipo, f"{SCALING_METRIC}_extrapolated") == []
    assert history(lipo, "XP_steps_by_members") == [(1, 0), (2, 400)]
    assert history(lipo, "seconds_by_members") == [(1, 60), (2, 120)]
    assert history(f"xpm_wm/{CRAMPED}/s1", "steps_to_quality_by_members") == [(1, 1000), (2, 1050)]
    assert history(lipo, "steps_to_quality_by_members") == [(1, 2000), (2, 2000)]  # they learn together
    assert found[lipo].data.params["environment"] == CRAMPED and found[lipo].info.status == "FINISHED"
    assert {one.path for one in client.list_artifacts(found["comparison"].info.run_id, "comparison")} >= {
        "comparison/steps.png",
        "comparison/costs.csv",
    }


def test_compare_prints_tables_and_can_leave_mlflow_out(run: Run, runs: dict[str, Path]) -> None:
    code, out, _ = run("compare", f"mine={runs['model']}", str(runs["lipo"]), "--no-tracking", "--sp", "99")
    assert code == 0 and "mine" in out and "LIPO" in out and "SP >= 99" in out and "> 1,050" in out
    assert "what each method was given" in out and "* extrapolated" in out
    assert "report: comparison (" in out and not Path("comparison/mlflow.db").exists()


def test_compare_is_the_same_from_the_same_ledgers(run: Run, runs: dict[str, Path], tmp_path: Path) -> None:
    for out in ("a", "b"):
        assert run("compare", str(runs["model"]), "--no-tracking", "--out", out)[0] == 0
    assert all((tmp_path / "b" / path.name).read_bytes() == path.read_bytes() for path in (tmp_path / "a").iterdir())


def test_compare_refuses_in_one_line(run: Run, runs: dict[str, Path], tmp_path: Path) -> None:
    part = shutil.copytree(runs["model"], tmp_path / "part")
    shutil.rmtree(part / "report")
    interact = finished_run(tmp_path, "interact", [{"SP": 1}], method="lipo", params={"cooking": "interact"})
    model = str(runs["model"])
    refused(run("compare"), "none to compare")
    refused(run("compare", "nowhere"), "nowhere", "is no run")
    refused(run("compare", model, str(part)), "part", "is unfinished")
    refused(run("compare", model, str(interact)), "cooking is interact", "it is auto")
    refused(run("compare", model, model), "given twice")
    refused(run("compare", model, "--agents", "0"), "--agents")
    refused(run("compare", model, "--sp", "many"), "--sp")
    refused(run("compare", model, "--tracking-uri", "file:///x"), "tracking.uri")
    refused(run("compare", model, "--start", "method=lipa"), "lipa")
    assert not (tmp_path / "comparison").exists()


def test_compare_starts_runs_and_finds_them_finished_again(run: Run, trained: list[RunConfig]) -> None:
    start = ("--start", "method=lipo seed=1", "--start", "method=mappo", "--set", "population.size=2", "--no-tracking")
    code, out, err = run("compare", *start, "--json")
    assert code == 0, err
    told = json.loads(out)
    assert [(row["label"], row["seed"], row["members"]) for row in told["runs"]] == [("lipo", 1, 2), ("mappo", 0, 2)]
    assert [config.method for config in trained] == ["lipo", "mappo"]
    assert all(Path(row["path"]).parent == Path("comparison/runs") for row in told["runs"])
    assert run("compare", *start)[0] == 0 and len(trained) == 2
    refused(run("compare", "--start", "seed=1", "--start", "seed=1"), "run.id", "two runs")


def test_what_is_there_is_checked_before_anything_starts(
    run: Run, trained: list[RunConfig], runs: dict[str, Path]
) -> None:
    refused(run("compare", "nowhere", "--start", "method=mappo"), "nowhere")
    refused(run("compare", str(runs["lipo"]), "--start", "method=mappo"), "horizon is 400, there 20")
    other = (
        "compare",
        "--start",
        "method=lipo",
        "--start",
        "method=lipo seed=1 diversity.lambda_xp=0",
        "--no-tracking",
    )
    refused(run(*other), "diversity.lambda_xp is 0", "NAME=RUN")
    refused(run("compare", "--start", "method='lipo"), "--start")
    assert not trained


def test_a_started_run_may_have_a_name(run: Run, trained: list[RunConfig]) -> None:
    starts = ("--start", "method=lipo", "--start", "label=alone method=lipo diversity.lambda_xp=0")
    code, out, err = run("compare", *starts, "--set", "population.size=2", "--no-tracking", "--json")
    assert code == 0, err
    assert [row["label"] for row in json.loads(out)["runs"]] == ["lipo", "alone"] and len(trained) == 2


def test_a_runs_name_is_decided_by_its_settings(tmp_path: Path) -> None:
    first, second = (named(RunConfig.parse({"population": {"size": size}}), tmp_path) for size in (2, 3))
    assert first.run.id != second.run.id and str(first.run.id).startswith("xpm_wm-cramped_room-s0-")
    assert named(first, tmp_path) == first and first.digest() == RunConfig.parse({"population": {"size": 2}}).digest()
    check_different([first, second])
    with pytest.raises(UserError, match="two runs are called"):
        check_different([first, first])


def test_an_unfinished_run_is_run_again(trained: list[RunConfig], tmp_path: Path) -> None:
    config = named(RunConfig.parse({"method": "mappo", "population": {"size": 1}}), tmp_path)
    (folder,) = run_all([config], reporter=NullReporter())
    (folder / "report" / "crossplay.json").unlink()
    shutil.rmtree(folder / "population")
    (folder / "ledger.jsonl").unlink()
    assert run_all([config], reporter=NullReporter()) == [folder] and len(trained) == 2


# --- popgen experiment self-sabotage


def population(path: Path, *, method: str = "lipo", seed: int = 1, members: str = "irr", **params: Any) -> Path:
    """Idle (i) and random (r) members for rendezvous."""
    spec = make_env("rendezvous/mppmr", 1, **params).spec
    writer = PopulationWriter(path, spec, method=method, config_digest="0" * 64, seed=seed)
    for member, sort in enumerate(members, start=1):
        policy = IdlePolicy(spec.action_names) if sort == "i" else RandomPolicy(spec.num_actions)
        writer.add_member(policy, seed=member, steps={"SP": 10})
    return path


def test_self_sabotage_of_finished_populations(run: Run, tmp_path: Path) -> None:
    one = population(tmp_path / "one")
    other = population(tmp_path / "run" / "population", method="comedi", exit_penalty="none")
    named_ones = ("--population", f"lipo={one}", "--population", f"comedi={other.parent}")
    arguments = ("experiment", "self-sabotage", *named_ones, "--episodes", "3", "--out", "out")
    code, out, err = run(*arguments, "--json")
    assert code == 0, err
    told = json.loads(out)
    assert [(row["name"], row["termination"]) for row in told["rows"]] == [("LIPO", "penalty"), ("CoMeDi", "plain")]
    lipo, comedi = told["rows"]
    # The same players and seed: the same exits, whatever they cost.
    assert lipo["self_sabotage"] == comedi["self_sabotage"] and lipo["scored"] == comedi["scored"]
    assert lipo["xp"] == lipo["scored"]["penalty"]["xp"] and comedi["xp"] == lipo["scored"]["plain"]["xp"]
    assert comedi["xp"]["mean"] > lipo["xp"]["mean"]
    ledger = Ledger(tmp_path / "out" / "ledger.jsonl")
    assert ledger.steps(kind="evaluation") == told["steps"]["evaluation"] == 4 * (9 + 12) * 3 * 50
    assert {"paths-lipo-penalty-s1.png", "paths-samples-plain.svg", "self_sabotage.csv"} <= set(told["files"])
    assert all(Path(path).stat().st_size for path in told["files"].values())
    code, out, _ = run(*arguments)
    assert code == 0 and "LIPO, seed 1" in out and "XPM-Sim, paper" in out
    assert Ledger(tmp_path / "out" / "ledger.jsonl").steps() == 2 * told["steps"]["evaluation"]


@pytest.mark.end_to_end
def test_self_sabotage_trains_every_row_with_equal_options(run: Run, trained: list[RunConfig]) -> None:
    """Each method with the paper's objective and with ours, which has the same floor, bound and limit in all, and
    self-play alone as the control."""
    code, out, err = run("experiment", "self-sabotage", "population.size=2", "--episodes", "1", "--json")
    assert code == 0, err
    rows = [row["name"] for row in json.loads(out)["rows"]]
    assert rows == [
        "XPM-Sim, self-play",
        *(f"{m}, {o}" for m in ("XPM-Sim", "LIPO", "CoMeDi") for o in ("paper", "ours")),
    ]
    control, *others = trained
    assert (control.method, control.xpm_sim.lambda_xp, control.xpm_sim.restart_weight) == ("xpm_sim", 0.0, 0.0)
    options = [c.xpm_sim if c.method == "xpm_sim" else c.diversity for c in others]
    assert {(o.xp_clip, o.xp_limit) for o in options[::2]} == {(0.0, None)}
    assert len({(o.xp_clip, o.xp_limit, o.multiplier_step) for o in options[1::2]}) == 1
    assert all(c.xpm_sim.lambda_until == 1.0 for c in trained if c.method == "xpm_sim")  # pressure to the end


@pytest.mark.end_to_end
def test_self_sabotage_trains_what_is_named_under_both_rules(run: Run, trained: list[RunConfig]) -> None:
    methods = [word for name in ("lipo", "comedi", "xpm_sim") for word in ("--method", name)]
    code, out, err = run(
        *("experiment", "self-sabotage", "population.size=2", "--seeds", "1,2", "--episodes", "1", "--json"),
        *("--termination", "both", *methods),
    )
    assert code == 0, err
    assert len(trained) == 12 and {config.env.name for config in trained} == {"rendezvous/mppmr"}
    assert {(c.method, c.env.params["exit_penalty"], c.run.seed) for c in trained} == {
        (method, rule, seed)
        for method in ("lipo", "comedi", "xpm_sim")
        for rule in ("absorbing", "none")
        for seed in (1, 2)
    }
    assert {config.population.size for config in trained} == {2}
    assert len(json.loads(out)["rows"]) == 12 and len(json.loads(out)["means"]) == 6


def test_self_sabotage_refuses_in_one_line(run: Run, tmp_path: Path, random_population: Path) -> None:
    one, empty = population(tmp_path / "one"), population(tmp_path / "empty", members="")
    wide = population(tmp_path / "wide", bounds=2.0)
    twin = population(tmp_path / "twin")
    command = ("experiment", "self-sabotage", "--population", f"lipo={one}")
    refused(run(*command, "--population", f"comedi={wide}"), "bounds is 2.0", "has 1.5")
    refused(run(*command, "--population", f"comedi={one}"), "given twice")
    refused(run(*command, "--population", f"lipo={twin}"), "different names")
    refused(run(*command, "--population", f"comedi={empty}"), "no members yet")
    refused(run(*command, "--population", f"comedi={random_population}"), "no event by which a player leaves")
    refused(run(*command, "population.size=2"), "nothing is trained")
    refused(run(*command, "--population", "lipo"), "NAME=PATH")
    refused(run("experiment", "self-sabotage", "--method", "xpm_wm:ours"), "has no objective 'ours'")
    refused(run("experiment", "self-sabotage", "--method", "lipo:own"), "choose one of paper, ours")
    refused(run("experiment", "self-sabotage", "population.size=0"), "population.size")
    refused(run("experiment"), "WHICH")
    assert [source.label for source in open_sources([("a", one), ("b", twin)])] == ["a", "b"]


def test_the_pair_to_show_is_the_one_in_which_most_leave(tmp_path: Path) -> None:
    result = measure_sabotage(load_population(population(tmp_path / "p", members="iir")), 30, 0)
    assert sample_pair(result) in ((3, 1), (3, 2))
    still = measure_sabotage(load_population(population(tmp_path / "still", members="iii")), 1, 0)
    assert sample_pair(still) == (3, 2)
