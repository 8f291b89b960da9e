"""Clones: what they see, how they act, that a seed decides everything, and what `humans fit` and `show` give."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from popgen.envs.overcooked import kernels as k
from popgen.errors import UserError
from popgen.humans.behaviour import MEASURES, Rates, compare_rates, measure_policies
from popgen.humans.clone_inputs import PER_TARGET, TARGETS, NearestTargets
from popgen.humans.clone_policy import ClonePolicy, CloneSettings
from popgen.humans.cloning import CloneTraining, change_settings, fit_clone, negative_log_likelihood
from popgen.humans.proxies import ProxySearch, fit_missing_population, fit_population
from popgen.humans.recordings import HumanGame, load_games, make_human_env
from popgen.play.policy import Policy, Remembering
from popgen.population import load_population

QUICK = CloneTraining(epochs=2)
SHORT = ProxySearch(drawn=2, rounds=1, episodes=2, final_episodes=2)


@pytest.fixture(scope="module")
def games() -> list[HumanGame]:
    return load_games(["train"], ["cramped_room"])[:3]


def test_nearest_targets_by_hand() -> None:
    """cramped_room: O at (0, 1) and (4, 1), P (2, 0), D (1, 3), S (3, 3); player 1 at (1, 2), facing north."""
    env = make_human_env("cramped_room")
    targets = NearestTargets(env.spec)
    obs = env.observe()[0]
    seen = targets.look(obs).reshape(2, len(TARGETS), PER_TARGET)
    onions, dishes, pot = (seen[0, TARGETS.index(name)] for name in ("onion dispenser", "dish dispenser", "empty pot"))
    assert onions.tolist() == [1, 0.5, 1, 0, 0, 0, 0]  # one step north to the cell beside it
    assert dishes.tolist() == [1, 1, 0, 1, 0, 0, 0]  # beside it: turn south
    assert pot[0] == 1 and pot[1] == pytest.approx(1 / 3)
    assert not seen[0, TARGETS.index("ready pot")].any()
    state = env.get_state()
    state[0, k.ORIENT] = 1
    assert targets.look(env.encode(state)[0]).reshape(2, len(TARGETS), PER_TARGET)[0, 1, 6] == 1


def test_acting_follows_the_settings() -> None:
    spec = make_human_env("cramped_room").spec
    policy = ClonePolicy(spec, CloneSettings(stay_bias=1.0, temperature=0.5))
    logits = np.array([0.0, 1.0, 0.0, 0.0, 2.0, 0.0])
    plain = np.exp(logits - [0, 0, 0, 0, 1, 0])
    got = policy.probabilities(logits)
    assert got.sum() == pytest.approx(1.0)
    assert got[4] == pytest.approx(plain[4] / plain.sum())
    assert got[1] / got[0] == pytest.approx(np.exp(1.0 / 0.5))
    left_out = np.zeros(6, bool)
    left_out[[1, 4]] = True
    assert policy.probabilities(logits, left_out).tolist() == pytest.approx([0.25, 0, 0.25, 0.25, 0, 0.25])
    assert policy.probabilities(logits, np.ones(6, bool))[4] == 1.0


def test_what_is_tried_in_vain_is_left_out() -> None:
    env = make_human_env("cramped_room")
    policy = ClonePolicy(env.spec, CloneSettings(patience=1, longest_stay=2))
    policy.reset(1, 0)
    obs, first = env.observe(), np.array([True])
    actions = [policy.act(obs, np.zeros((1, 2), np.uint8), first)]
    for _ in range(40):  # nothing ever changes: every action but `stay` is tried once, then only `stay` is left
        actions.append(policy.act(obs, actions[-1], np.array([False])))
    moves = np.array(actions)[:, 0, 0]
    counts = np.bincount(moves, minlength=6)
    assert all(counts[action] == 1 for action in (0, 1, 2, 3, 5))


def test_a_clone_is_a_policy_with_memory() -> None:
    env = make_human_env("cramped_room", 3)
    policy = ClonePolicy(env.spec, CloneSettings(patience=1, longest_stay=4), seed=3)
    assert isinstance(policy, Policy) and isinstance(policy, Remembering)
    policy.reset(3, 5)
    actions, first = np.zeros((3, 2), np.uint8), np.ones(3, bool)
    for _ in range(20):
        actions = policy.act(env.observe(), actions, first)
        env.step(actions)
        first = np.zeros(3, bool)
    other = ClonePolicy.from_parts(policy.config(), policy.weights(), env.spec)
    other.reset(3, 99)
    other.load_memory(policy.memory())
    for _ in range(20):
        mine, theirs = (one.act(env.observe(), actions, first) for one in (policy, other))
        assert np.array_equal(mine, theirs)
        actions = mine
        env.step(actions)
    with pytest.raises(ValueError):
        ClonePolicy(env.spec, CloneSettings(temperature=0.0))


def test_the_fit_learns_and_is_decided_by_its_seed(games: list[HumanGame]) -> None:
    one, two = (fit_clone(games[:2], CloneSettings(), QUICK, seed=1) for _ in range(2))
    assert all(np.array_equal(value, two.weights()[name]) for name, value in one.weights().items())
    untrained = ClonePolicy(make_human_env("cramped_room").spec, CloneSettings(), seed=1)
    frequencies = np.bincount(games[2].actions.reshape(-1), minlength=6) / games[2].actions.size
    constant = float(-(frequencies * np.log(frequencies)).sum())
    fitted = negative_log_likelihood(one, games[2:])
    assert fitted < constant < negative_log_likelihood(untrained, games[2:])
    changed = change_settings(one, make_human_env("cramped_room").spec, CloneSettings(stay_bias=3.0))
    rates, more = (measure_policies([policy], "cramped_room", 2, 0).mean for policy in (one, changed))
    assert more[list(MEASURES).index("actions but stay")] > rates[list(MEASURES).index("actions but stay")]


def test_agreement_by_hand() -> None:
    people = Rates(np.array([4.0, 2.0, 1.0]), np.array([1.0, 0.5, 0.0]), 3)
    agreement = compare_rates(people, Rates(np.array([5.0, 3.0, 1.0]), np.zeros(3), 3))
    assert agreement.distances.tolist() == [1.0, 2.0, 0.0]
    assert agreement.within == 2 and agreement.share == pytest.approx(2 / 3)


@pytest.mark.end_to_end
def test_a_population_of_proxies_plays_and_tells_its_source(games: list[HumanGame], tmp_path: Path) -> None:
    fit_population(tmp_path / "p", "cramped_room", "A", seed=4, members=2, training=QUICK, search=SHORT, games=games)
    population = load_population(tmp_path / "p")
    assert [info.kind for info in population.members] == ["human_clone"] * 2
    extra = population.info(1).extra
    assert extra["recordings"]["sha256"].startswith("28659cfd") and extra["half"] == "A"
    assert extra["games"] == [game.pair for game in games] and extra["validation_game"] == games[-1].pair
    assert not [path for path in (tmp_path / "p").rglob("*") if path.suffix not in ("", ".json", ".safetensors")]
    from popgen.evaluation.crossplay import evaluate_population

    assert evaluate_population(population, episodes=1, seed=0).steps > 0
    fit_population(tmp_path / "q", "cramped_room", "A", seed=4, members=2, training=QUICK, search=SHORT, games=games)
    for name in ("manifest.json", "member_001/policy.safetensors", "member_002/member.json"):
        assert (tmp_path / "p" / name).read_bytes() == (tmp_path / "q" / name).read_bytes()


def test_unknown_layouts_and_halves(tmp_path: Path) -> None:
    for layout, half in (("bottleneck", "A"), ("cramped_room", "C")):
        with pytest.raises(UserError):
            fit_population(tmp_path / "p", layout, half)


@pytest.mark.end_to_end
def test_fit_and_show(
    run: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch, games: list[HumanGame]
) -> None:
    import popgen.humans.proxies as proxies

    monkeypatch.setattr(proxies, "CloneTraining", lambda: QUICK)
    monkeypatch.setattr(proxies, "ProxySearch", lambda: SHORT)
    code, out, err = run("humans", "fit", "--layout", "cramped_room", "--half", "A", "--json", "--quiet")
    assert code == 0, err
    (made,) = json.loads(out)["populations"]
    assert made["path"] == "humans/cramped_room_A" and made["cells"] == len(MEASURES)
    code, out, err = run("humans", "show", "--layout", "cramped_room")
    assert code == 0, err
    assert max(len(line) for line in out.splitlines()) <= 80
    assert "A 8 games 9,564 steps" in out and "clone A" in out and "dishes (team)" in out
    code, out, _ = run("humans", "show", "--json")
    assert len(json.loads(out)["layouts"]) == 5
    code, _, err = run("humans", "fit", "--layout", "cramped_room", "--half", "A", "--quiet")
    assert code == 2 and "exists already" in err
    assert run("humans", "fit", "--layout", "nowhere")[0] == 2


def test_a_fit_that_was_broken_off_leaves_nothing_to_trip_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, games: list[HumanGame]
) -> None:
    def break_off(*given: object) -> NoReturn:
        raise KeyboardInterrupt

    wanted: dict[str, Any] = {"training": QUICK, "search": SHORT, "games": games}
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr("popgen.humans.proxies.fit_proxy", break_off)
        fit_population(tmp_path / "people", games[0].layout, "A", **wanted)
    assert not (tmp_path / "people").exists()
    fit_population(tmp_path / "people", games[0].layout, "A", **wanted)
    assert [path.name for path in tmp_path.iterdir()] == ["people"] and len(load_population(tmp_path / "people")) == 1


def test_a_proxy_of_another_search_is_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("popgen.humans.proxies.CloneTraining", lambda: QUICK)
    first = fit_missing_population(tmp_path, "cramped_room", "B", search=SHORT)
    written = (first / "manifest.json").stat().st_mtime_ns
    other = fit_missing_population(tmp_path, "cramped_room", "B", search=replace(SHORT, episodes=SHORT.episodes + 1))
    assert fit_missing_population(tmp_path, "cramped_room", "B", search=SHORT) == first != other
    assert (first / "manifest.json").stat().st_mtime_ns == written
    assert fit_missing_population(tmp_path, "cramped_room", "B", seed=1, search=SHORT) not in (first, other)
