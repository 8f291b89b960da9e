"""Best responses: trained once, found by the digest of the member's weights."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from popgen.envs import make_env
from popgen.errors import UserError
from popgen.evaluation.holdout_players import open_sides
from popgen.pipelines.best_responses import FOLDER, find_response, find_responses, name_run
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.population import PopulationWriter

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


@pytest.mark.end_to_end
def test_responses_are_trained_once_and_played(run: Run, tmp_path: Path) -> None:
    ego, held = population(tmp_path / "ego", "mappo", 1, 1), population(tmp_path / "a" / "held", "lipo", 2, 2, 3)
    small = ("--response-set", "scale=smoke", "ego.steps=400", "evaluation.episodes=1", "--episodes", "1", "--quiet")
    command = ("evaluate", f"ego={ego}", "--with", f"held={held}", "--best-responses", *small)
    code, out, err = run(*command, "--json")
    assert code == 0, err
    report = json.loads(out)
    assert [player["response"] for player in report["partners"][0]["players"]] == [True, True]
    runs = sorted((tmp_path / "a" / FOLDER).iterdir())
    assert len(runs) == 2 and runs[0].name.startswith("br-")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "a" / FOLDER).rglob("*") if path.is_file()}
    assert run(*command)[0] == 0  # nothing is trained again
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "a" / FOLDER).rglob("*") if path.is_file()}
    code, out, err = run("diversity", str(held), "--episodes", "2", "--choose", "1", "--json")
    assert code == 0 and set(json.loads(out)["over"]) == {"members", "best responses"}, err
    (groups,) = (open_sides({"partner": [("held", str(held))]}, str).sides["partner"],)
    assert set(find_responses(groups, None)) == {player.digest for player in groups[0].players}
    # A response under the name of another member is none of its.
    digest = groups[0].players[0].digest or ""
    shutil.rmtree(runs[0].parent / name_run(digest))
    shutil.copytree(next(path for path in runs if path.exists()), runs[0].parent / name_run(digest))
    with pytest.raises(UserError, match="no best response to the member"):
        find_response(runs[0].parent, digest)


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
    code, out, err = run("diversity", str(held), "--choose", "3")
    assert code == 2 and "--choose" in err and err.count("\n") == 1
