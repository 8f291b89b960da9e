"""What `popgen sweep` plans, and `popgen run --from`: nothing here starts a run."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from popgen.cli.compose import SweepAxis, compose, compose_record, parse_axis
from popgen.cli.sweep_command import draw_points, list_runs
from popgen.cli.training import leave_out_foreign
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.population.manifest import EnvironmentInfo

Run = Callable[..., tuple[int, str, str]]

AXES = [
    ("seed=1,2,3", SweepAxis("run.seed", ("1", "2", "3"))),
    ("seed=range(1,4)", SweepAxis("run.seed", ("1", "2", "3"))),
    ("env=overcooked/a,overcooked/b", SweepAxis("env", ("overcooked/a", "overcooked/b"))),
    ("agent.lambda_xp=interval(0.1,0.5)", SweepAxis("agent.lambda_xp", low=0.1, high=0.5)),
    ("a.b=tag(log,interval(1e-4,1e-2))", SweepAxis("a.b", low=1e-4, high=1e-2, is_log=True)),
    ("a.b=int(interval(1,9))", SweepAxis("a.b", low=1, high=9, is_integer=True)),
    ("agent.return_percentiles=[5,95]", None),
    ("env.params.grid='XX,XX'", None),
    ("seed=1", None),
]


@pytest.mark.parametrize(("word", "axis"), AXES, ids=[word for word, _ in AXES])
def test_several_values_make_an_axis_and_a_list_is_one_value(word: str, axis: SweepAxis | None) -> None:
    assert parse_axis(word) == axis


@pytest.mark.parametrize("word", ["a=interval(2,1)", "a=tag(log,interval(0,1))", "a=interval(1", "a"])
def test_what_is_no_range_is_refused(word: str) -> None:
    with pytest.raises(UserError):
        parse_axis(word)


def test_a_grid_is_every_pair_and_draws_are_the_same_for_the_same_seed() -> None:
    listed = [SweepAxis("method", ("x", "y")), SweepAxis("run.seed", ("1", "2"))]
    assert list_runs(["scale=smoke"], listed, 8, 0) == [
        ["scale=smoke", "method=x", "run.seed=1"],
        ["scale=smoke", "method=x", "run.seed=2"],
        ["scale=smoke", "method=y", "run.seed=1"],
        ["scale=smoke", "method=y", "run.seed=2"],
    ]
    ranges = [SweepAxis("a", low=1e-4, high=1e-2, is_log=True), SweepAxis("n", low=2, high=4, is_integer=True)]
    points = draw_points(ranges, 200, 1)
    assert points == draw_points(ranges, 200, 1) != draw_points(ranges, 200, 2)
    values = [float(point[0].partition("=")[2]) for point in points]
    assert all(1e-4 <= value <= 1e-2 for value in values)
    assert 0.4 < sum(value < 1e-3 for value in values) / len(values) < 0.6  # even by the logarithm
    assert {point[1] for point in points} == {"n=2", "n=3", "n=4"}
    assert len(list_runs([], [*listed, *ranges], 5, 0)) == 4 * 5


def test_a_setting_that_a_method_lacks_is_left_out_for_it_with_a_note() -> None:
    notes: dict[str, None] = {}
    words = [["method=xpm_sim", "xpm_sim.lambda_xp=0.1"], ["method=mappo", "xpm_sim.lambda_xp=0.1"]]
    assert leave_out_foreign(words, ["xpm_sim.lambda_xp=0.1"], None, notes) == [words[0], ["method=mappo"]]
    assert list(notes) == ["xpm_sim.lambda_xp=0.1 is left out for mappo, which has no such setting"]
    alone = [["method=mappo", "xpm_sim.lambda_xp=0.1"]]
    assert leave_out_foreign(alone, ["xpm_sim.lambda_xp=0.1"], None, {}) == alone  # for its run to be refused by
    assert leave_out_foreign(words, [], None, {}) == words


def test_a_sweep_is_refused_before_anything_starts(run: Run) -> None:
    for words, told in (
        (["agent.lambda_xp=0.1,-1"], "agent.lambda_xp"),
        (["method=xpm_wm,lipoo"], "did you mean method=lipo"),
        (["seed=range(0,100000)"], "keep them to 10,000"),
        (["agent.horizon=interval(3,1)"], "no range"),
    ):
        code, out, err = run("sweep", *words, "scale=smoke", "tracking=off")
        assert code == 2 and out == "" and told in err and err.count("\n") == 1, err


def test_a_run_is_repeated_from_its_record(run: Run, tmp_path: Path) -> None:
    first = RunConfig.parse(compose(["method=lipo", "env=rendezvous/mppmr", "scale=demo", "seed=3", "run.id=a"]))
    (tmp_path / "config.json").write_text(json.dumps(first.as_dict()))
    code, out, err = run("run", "--from", str(tmp_path), "--dry-run", "--json")
    again = RunConfig.parse(json.loads(out))
    assert code == 0 and again.digest() == first.digest() and again.run.id is None, err
    values = compose_record(first.as_dict(), ["seed=4", "ppo.units=64", "env.params.horizon=20", "tracking=off"])
    changed = RunConfig.parse(values)
    assert (changed.run.seed, changed.ppo.units, changed.tracking.enabled) == (4, 64, False)
    assert changed.env.params == {**first.env.params, "horizon": 20}
    assert changed.diversity == first.diversity


def test_a_run_in_a_layout_file_is_repeated_in_its_own_kitchen(run: Run, tmp_path: Path) -> None:
    file, folder = tmp_path / "mine.layout", tmp_path / "first"
    file.write_text('{"grid": "XXPXX/O1 2O/X   X/XDXSX", "cook_time": 7}'.replace("/", "\\n"))
    settings = ["method=lipo", f"env.name=overcooked/{file}", "env.params.events=raw"]
    config = RunConfig.parse(compose(settings))
    trained = EnvironmentInfo.of(make_env(config.env.name, 1, seed=0, **config.env.params).spec)
    (folder / "population").mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(config.as_dict()))
    (folder / "population" / "manifest.json").write_text(json.dumps({"environment": trained.model_dump()}))
    file.unlink()
    code, out, err = run("run", "--from", str(folder), "--dry-run", "--json", "env.params.horizon=50")
    assert code == 0, err
    env = json.loads(out)["env"]
    again = make_env(env["name"], 1, seed=0, **{**env["params"], "horizon": trained.horizon}).spec
    assert again.fingerprint == trained.fingerprint and env["params"]["horizon"] == 50
    (folder / "population" / "manifest.json").unlink()
    code, _, err = run("run", "--from", str(folder), "--dry-run")
    assert code == 2 and "there is no file" in err and str(file) in err


@pytest.mark.parametrize("word", ["scale=paper", "method=mappo", "env=overcooked/cramped_room", "agent.units=3", "x"])
def test_a_record_takes_no_other_recipe_and_no_foreign_field(run: Run, tmp_path: Path, word: str) -> None:
    (tmp_path / "config.json").write_text(json.dumps(RunConfig.parse(compose(["method=lipo"])).as_dict()))
    code, out, err = run("run", "--from", str(tmp_path), "--dry-run", word)
    assert code == 2 and out == "" and err.count("\n") == 1
    for text in ("{", "[]"):
        (tmp_path / "config.json").write_text(text)
        code, _, err = run("run", "--from", str(tmp_path), "--dry-run")
        assert code == 2 and "--from" in err
