"""`popgen reproduce`: pieces that stay, a kill after any of them, runs that are taken over; training takes no time."""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.finished import finished_run

import popgen.pipelines as pipelines
from popgen.cli import reproduce_command
from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.humans import proxies
from popgen.methods import registry
from popgen.methods.ego.config import EgoRun
from popgen.pipelines import reproduce, reproduction_pieces, run_measures
from popgen.pipelines.run_measures import (
    RunToMeasure,
    measure_conventions,
    measure_costs,
    measure_curves,
    measure_held,
    measure_scores,
)
from popgen.pipelines.simulated_study import StudyToSimulate
from popgen.reports.reproduction import measure_definitions
from popgen.reports.reproduction.target_records import StudyBudget

pytestmark = pytest.mark.usefixtures("quick_pictures")

Run = Callable[..., tuple[int, str, str]]
SMALL = ("population.size=2", "--budget", "smoke", "--out", "out", "--quiet")


class Training:
    """In place of `popgen.pipelines.population`: a finished run at once, or an end of the process.

    Attributes:
        calls: configurations in order.
        killed_at: the call that ends the process instead.
        refused: methods whose training fails.
    """

    def __init__(self) -> None:
        self.calls: list[RunConfig] = []
        self.killed_at = 0
        self.refused: set[str] = set()

    def train(self, config: RunConfig, *, reporter: Any) -> None:
        """`run_population`."""
        self.calls.append(config)
        if len(self.calls) == self.killed_at:
            raise KeyboardInterrupt
        if config.method in self.refused:
            raise UserError("training", "diverged", "lower the learning rates")
        steps = [{"SP": 100 * member, "XP": 10 * (member - 1)} for member in range(1, config.population.size + 1)]
        given = config.as_dict()
        settings = {name: given[name] for name in given if name not in ("method", "env", "population", "run")}
        finished_run(
            Path(config.run.root),
            str(config.run.id),
            steps,
            method=config.method,
            seed=config.run.seed,
            env=config.env.name,
            params=dict(config.env.params),
            settings=settings,
        )


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch) -> Training:
    stand_in = Training()
    module = type(sys)("popgen.pipelines.population")
    module.run_population = stand_in.train  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "popgen.pipelines.population", module)
    monkeypatch.setattr(pipelines, "population", module, raising=False)
    return stand_in


def test_a_target_from_runs_to_table(run: Run, training: Training, tmp_path: Path) -> None:
    code, out, err = run("reproduce", "wall-clock", *SMALL, "--json")
    assert code == 0, err
    told = json.loads(out)["targets"][0]
    assert (told["runs_done"], told["measures_done"], told["seconds_left"]) == (4, 4, 0)
    folder = tmp_path / "out" / "wall-clock"
    assert {path.name for path in folder.iterdir()} == {
        "record.json",
        "report.md",
        "rows.csv",
        "chart.png",
        "chart.svg",
    }
    record = json.loads((folder / "record.json").read_text())
    first = record["runs"][0]
    assert first["figures"]["costs"]["by_members"] == [100, 310] and first["figures"]["costs"]["minutes"] == 2.0
    assert first["command"].startswith(
        "popgen run method=xpm_wm env=overcooked/cramped_room scale=smoke population.size=2"
    )
    assert first["machine"] and not first["taken_over"] and record["missing"] == []
    assert "| XPM-WM " in (folder / "report.md").read_text()


def test_finished_pieces_stay_whatever_ended_the_command(run: Run, training: Training, tmp_path: Path) -> None:
    """Killed at the third of four runs; the same command makes the other two, and a third time nothing."""
    training.killed_at = 3
    assert run("reproduce", "wall-clock", *SMALL)[0] == 130
    assert run("reproduce", "wall-clock", *SMALL, "--dry-run")[0] == 0
    code, out, _ = run("reproduce", "wall-clock", *SMALL, "--dry-run", "--json")
    assert (
        code == 0 and json.loads(out)["targets"][0]["runs_done"] == 2 and json.loads(out)["targets"][0]["seconds_left"]
    )
    assert run("reproduce", "wall-clock", *SMALL, "--finished")[0] == 0 and len(training.calls) == 3
    assert len(json.loads((tmp_path / "out" / "wall-clock" / "record.json").read_text())["runs"]) == 2
    assert run("reproduce", "wall-clock", *SMALL)[0] == 0
    assert len(training.calls) == 5 and [c.method for c in training.calls[2:]] == ["lipo", "lipo", "comedi"]
    before = (tmp_path / "out" / "wall-clock" / "record.json").read_bytes()
    assert run("reproduce", "wall-clock", *SMALL)[0] == 0 and len(training.calls) == 5
    assert (tmp_path / "out" / "wall-clock" / "record.json").read_bytes() == before


