"""Decisions of member 1's loop, without anything running."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from popgen.config.run_config import RunConfig
from popgen.methods.xpm_wm.config import Phase1Config
from popgen.pipelines.first_member import FirstMember


def member(**phase: Any) -> FirstMember:
    """Its window is 16 episodes; the driver has taken no step yet."""
    config = RunConfig(phase1=Phase1Config(envs=16, **phase))
    first = FirstMember(SimpleNamespace(config=config, steps=0), seed=0)  # type: ignore[arg-type]
    first.played, first.published = "played", "published"  # type: ignore[assignment]
    return first


def play(first: FirstMember, *scores: float) -> None:
    first.recent.extend(scores)
    first._keep_best()


def test_patience_begins_when_there_is_a_window_to_judge_by() -> None:
    first = member(patience=3, target_score=9.0)
    for _ in range(15):
        play(first, 1.0)
        assert not first._stop() and first.since_best == 0 and first.top is None
    for waited in range(3):
        play(first, 1.0)
        assert first.since_best == waited and not first._stop()
    play(first, 1.0)
    assert first.since_best == 3 and first._stop()
    play(first, *[2.0] * 16)
    assert first.since_best == 0 and not first._stop()


def test_the_target_needs_a_whole_window_and_the_budget_does_not() -> None:
    first = member(target_score=5.0, max_steps=100)
    first.recent.extend([8.0] * 15)
    assert not first._stop()
    first.recent.append(8.0)
    assert first._stop()
    first = member(max_steps=100)
    first.driver.steps = 100
    assert first._stop()


@pytest.mark.parametrize(("last", "wanted"), [(9.6, "published"), (9.4, "played")])
def test_the_last_weights_are_taken_unless_those_that_played_best_were_better(last: float, wanted: str) -> None:
    first = member()
    play(first, *[10.0] * 16)
    play(first, *[last] * 16)
    assert first._best().published == wanted


def test_without_a_whole_window_the_last_weights_are_all_there_is() -> None:
    first = member()
    assert first._best().published == "published" and first._best().sp == 0.0
    play(first, 4.0, 2.0)
    assert first._best().published == "published" and first._best().sp == 3.0


def test_self_play_has_started_once_a_whole_window_reached_its_share_of_the_target() -> None:
    first = member(target_score=10.0)
    play(first, *[5.0] * 15)
    assert not first.plays
    play(first, 4.0)
    assert not first.plays  # 4.94 of 5
    play(first, 6.0)
    assert first.plays
    play(first, *[0.0] * 16)
    assert first.plays  # for good


@pytest.mark.parametrize(
    ("event_starts", "plays", "chosen"), [("playing", False, False), ("playing", True, True), ("always", False, True)]
)
def test_imagination_starts_from_windows_of_an_event_once_self_play_has_started(
    event_starts: str, plays: bool, chosen: bool
) -> None:
    asked = []
    train = SimpleNamespace(options=lambda num_returns: SimpleNamespace(remote=lambda *given: asked.append(given)))
    first = member(event_starts=event_starts)
    first.driver.crew = SimpleNamespace(model=SimpleNamespace(train=train))  # type: ignore[misc]
    first.plays = plays
    first._learn_model(7)
    assert asked == [(7, first.config.agent.starts_sp, chosen)]


class Alone:
    """A driver whose players give these scores in one episode each, one list for each time they are asked."""

    def __init__(self, config: RunConfig, *scores: list[float], steps: int = 0) -> None:
        self.config, self.scores, self.steps = config, list(scores), steps
        self.spec = SimpleNamespace(horizon=10, score_name="dishes")
        self.reporter, self.seeds = SimpleNamespace(note=lambda text: None), []
        players = SimpleNamespace(open=lambda matches, parts, seed, stagger: self.seeds.append((seed, stagger)))
        self.crew = SimpleNamespace(players=players)

    def parts(self, acting: Any) -> Any:
        return acting

    def play(self, member: int, steps: int) -> list[Any]:
        assert (member, steps) == (1, 10)
        self.steps += steps * 16
        return [SimpleNamespace(score=score, shaped=0.0) for score in self.scores.pop(0)]


def test_the_last_policy_must_reach_the_target_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """9.69 of 10 is too little, 9.7 enough; every look has fresh episodes, and play between them too."""
    monkeypatch.setattr("popgen.pipelines.first_member.ray.get", lambda reference: reference)
    first = member(target_score=10.0, max_steps=10_000)
    first.published = SimpleNamespace(acting=None)  # type: ignore[assignment]
    first.driver = driver = Alone(first.config, [9.69] * 16, [9.7] * 16)  # type: ignore[assignment]
    play(first, *[10.1] * 16)
    assert first._reached() and not first._confirm() and not first._reached()
    first._sit_down()
    play(first, *[10.1] * 16)
    assert first._reached() and first._confirm()
    assert first._best().published is first.published and first._best().sp == pytest.approx(9.7)
    assert driver.steps == 320 and [stagger for _, stagger in driver.seeds] == [False, True, False]
    assert len({seed for seed, _ in driver.seeds}) == 3


def test_without_room_in_the_budget_the_window_must_do() -> None:
    first = member(target_score=10.0, max_steps=1000)
    first.driver = Alone(first.config, steps=841)  # type: ignore[assignment]
    play(first, *[10.1] * 16)
    assert first._confirm() and first.confirmations == 0
