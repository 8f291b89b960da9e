from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import invalidate_caches
from pathlib import Path

import numpy as np
import pytest

from popgen.envs import make_env
from popgen.errors import UserError
from popgen.evaluation.user_agents import is_agent_name, open_user_agent
from popgen.play.rollout import play
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy

MODULE = """
import numpy as np
from overcooked_ai_py.agents.agent import Agent, StayAgent
from overcooked_ai_py.mdp.actions import Action

class North:
    view = "features"
    def reset(self, batch, seed): self.seed = seed
    def act(self, obs, previous_actions, is_first): return np.zeros(obs.shape[:2], np.uint8)

class Sized(North):
    def __init__(self, spec): self.actions = spec.num_actions

class Walker(Agent):
    "Goes by the time of overcooked_ai's own state, and by its seat."
    def action(self, state):
        return Action.INDEX_TO_ACTION[(state.timestep + self.agent_index) % 4], {}

class Odd(North):
    view = "nowhere"

class Hidden(North):
    @property
    def view(self): raise LookupError("no view yet")

class Viewless(North):
    view = ["features"]

def leave(): raise SystemExit(3)
stay = StayAgent()
def broken(): raise RuntimeError("no model here")
number = 3
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (tmp_path / "their_agents.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    yield
    sys.path[:] = before
    sys.modules.pop("their_agents", None)


ENV = make_env("overcooked/cramped_room", 2, horizon=12)


def test_names_are_told_from_folders(tmp_path: Path) -> None:
    assert is_agent_name("a.b:C") and is_agent_name("a:b.c")
    assert not any(map(is_agent_name, ("runs/a", "a:b/c", "/a:b", "a", "C:\\runs")))


@pytest.mark.usefixtures("module")
def test_policies_are_made_from_classes_functions_and_objects() -> None:
    make = open_user_agent("their_agents:North", ENV)
    assert make() is not make()
    assert open_user_agent("their_agents:Sized", ENV)().actions == 6  # type: ignore[attr-defined]


@pytest.mark.usefixtures("module")
def test_an_agent_of_overcooked_ai_plays_like_the_policy_that_does_the_same() -> None:
    own = [RandomPolicy(6), IdlePolicy(ENV.spec.action_names)]
    theirs = [RandomPolicy(6), open_user_agent("their_agents:stay", ENV)()]
    seats = np.array([[0, 1], [1, 0]])
    first, second = (play(ENV, policies, seats, seed=3) for policies in (own, theirs))
    np.testing.assert_array_equal(first.events, second.events)


@pytest.mark.usefixtures("module")
def test_an_agent_of_overcooked_ai_sees_its_seat_and_the_time() -> None:
    walker = open_user_agent("their_agents:Walker", ENV)()
    taken = []
    play(ENV, [walker], np.zeros((2, 2), int), seed=0, record=lambda step: taken.append(step.actions.copy()))
    expected = [[[t % 4, (t + 1) % 4]] * 2 for t in range(12)]
    np.testing.assert_array_equal(np.stack(taken), expected)


@pytest.mark.usefixtures("module")
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("nowhere_at_all:A", "cannot be imported"),
        ("their_agents:missing", "missing cannot be found in the module their_agents .AttributeError: "),
        ("their_agents:North.view.deeper", "cannot be found in the module"),
        ("their_agents:broken", "cannot be made .RuntimeError: no model here"),
        ("their_agents:leave", "cannot be made .SystemExit: 3"),
        ("their_agents:Hidden", "cannot be made .LookupError: no view yet"),
        ("their_agents:Viewless", "wants the view .'features'."),
        ("their_agents:number", "neither a policy nor an agent"),
        ("their_agents:Odd", "wants the view 'nowhere'"),
    ],
)
def test_what_cannot_play_is_refused_in_one_line(name: str, told: str) -> None:
    with pytest.raises(UserError, match=told):
        open_user_agent(name, ENV)


@pytest.mark.usefixtures("module")
@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("class A:\n    def act(self: pass\n", "(SyntaxError: invalid syntax (faulty_agents.py, line 2))"),
        ("class A:\npass\n", "IndentationError: expected an indented block after class definition on line 1"),
        ("1 / 0\n", "ZeroDivisionError: division by zero"),
        ("raise ValueError('two\\nlines')\n", "ValueError: two lines"),
        ("import sys\nsys.exit('no licence')\n", "SystemExit: no licence"),
        ("raise KeyError\n", "KeyError"),
        ("x = '\x00'\n", "null bytes"),
    ],
)
def test_a_module_that_cannot_be_run_is_named_in_one_line(text: str, told: str) -> None:
    Path("faulty_agents.py").write_text(text)
    invalidate_caches()
    with pytest.raises(UserError) as caught:
        open_user_agent("faulty_agents:A", ENV)
    line = str(caught.value)
    assert line.startswith("faulty_agents:A: the module faulty_agents fails when it is imported") and told in line
    assert "python -c 'import faulty_agents'" in line and len(line.splitlines()) == 1
    assert "faulty_agents" not in sys.modules


@pytest.mark.usefixtures("module")
def test_a_dependency_that_is_missing_is_named() -> None:
    Path("needy_agents.py").write_text("import no_such_package\n")
    invalidate_caches()
    with pytest.raises(UserError, match="cannot be imported .No module named 'no_such_package'.; give module:Agent"):
        open_user_agent("needy_agents:A", ENV)


@pytest.mark.usefixtures("module")
def test_agents_of_overcooked_ai_play_overcooked_alone() -> None:
    with pytest.raises(UserError, match="another game"):
        open_user_agent("their_agents:stay", make_env("rendezvous/mppmr", 1))