def test_targets_share_their_runs(run: Run, training: Training) -> None:
    assert run("reproduce", "wall-clock", *SMALL)[0] == 0
    code, out, _ = run("reproduce", "sp-xp", *SMALL, "--json")
    assert code == 0 and len(training.calls) == 4 and json.loads(out)["targets"][0]["runs"] == 4


def test_other_layouts_than_the_budgets(run: Run, training: Training, tmp_path: Path) -> None:
    layouts = ("--layouts", "forced_coordination", "overcooked/coordination_ring")
    assert run("reproduce", "sp-xp", *SMALL, *layouts)[0] == 0
    wanted = ["overcooked/forced_coordination"] * 4 + ["overcooked/coordination_ring"] * 4
    assert [config.env.name for config in training.calls] == wanted
    assert json.loads((tmp_path / "out" / "sp-xp" / "record.json").read_text())["command"].endswith(" ".join(layouts))
    code, _, err = run("reproduce", "sp-xp", *SMALL, "--layouts", "kitchen")
    assert code == 2 and "--layouts" in err and "choose from cramped_room" in err and len(training.calls) == 8


def test_a_run_that_fails_holds_up_nothing_but_itself(run: Run, training: Training, tmp_path: Path) -> None:
    training.refused = {"lipo"}
    code, _, err = run("reproduce", "wall-clock", *SMALL)
    assert code == 2 and "1 pieces failed, LIPO, seed 1: training: diverged" in err and err.count("\n") == 1
    record = json.loads((tmp_path / "out" / "wall-clock" / "record.json").read_text())
    assert [one["row"] for one in record["runs"]] == ["XPM-WM", "XPM-Sim", "CoMeDi"]
    assert [(one["row"], one["seed"]) for one in record["missing"]] == [("LIPO", 1)]
    training.refused = set()
    assert run("reproduce", "wall-clock", *SMALL)[0] == 0 and len(training.calls) == 5


def test_finished_runs_of_elsewhere_are_taken_if_they_are_the_same(
    run: Run, training: Training, tmp_path: Path
) -> None:
    assert run("reproduce", "wall-clock", *SMALL)[0] == 0
    there = ("reproduce", "wall-clock", "population.size=2", "--budget", "smoke", "--out", "b", "--runs", "out/runs")
    assert run(*there, "--quiet", "--publish", "kept")[0] == 0 and len(training.calls) == 4
    kept = json.loads((tmp_path / "kept" / "wall-clock-smoke-population.size=2.json").read_text())
    assert all(one["taken_over"] for one in kept["runs"]) and len(kept["runs"]) == 4
    assert run(*there[:-4], "--out", "c", *there[-2:], "--quiet", "--seeds", "2")[0] == 0
    assert len(training.calls) == 8  # of another seed


def test_what_is_measured_of_the_first_member_alone_is_taken_from_larger_runs(run: Run, training: Training) -> None:
    words = ("method=xpm_wm", "scale=smoke", "env=overcooked/cramped_room", "population.size=3", "run.transport=inline")
    larger = compose([*words, "seed=1", "run.root=three", "run.id=larger", "tracking=off"])
    training.train(RunConfig.parse(larger), reporter=None)
    there = ("--budget", "smoke", "--out", "out", "--runs", "three", "--quiet")
    code, _, err = run("reproduce", "vector-reward", *there)
    assert code == 0, err
    assert [call.population.size for call in training.calls] == [3, 1], "the scalar head's run alone is missing"
    runs = json.loads(Path("out/vector-reward/record.json").read_text())["runs"]
    assert [(one["row"], one["taken_over"]) for one in runs] == [
        ("XPM-WM: event vector", True),
        ("XPM-WM: scalar reward", False),
    ]
    assert [one["figures"]["first"]["steps"] for one in runs] == [100, 100]


def plan_pieces(*words: str) -> reproduction_pieces.Pieces:
    """What the command would make; nothing is trained."""
    parser = argparse.ArgumentParser()
    reproduce_command.add(parser.add_subparsers())
    return reproduce_command._plan_pieces(parser.parse_args(["reproduce", *words, "--out", "b"]))


