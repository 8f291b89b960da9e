from __future__ import annotations

import json
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from popgen.cli import main
from popgen.envs.overcooked import OvercookedEnv
from popgen.envs.overcooked import kernels as k
from popgen.errors import UserError
from popgen.study import browser_check
from popgen.study.browser_check import check_transitions, draw_transitions, open_kitchens
from popgen.study.script_engine import ScriptEngine, find_engine, open_engine

needs_engine = pytest.mark.skipif(find_engine() is None, reason="needs Node or Chromium")


@pytest.fixture(scope="module")
def engine() -> Iterator[ScriptEngine]:
    with open_engine() as found:
        yield found


@needs_engine
@pytest.mark.parametrize("cooking", browser_check.MODES)
@pytest.mark.parametrize("layout", ["cramped_room", "counter_circuit_o_1order", "m_shaped_s"])
def test_rules_of_the_browser_are_the_simulators(engine: ScriptEngine, layout: str, cooking: str) -> None:
    env = OvercookedEnv(layout, 1, cooking=cooking)
    found = check_transitions(engine, env, draw_transitions(env, 600, np.random.default_rng(0)))
    assert (found.transitions, found.differing) == (600, 0)


@needs_engine
def test_a_wrong_rule_is_found(engine: ScriptEngine, monkeypatch: pytest.MonkeyPatch) -> None:
    env = OvercookedEnv("cramped_room", 1)
    told = browser_check.export_kitchen(env)
    told["table"][k.COOK * 256 + k.FIRST_SOUP + 5] += 1  # one soup cooks a step longer
    monkeypatch.setattr(browser_check, "export_kitchen", lambda _: told)
    found = check_transitions(engine, env, draw_transitions(env, 2000, np.random.default_rng(0)))
    assert 0 < found.differing < 2000


def test_random_transitions_meet_every_event() -> None:
    env = OvercookedEnv("cramped_room", 1)
    played = draw_transitions(env, 4000, np.random.default_rng(0))
    _, result = env.simulate(played.states, played.actions)
    assert result.events.any((0, 1)).all() and result.score.max() >= 1
    assert (played.states[:, 0] != played.states[:, 1]).all()


def test_layouts_come_in_the_modes_that_they_allow() -> None:
    found = {(env.layout.name, env.cooking) for env in open_kitchens()}
    assert {("cramped_room", "auto"), ("cramped_room", "interact")} <= found and len(found) > 40
    with pytest.raises(UserError, match="unknown layout"):
        next(open_kitchens(["no_such_layout"]))


@needs_engine
def test_the_command_counts(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["study", "check-browser", "--layout", "cramped_room", "--transitions", "100", "--no-people", "--json"]
    assert main(words) == 0
    told = SimpleNamespace(**json.loads(capsys.readouterr().out))
    assert (told.transitions, told.differing, len(told.kitchens)) == (100, 0, 2)


def test_an_engine_that_is_none_is_named() -> None:
    with open_engine("/bin/false") as broken, pytest.raises(UserError, match="false: gave no answer"):
        broken.run_task("transitions", {})
