"""Best responses: trained once, found by how the member acts and by how they were trained."""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from popgen.envs import make_env
from popgen.errors import UserError
from popgen.evaluation.holdout_lineages import NO_WEIGHTS
from popgen.evaluation.holdout_players import Group, Player, open_sides
from popgen.humans.clone_policy import ClonePolicy, CloneSettings
from popgen.pipelines import best_responses
from popgen.pipelines.best_responses import (
    FOLDER,
    ResponseTraining,
    count_others,
    find_responses,
    list_wanted,
    name_run,
    train_responses,
)
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.population import PopulationWriter, load_population
from popgen.population.manifest import EnvironmentInfo
from popgen.progress import NullReporter

pytestmark = pytest.mark.usefixtures("quick_pictures")

Run = Callable[..., tuple[int, str, str]]


def population(path: Path, method: str, seed: int, *members: int) -> Path:
    """Untrained members with these initial weights."""
    spec = make_env("overcooked/cramped_room", 1, horizon=20).spec
    writer = PopulationWriter(path, spec, method=method, config_digest="0" * 64, seed=seed)
    for number in members:
        view = spec.views["features"]
        writer.add_member(FeedForwardPolicy(view, spec.num_actions, units=8, seed=number), seed=number, steps={"SP": 1})
    return path


def open_partners(*paths: Path) -> tuple[Group, ...]:
    wanted = {"partner": [(path.name, str(path)) for path in paths]}
    return open_sides(wanted, str).sides["partner"]


def environment_of(path: Path) -> EnvironmentInfo:
    return load_population(path).env_info


SMALL = ResponseTraining("smoke", {"ego.steps": 400, "evaluation.episodes": 1})
WORDS = ("--response-set", "scale=smoke", "ego.steps=400", "evaluation.episodes=1")