def test_an_ego_of_a_teacher_of_elsewhere_is_another_ego(run: Run, training: Training, tmp_path: Path) -> None:
    """Its run's partners lie elsewhere, though the teacher's folder may have the same name."""
    assert run("reproduce", "wall-clock", *SMALL)[0] == 0

    def list_egos(*words: str) -> set[str]:
        work = plan_pieces("ego", "population.size=2", "--budget", "smoke", *words)
        return {job.folder.name for job in work.jobs.values() if job.config is None}

    own, taken = list_egos(), list_egos("--runs", str(tmp_path / "out" / "runs"))
    assert own == list_egos() and len(own) == len(taken) and own.isdisjoint(taken)


def test_an_ego_of_two_targets_is_one_run_with_the_hold_outs_of_each() -> None:
    """The egos' table holds XPM-Sim's population out too, that of the generators does not."""
    work = plan_pieces("all", "--budget", "smoke")
    jobs = [
        work.find_job(one)
        for name, row in (("ego", "XPM-WM, one level"), ("generators", "XPM-WM"))
        for one in work.wanted[name]
        if one.teachers and one.row == row and one.method == "fcp"
    ]
    first, second = jobs[0], next(job for job in jobs[1:] if job.wanted.row == "XPM-WM")
    assert first.folder == second.folder
    titles = [{one.row for one in job.wanted.holdouts} for job in (first, second)]
    assert titles[0] - titles[1] == {"XPM-Sim"} and titles[1] < titles[0]
    assert work.find_measured(first, "holdout") != work.find_measured(second, "holdout")
    assert work.find_measured(first, "human") == work.find_measured(second, "human")


