from __future__ import annotations

import sys
from collections.abc import Iterator
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
        ("their_agents:missing", "cannot be imported"),
        ("their_agents:broken", "cannot be made .RuntimeError: no model here"),
        ("their_agents:number", "neither a policy nor an agent"),
        ("their_agents:Odd", "wants the view 'nowhere'"),
    ],
)
def test_what_cannot_play_is_refused_in_one_line(name: str, told: str) -> None:
    with pytest.raises(UserError, match=told):
        open_user_agent(name, ENV)


@pytest.mark.usefixtures("module")
def test_agents_of_overcooked_ai_play_overcooked_alone() -> None:
    with pytest.raises(UserError, match="another game"):
        open_user_agent("their_agents:stay", make_env("rendezvous/mppmr", 1))