def read_times(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.mark.end_to_end
def test_responses_are_trained_once_and_played(run: Run, tmp_path: Path) -> None:
    """Of three members two are one policy, which has one response."""
    ego, held = population(tmp_path / "ego", "xpm_wm", 1, 1), population(tmp_path / "a" / "held", "lipo", 2, 2, 3, 2)
    command = ("evaluate", f"ego={ego}", "--with", f"held={held}", "--episodes", "1", "--quiet")
    code, out, err = run(*command, "--best-responses", *WORDS, "--json")
    assert code == 0, err
    report, folder = json.loads(out), tmp_path / "a" / FOLDER
    told = [player["response"] for player in report["partners"][0]["players"]]
    assert told[0] == told[2] and [one["steps"] >= 400 and one["scale"] == "smoke" for one in told] == [True] * 3
    assert any(note.startswith("Best responses (2) were trained with scale=smoke, ego") for note in report["notes"])
    runs = sorted(folder.iterdir())
    assert len(runs) == 2 and runs[0].name.startswith("br-")
    before = read_times(folder)
    assert run(*command, "--best-responses", *WORDS)[0] == 0  # nothing is trained again
    assert before == read_times(folder)
    # Those of other settings are not taken, and that is told.
    code, out, err = run(*command[:-1], "--json")
    assert [player["response"] for player in json.loads(out)["partners"][0]["players"]] == [None] * 3
    assert "2 best responses lie there that were trained with other settings" in err
    diversity = (
        "diversity",
        str(population(tmp_path / "a" / "b" / "two", "lipo", 2, 2, 3)),
        "--episodes",
        "2",
        "--json",
    )
    diversity += ("--responses", str(folder))
    code, out, err = run(*diversity, *WORDS)
    found = json.loads(out)
    assert code == 0 and set(found["over"]) == {"members", "best responses"}, err
    assert found["training"] == {"scale": "smoke", "settings": {"ego.steps": 400, "evaluation.episodes": 1}}
    assert json.loads(run(*diversity)[1])["responses"] == 0
    check_what_is_refused(open_partners(held), environment_of(held), folder)


def check_what_is_refused(groups: tuple[Group, ...], info: EnvironmentInfo, folder: Path) -> None:
    """A response under the name of another member, or of other settings, is none of its."""
    first, second = (name_run(player, SMALL.digest(info)) for player in groups[0].players[:2])
    assert set(find_responses(groups, None, SMALL, info)) == {player.identity for player in groups[0].players}
    longer = ResponseTraining("smoke", {"ego.steps": 800})
    shutil.copytree(folder / first, folder / name_run(groups[0].players[0], longer.digest(info)))
    with pytest.raises(UserError, match="was trained with other settings than those it is named after"):
        find_responses(groups, None, longer, info)
    (folder / first / "config.json").write_text("{")
    with pytest.raises(UserError, match="the settings of a best response cannot be read"):
        find_responses(groups, None, SMALL, info)
    shutil.rmtree(folder / first)
    shutil.copytree(folder / second, folder / first)
    with pytest.raises(UserError, match="is no best response to the member it is named after"):
        find_responses(groups, None, SMALL, info)


def test_clones_of_one_network_have_responses_of_their_own(tmp_path: Path) -> None:
    """The settings of a clone are no part of its weights."""
    spec = make_env("overcooked/cramped_room", 1, horizon=20).spec
    writer = PopulationWriter(tmp_path / "clones", spec, method="human_clone", config_digest="0" * 64, seed=0)
    chosen = [CloneSettings(stay_bias=0.5, longest_stay=0), CloneSettings(stay_bias=0.0, longest_stay=4)]
    for settings in chosen:
        writer.add_member(ClonePolicy(spec, settings, seed=3), seed=0, steps={})
    groups = open_partners(tmp_path / "clones")
    one, other = groups[0].players
    assert one.digest == other.digest and one.identity != other.identity
    assert len(list_wanted(groups, None)) == 2 and name_run(one, "a" * 64) != name_run(other, "a" * 64)


def test_responses_are_told_apart_by_what_changes_them(tmp_path: Path) -> None:
    info = environment_of(population(tmp_path / "some", "lipo", 2, 2))
    base = ResponseTraining("smoke").digest(info)
    steps = recipe_steps = int(
        best_responses.make_ego_config("br", [], {"env.name": info.name}, scale="smoke").ego.steps
    )
    alike = [
        ResponseTraining("smoke", {"ego.steps": recipe_steps}),  # as the recipe has it
        ResponseTraining("smoke", {"evaluation.episodes": 3, "cluster.threads": 2, "tracking.enabled": False}),
    ]
    assert {one.digest(info) for one in alike} == {base}
    changed = [
        ResponseTraining("laptop"),
        ResponseTraining("smoke", {"ego.steps": steps + 1}),
        ResponseTraining("smoke", {"run.seed": 5}),
        ResponseTraining("smoke", {"ego.learning_rate": 0.01}),
    ]
    digests = {base, *(one.digest(info) for one in changed)}
    other = info.model_copy(update={"params": {**info.params, "horizon": 30}})
    assert len(digests | {ResponseTraining("smoke").digest(other)}) == 6
    for settings, told in (
        ({"run.id": "x"}, "run.id"),
        ({"ego.partners": ["x"]}, "leave it out"),
        ({"ego.x": 1}, "ego.x"),
    ):
        with pytest.raises(UserError, match=told):
            ResponseTraining("smoke", settings).digest(info)
    with pytest.raises(UserError, match="no recipe 'huge'"):
        ResponseTraining("huge").digest(info)


def test_each_policy_is_wanted_once_and_looked_for_wherever_it_is(tmp_path: Path) -> None:
    first = population(tmp_path / "a" / "first", "lipo", 2, 2, 3, 2)
    second = population(tmp_path / "b" / "second", "lipo", 5, 3)
    groups = open_partners(first, second)
    agent = Player("agent", "module:Agent", 1, None, lambda: None)  # type: ignore[arg-type, return-value]
    weightless = replace(agent, digest=NO_WEIGHTS, identity="random")
    wanted = list_wanted([*groups, Group("others", None, (agent, weightless))], None)
    assert [one.player.member for one in wanted] == [1, 2]
    places = [tmp_path / name / FOLDER for name in ("a", "b")]
    assert [one.folders for one in wanted] == [(places[0],), tuple(places)]
    assert {one.folders for one in list_wanted(groups, str(tmp_path))} == {(tmp_path,)}


def test_what_is_missing_is_planned_once_and_goes_on_as_it_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The training itself is left out: it leaves the configuration that a run begins with."""
    begun: list[dict[str, Any]] = []

    def begin(config: best_responses.BrRun, reporter: object) -> None:
        folder = Path(config.run.root) / str(config.run.id)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "config.json").write_text(json.dumps(config.as_dict()))
        begun.append(config.as_dict())

    monkeypatch.setattr(best_responses, "train_ego", begin)
    held = population(tmp_path / "held", "lipo", 2, 2, 3, 2)
    groups, info, folder = open_partners(held), environment_of(held), str(tmp_path / "all")
    assert train_responses(groups, folder, SMALL, info, NullReporter()) == 2
    names = [name_run(player, SMALL.digest(info)) for player in groups[0].players[:2]]
    assert [config["run"]["id"] for config in begun] == names
    assert [config["ego"]["partners"] for config in begun] == [[f"{held}:1"], [f"{held}:2"]]
    # Interrupted, and asked for again beside a copy elsewhere, evaluated otherwise: the run goes on as it began.
    copy = population(tmp_path / "copy", "lipo", 9, 2)
    again = ResponseTraining("smoke", {"ego.steps": 400, "evaluation.episodes": 2, "cluster.threads": 2})
    assert train_responses(open_partners(copy), folder, again, info, NullReporter()) == 1
    last = begun[-1]
    assert (last["ego"], last["evaluation"]) == (begun[0]["ego"], begun[0]["evaluation"])
    assert last["cluster"]["threads"] == 2 and last["run"] == begun[0]["run"]
    assert count_others(groups, folder, SMALL, info) == 0 and not find_responses(groups, folder, SMALL, info)
    other = {**begun[0], "method": "sp"}, {**begun[0], "ego": {**begun[0]["ego"], "steps": 9}}
    for config, told in zip(other, ("trains no best response", "was begun with other settings"), strict=True):
        (Path(folder) / names[0] / "config.json").write_text(json.dumps(config))
        with pytest.raises(UserError, match=told):
            train_responses(groups, folder, SMALL, info, NullReporter())


def test_one_population_counts_once_and_one_label_of_partners_has_one_side(run: Run, tmp_path: Path) -> None:
    ego, held = population(tmp_path / "ego", "mappo", 1, 1), population(tmp_path / "held", "lipo", 2, 2)
    other = population(tmp_path / "other", "lipo", 3, 3)
    for words, told in (
        ((str(ego), "--with", f"a={held}", f"b={tmp_path / 'ego' / '..' / 'held'}"), "is given twice"),
        ((str(ego), "--with", f"a={held}", "--human", f"b={held}"), "is given twice"),
        ((f"a={ego}", f"b={ego}", "--with", str(held)), "is given twice"),
        ((str(ego), "--with", f"same={held}", "--human", f"same={other}"), "same: is on two sides, partner and human"),
        ((str(ego), "--with", str(held), "--response-set", "scale=smoke"), "add --best-responses"),
    ):
        code, _, err = run("evaluate", *words, "--episodes", "1", "--out", str(tmp_path / "out"), "--quiet")
        assert code == 2 and told in err and len(err.splitlines()) == 1, err
    assert len(open_sides({"ego": [("a", str(ego))], "partner": [("a", str(held))]}, str).sides) == 2


def test_diversity_is_printed_and_refuses_in_one_line(run: Run, tmp_path: Path) -> None:
    held = population(tmp_path / "held", "lipo", 2, 2, 3)
    code, out, err = run("diversity", str(held), "--episodes", "2", "--choose", "1")
    assert (code, err) == (0, "") and "0 of 2 partners have a best response" in out and "most diverse 1" in out
    assert {path.name for path in Path("diversity").iterdir()} == {f"diversity.{s}" for s in ("json", "csv", "md")}
    told = json.loads(Path("diversity/diversity.json").read_text())["over"]["members"]
    head = Path("diversity/diversity.csv").read_text().splitlines()[0].split(",")
    assert head[4:] == [f"event:{name}" for name in told["count_names"]] and "event:delivery" in head
    assert len(told["kind_names"]) == len(told["kinds"][0]) == 28 and told["kind_names"][0].endswith("_seat_0")
    (word,) = told["hold_out"]
    assert word == f"LIPO={held}:{told['chosen'][0] + 1}"
    command = f"popgen evaluate EGO --with {shlex.quote(word)}"
    assert out.splitlines()[-1] == f"to hold these out: {command}"
    assert Path("diversity/diversity.md").read_text().endswith(f"\n\n    {command}\n")
    words = (str(population(tmp_path / "ego", "mappo", 1, 1)), "--with", *told["hold_out"], "--episodes", "1")
    code, out, err = run("evaluate", *words, "--out", "holdout", "--quiet")
    (partner,) = json.loads(Path("holdout/holdout.json").read_text())["partners"]
    assert code == 0 and [one["member"] for one in partner["players"]] == [told["chosen"][0] + 1]
    code, out, err = run("evaluate", words[0], "--with", f"{held}:3", "--quiet")
    assert code == 2 and err.splitlines() == [f"popgen: error: {held}:3: has no member 3; {held} has 2"]
    code, out, err = run("diversity", str(held), "--choose", "3")
    assert code == 2 and "--choose" in err and err.count("\n") == 1
    copies = population(tmp_path / "copies", "lipo", 2, 2, 2, 3)
    code, out, err = run("diversity", str(copies), "--episodes", "2")
    assert code == 0 and "over members only 2 of 3 partners are linearly independent" in out
    report = json.loads(Path("diversity/diversity.json").read_text())["over"]["members"]
    assert (report["rank"], report["determinant"], report["log_determinant"]) == (2, 0.0, None)
    code, out, err = run("diversity", str(copies), "--episodes", "2", "--choose", "3", "--quiet")
    assert code == 2 and "--choose: is 3, but by their own events only 2 of 3" in err and err.count("\n") == 1