def test_settings_that_only_egos_have_are_of_the_egos(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    work = plan_pieces("ego", "ego.steps=500", "evaluation.episodes=3", "--budget", "smoke")
    (ego, *_) = (job for job in work.jobs.values() if job.config is None)
    teacher = next(job for job in work.jobs.values() if job.config is not None)
    given: dict[str, Any] = {}
    monkeypatch.setattr("popgen.pipelines.ego_training.make_ego_config", lambda *_, **__: given.update(_[2]))
    reproduce._configure_ego(work, ego)
    assert given["ego.steps"] == 500 and "evaluation.episodes" not in given and "ego.steps=500" in ego.words
    assert teacher.config is not None and teacher.config.evaluation.episodes == 3
    assert "ego.steps=500" in work.describe_command(ego) and "ego.steps=500" not in work.describe_command(teacher)
    work = plan_pieces("ego", "hipt.skills=3", "--budget", "smoke")
    words = {job.wanted.method: "hipt.skills=3" in job.words for job in work.jobs.values() if job.config is None}
    assert words == {"hipt": True, "fcp": False}  # one level has none
    code, _, err = run("reproduce", "ego", "ego.steps=many", "--budget", "smoke")
    assert code == 2 and "ego.steps" in err


@pytest.mark.parametrize("word", ["ego.steps=500", "world_model.kl_predecessors=0.5"])
def test_a_setting_that_no_run_has_is_refused(run: Run, word: str) -> None:
    code, _, err = run("reproduce", "table1", word, "--budget", "smoke", "--dry-run")
    assert code == 2 and f"{word.partition('=')[0]}: no run of table1 has it" in err


def test_every_command_that_a_record_tells_makes_its_run() -> None:
    """Settings that a method does not have are not in it."""
    work = plan_pieces("table1", "diversity.warmup=5", "--budget", "laptop", "--seeds", "1")
    jobs = [job for job in work.jobs.values() if job.config is not None]
    assert len(jobs) == 7
    for job in jobs:
        popgen, run, *given = work.describe_command(job).split()
        assert (popgen, run) == ("popgen", "run")
        config = RunConfig.parse(compose([*given, f"run.root={job.folder.parent}", f"run.id={job.folder.name}"]))
        assert config == job.config


def test_a_study_without_a_finished_game_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    size = StudyBudget(participants=1, pairs=1, tutorials=0, steps=20, random_keys=True)
    people = StudyToSimulate(tmp_path, "E-A", {}, tmp_path, size, 1)
    monkeypatch.setattr(run_measures, "play_study", lambda wanted: [])
    with pytest.raises(UserError, match="no game of it was finished"):
        measure_conventions(RunToMeasure(tmp_path, "E-A", 1, {}, people=people))


def test_what_an_earlier_record_tells_is_not_made_again(run: Run, training: Training, tmp_path: Path) -> None:
    """Three of four runs are in a record, and their folders are gone: the fourth is made, and the new record has all
    four, the three as they were."""
    training.refused = {"comedi"}
    assert run("reproduce", "wall-clock", *SMALL, "--publish", "kept")[0] == 2
    before = json.loads((tmp_path / "kept" / "wall-clock-smoke-population.size=2.json").read_text())
    assert [one["row"] for one in before["runs"]] == ["XPM-WM", "XPM-Sim", "LIPO"]
    shutil.rmtree(tmp_path / "out")
    training.refused = set()
    again = ("reproduce", "wall-clock", *SMALL, "--records", "kept")
    code, out, _ = run(*again, "--dry-run", "--json")
    told = json.loads(out)["targets"][0]
    assert code == 0 and (told["runs_done"], told["runs"], told["measures_done"], told["measures"]) == (3, 4, 3, 4)
    assert run(*again)[0] == 0 and [config.method for config in training.calls[4:]] == ["comedi"]
    after = json.loads((tmp_path / "out" / "wall-clock" / "record.json").read_text())
    assert after["runs"][:3] == before["runs"] and after["runs"][3]["row"] == "CoMeDi" and after["missing"] == []


@pytest.mark.parametrize("change", ["population.size=3", "world_model.kl_predecessors=0.5", "--seeds 2"])
def test_a_record_of_other_settings_tells_nothing(run: Run, training: Training, tmp_path: Path, change: str) -> None:
    assert run("reproduce", "wall-clock", *SMALL, "--publish", "kept")[0] == 0
    shutil.rmtree(tmp_path / "out")
    code, out, _ = run("reproduce", "wall-clock", *SMALL, *change.split(), "--records", "kept", "--dry-run", "--json")
    done = json.loads(out)["targets"][0]["runs_done"]
    assert code == 0 and done == (3 if "kl_predecessors" in change else 0), "only XPM-WM has that setting"


def test_an_egos_record_is_of_its_methods_recipe_and_its_teachers(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its digest changes with the recipe of its method, which its words do not hold, and with its partners."""

    def digest(*words: str) -> str:
        work = plan_pieces("ego", *words, "--budget", "smoke")
        return next(work.digest_settings(one) for one in work.wanted["ego"] if one.teachers)

    before = digest()
    assert before == digest() and before != digest("world_model.kl_predecessors=0.5", "population.size=3")
    assert len({before, digest("ego.steps=500"), digest("ego.steps=600")}) == 3
    known = registry.recipe

    def changed(method: str, *more: str) -> RunConfig:
        config = known(method, *more)
        assert isinstance(config, EgoRun)
        return config.model_copy(update={"ego": config.ego.model_copy(update={"units": 7})})

    monkeypatch.setattr(reproduction_pieces, "recipe", changed)
    assert digest() != before


def test_the_list_and_the_page(run: Run, training: Training, tmp_path: Path) -> None:
    code, out, _ = run("reproduce", "--list")
    assert (
        code == 0 and "table1" in out and 'table "Results of the MPPMR environment"' in out and "--budget paper" in out
    )
    assert run("reproduce", "wall-clock", *SMALL, "--publish", "results", "--results", "results.md")[0] == 0
    page = (tmp_path / "results.md").read_bytes()
    assert run("reproduce", "--results", "results.md")[0] == 0
    assert (tmp_path / "results.md").read_bytes() == page and b"## Training time" in page


def test_what_is_refused_in_one_line(run: Run, training: Training) -> None:
    for words, told in {
        ("reproduce",): "TARGET: is missing",
        ("reproduce", "table9"): "there is no target",
        ("reproduce", "table1", "--budget", "none"): "there is no budget",
        ("reproduce", "table1", "agent.lambda=1"): "agent.lambda",
        ("reproduce", "--results", "nothing.md"): "holds no records",
    }.items():
        code, out, err = run(*words, "--quiet")
        assert code == 2 and out == "" and told in err and err.count("\n") == 1, err
    assert training.calls == []


def test_measures_of_a_finished_run(tmp_path: Path) -> None:
    """Numbers by hand: steps 1000 then 50 each, half of the way up at half of the steps."""
    steps = [{"random": 600, "SP": 400}, {"SP": 30, "XP": 20}, {"SP": 30, "XP": 20}]
    curves = {member: [(0, 0.0, None), (50, 10.0, 1.0)] for member in (2, 3)}
    folder = finished_run(tmp_path, "one", steps, seconds=[120.0, 30.0, 90.0], curves=curves)
    job = RunToMeasure(folder, "XPM-WM", 2, {})
    costs = measure_costs(job)
    assert (costs["first"], costs["later"], costs["real"], costs["by_members"]) == (1000, 50, 1100, [1000, 1050, 1100])
    assert (costs["first_minutes"], costs["later_minutes"], costs["minutes"]) == (2.0, 1.0, 4.0)
    first = run_measures.measure_first(job)
    assert (first["steps"], first["minutes"], first["final"]) == (1000, 2.0, 0.0), "random players serve nothing"
    assert "curve" not in first
    found = measure_curves(job)
    assert found["later"][10] == [25.0, 5.0] and found["later"][-1] == [50.0, 10.0]
    scores = measure_scores(job)
    assert (scores["sp"], scores["xp"]) == (10.0, 0.5) and {"random", "idle"} <= set(scores)
    held = measure_held(job)
    assert held["passed"] == 0 and "steps" not in held  # random players serve nothing
    assert run_measures.measure_exits(job) == {}  # nobody can leave a kitchen
    assert run_measures.measure_diversity(job)["effective_rank"] >= 1.0
    assert run_measures.measure_acting(job) == {}  # random players tell no probabilities
    assert run_measures.round_figures({"a": [1.23456789, 2]}) == {"a": [1.23457, 2]}


PAIRS = [{"role": role, "pair": pair} for pair in (3, 12) for role in ("biased", "partner")]
DISHES = [[0, 9, 0, 0], [9, 0, 4.15, 0], [0, 3.85, 0, 11], [0, 0, 10.95, 0]]
"""Of members of these pairs, row: the one in seat 0."""


def test_of_a_finished_run_of_pairs_play_with_the_mate_is_measured(tmp_path: Path) -> None:
    """Its report is of a version that took the members of pairs for strangers."""
    folder = finished_run(tmp_path, "pairs", [{"SP": 10}] * 4, extras=PAIRS)
    file = folder / "report" / "crossplay.json"
    report = json.loads(file.read_text())
    del report["mates"]
    for pair in report["pairs"]:
        if pair["seat_0"].isdecimal() and pair["seat_1"].isdecimal():
            pair["score"] = {"mean": DISHES[int(pair["seat_0"]) - 1][int(pair["seat_1"]) - 1], "standard_error": 0.1}
    file.write_text(json.dumps(report | {"sp": {"mean": 0.0}, "xp": {"mean": 47.95 / 12}, "episodes": 20}))
    job = RunToMeasure(folder, "HSP", 2, {})
    scores = measure_scores(job)
    assert scores["sp"] == pytest.approx(39.95 / 4) and scores["xp"] == pytest.approx(1.0)
    assert "mixed" not in scores and scores["episodes"] == 20
    assert measure_curves(job)["final"] == pytest.approx((9 + 2 * 10.975) / 3)
    assert run_measures.measure_first(job)["final"] == 9.0


def test_br_div_is_of_as_many_members_as_the_smallest_population_has(tmp_path: Path) -> None:
    """Two that do the same and two others: of the four sets of three two hold both of the same."""
    counts = np.array([[9.0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9]])
    sets = run_measures.measure_subsets(counts, 3)
    same = math.exp(-(2 / 3) * math.log(2 / 3) - math.log(1 / 3) / 3)
    assert sorted(one.effective_rank for one in sets) == pytest.approx([same, same, 3, 3])
    assert [math.isinf(one.log_determinant) for one in sets].count(True) == 2
    assert len(run_measures.measure_subsets(np.eye(30), 15)) == run_measures.SUBSETS
    folder = finished_run(tmp_path, "four", [{"SP": 10}] * 4)
    whole, three = (run_measures.measure_diversity(RunToMeasure(folder, "MEP", 2, {}, common=n)) for n in (0, 3))
    assert (whole["members"], whole["of"], three["members"], three["of"]) == (4, 4, 4, 3)
    assert three["effective_rank"] == pytest.approx(1.0) == whole["effective_rank"], "four copies of a random player"


def test_members_that_were_trained_to_the_end_are_compared_where_there_are_enough(tmp_path: Path) -> None:
    skills = [{"skill": skill} for skill in ("initial", "half", "final")]
    folder = finished_run(tmp_path, "skills", [{"SP": 10}] * 3, extras=skills)
    assert run_measures.measure_acting(RunToMeasure(folder, "FCP", 2, {}, common=3)) == {"finals": 1, "needed": 3}
    assert run_measures.measure_acting(RunToMeasure(folder, "FCP", 2, {})) == {"finals": 1, "needed": 2}


def test_figures_of_another_meaning_are_measured_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A measure's file of an older version, or of a plan with another smallest population, is not read."""
    monkeypatch.chdir(tmp_path)
    work = plan_pieces("generators", "--budget", "smoke")
    jobs = {run.row: work.find_job(run) for run in work.wanted["generators"] if not run.teachers}
    hsp, mep = jobs["HSP"], jobs["MEP"]
    assert hsp.config is not None and hsp.config.population.size == 4
    assert work.find_common_size(hsp) == work.find_common_size(mep) == 3
    assert [work.define_measure(mep, name) for name in ("costs", "scores", "acting")] == ["1", "1", "2, of 3"]
    assert [work.define_measure(hsp, name) for name in ("costs", "scores", "acting")] == ["1", "2", "2, of 3"]
    Path("b/measured").mkdir(parents=True)
    for name, told, read in (("scores", {}, False), ("scores", {"definition": "2"}, True), ("costs", {}, True)):
        kept = {"run": str(hsp.folder), "episodes": 2, "figures": {"sp": 0.0}, **told}
        reproduction_pieces.write_json(work.find_measured(hsp, name), kept)
        assert work.is_measured(hsp, name) is read
    kept = {"run": str(mep.folder), "episodes": 2, "figures": {}, "definition": "2, of 4"}
    reproduction_pieces.write_json(work.find_measured(mep, "diversity"), kept)
    assert not work.is_measured(mep, "diversity")


def test_an_earlier_record_tells_only_figures_of_todays_meaning(
    run: Run, training: Training, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where nothing is trained the rest of a row stays; otherwise its run, which is gone, is made again."""
    assert run("reproduce", "sp-xp", *SMALL, "--publish", "kept")[0] == 0
    first = json.loads((tmp_path / "kept" / "sp-xp-smoke-population.size=2.json").read_text())["runs"][0]
    assert first["definitions"] == {"scores": "1", "costs": "1"} and set(first["figures"]) == {"scores", "costs"}
    shutil.rmtree(tmp_path / "out")
    monkeypatch.setitem(measure_definitions.DEFINITIONS, "costs", 2)
    again = ("reproduce", "sp-xp", *SMALL, "--records", "kept")
    assert run(*again, "--finished")[0] == 0 and len(training.calls) == 4
    told = json.loads((tmp_path / "out" / "sp-xp" / "record.json").read_text())["runs"]
    assert [one["figures"] for one in told] == [{"scores": one["figures"]["scores"]} for one in told] and len(told) == 4
    code, out, _ = run(*again, "--dry-run", "--json")
    assert code == 0 and json.loads(out)["targets"][0]["runs_done"] == 0
    assert run(*again)[0] == 0 and len(training.calls) == 8
    told = json.loads((tmp_path / "out" / "sp-xp" / "record.json").read_text())["runs"][0]
    assert told["definitions"] == {"scores": "1", "costs": "2"}


def test_an_ego_is_measured_beside_the_clone_of_people_that_is_fitted_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ego is a random player here, and so is the clone; one of the ego's own seed is no stranger."""
    folder, other = (finished_run(tmp_path, name, [{"SP": 10}], seed=seed) for seed, name in enumerate(("one", "two")))
    asked: list[tuple[str, str, int]] = []

    def fit(path: Path, layout: str, half: str, *, search: Any, **_: Any) -> None:
        asked.append((layout, half, search.drawn))
        shutil.copytree(other / "population", path)

    monkeypatch.setattr(proxies, "fit_population", fit)
    job = RunToMeasure(folder, "XPM-WM", 2, {}, humans=tmp_path / "humans", proxy={"drawn": 3})
    assert run_measures.measure_human(job)["score"] >= 0.0 and run_measures.measure_human(job)["score"] < 2.0
    assert asked == [("cramped_room", "B", 3)]
    (kept,) = (tmp_path / "humans").iterdir()
    assert kept.name.startswith("cramped_room_B-s0-")
    shutil.copytree(folder / "population", kept, dirs_exist_ok=True)
    with pytest.raises(UserError, match="has seed 0 of xpm_wm, which the ego ego is itself of"):
        run_measures.measure_human(job)
