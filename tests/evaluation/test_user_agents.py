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
from popgen.play.policy import Policy
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

class Answers(North):
    "Gives one answer for each row and seat."
    answer = np.int64(0)
    def act(self, obs, previous_actions, is_first): return np.full(obs.shape[:2], self.answer)

class Wraps(Answers): answer = np.int64(260)
class Cut(Answers): answer = 1.7
class Whole(Answers): answer = 1.0
class Above(Answers): answer = np.uint8(9)
class Below(Answers): answer = np.int8(-1)
class Yes(Answers): answer = True

class Flat(North):
    def act(self, obs, previous_actions, is_first): return np.zeros(len(obs), np.int64)

class Ragged(North):
    def act(self, obs, previous_actions, is_first): return [[0, 1], [2]]

class Silent(North):
    def act(self, obs, previous_actions, is_first): pass

class Lists(North):
    def act(self, obs, previous_actions, is_first): return [[5, 4]] * len(obs)

class Crashes(North):
    def act(self, obs, previous_actions, is_first):
        return self.table[0]

class Unready(North):
    def reset(self, batch, seed): raise OSError("no weights")

class Leaves(North):
    def reset(self, batch, seed): raise SystemExit(3)

class Seedless(North):
    def reset(self, batch): pass

class Blind(North):
    def act(self, obs): pass

class Tires(North):
    "Its fourth action is one that there is not."
    def reset(self, batch, seed): self.step = 0
    def act(self, obs, previous_actions, is_first):
        self.step += 1
        return np.full(obs.shape[:2], 6 if self.step == 4 else 0)

class Counts(North):
    "Its action is the number of the step, modulo four; made once for all."
    def reset(self, batch, seed): self.step = 0
    def act(self, obs, previous_actions, is_first):
        self.step += 1
        return np.full(obs.shape[:2], (self.step - 1) % 4)

one_for_all = Counts()
def share(): return one_for_all

class Locked(Counts):
    def __init__(self):
        from threading import Lock
        self.lock = Lock()

locked = Locked()
def share_locked(): return locked

class Network(Counts):
    "Called like a network, which must not make it."
    def __call__(self, x): raise RuntimeError("no x")
network = Network()

class Seven(Agent):
    def action(self, state): return 7
class Bare(Agent):
    def action(self, state): return Action.STAY
class Number(Agent):
    def action(self, state): return 4, {}
class Stateless(Agent):
    def action(self): return Action.STAY, {}
class Fails(Agent):
    def action(self, state): return {}["key"]

class Remembers(Agent):
    "Its first action is its seat's, and the one after that its own last."
    def reset(self): self.last = None
    def action(self, state):
        self.last = self.agent_index if self.last is None else self.last
        return Action.INDEX_TO_ACTION[self.last], {}
remembers = Remembers()
def share_agent(): return remembers

def load_own():
    from popgen.policies.simple_policies import RandomPolicy
    return RandomPolicy(6)

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
    sized = open_user_agent("their_agents:Sized", ENV)()
    assert sized.view == "features" and sized.kind == "user_agent"
    assert isinstance(open_user_agent("their_agents:load_own", ENV)(), RandomPolicy)  # which is popgen's own


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


# ---- what they answer ------------------------------------------------------------------------------------------------

RANGE = "; give a whole number from 0 to 5 for each row and seat"


@pytest.mark.usefixtures("module")
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("Wraps", f"act gives the action 260{RANGE}"),
        ("Above", f"act gives the action 9{RANGE}"),
        ("Below", f"act gives the action -1{RANGE}"),
        ("Cut", f"act gives actions of dtype float64{RANGE}"),
        ("Whole", f"act gives actions of dtype float64{RANGE}"),
        ("Yes", f"act gives actions of dtype bool{RANGE}"),
        ("Silent", f"act gives actions of dtype object{RANGE}"),
        ("Flat", f"act gives an array of shape (2,), not (2, 2){RANGE}"),
        ("Ragged", "act gives no array (ValueError: setting an array element"),
        (
            "Crashes",
            "fails in act (AttributeError: 'Crashes' object has no attribute 'table'); correct their_agents.py",
        ),
        ("Unready", "fails in reset (OSError: no weights); correct their_agents.py, line "),
        ("Leaves", "fails in reset (SystemExit: 3); correct their_agents.py, line "),
        ("Seedless", "positional arguments but 3 were given); define it as reset(self, batch, seed)"),
        ("Blind", "were given); define it as act(self, obs, previous_actions, is_first)"),
        ("Seven", "action gives 7; give (action, info), the action one of overcooked_ai's Action.ALL_ACTIONS"),
        ("Bare", "action gives (0, 0); give (action, info)"),
        ("Number", "action gives (4, {}); give (action, info)"),
        ("Stateless", "were given); define it as overcooked_ai's Agent has it"),
        ("Fails", "fails in act (KeyError: 'key'); correct their_agents.py, line "),
        (
            "share_locked",
            "cannot be made anew (TypeError: cannot pickle '_thread.lock' object); give a class, or a fun",
        ),
    ],
)
def test_answers_that_are_no_actions_are_refused_before_anything_is_played(name: str, told: str) -> None:
    with pytest.raises(UserError) as caught:
        open_user_agent(f"their_agents:{name}", ENV)
    line = str(caught.value)
    assert line.startswith(f"their_agents:{name}: ") and told in line and len(line.splitlines()) == 1


@pytest.mark.usefixtures("module")
def test_the_line_of_a_fault_is_the_agents_own() -> None:
    with pytest.raises(UserError) as caught:
        open_user_agent("their_agents:Crashes", ENV)
    line = MODULE.splitlines().index("        return self.table[0]") + 1
    assert caught.value.fix == f"correct their_agents.py, line {line}"


@pytest.mark.usefixtures("module")
def test_an_action_that_there_is_not_ends_a_game_that_began_well() -> None:
    tires = open_user_agent("their_agents:Tires", ENV)()
    taken = list[np.ndarray]()
    with pytest.raises(UserError, match=r"their_agents:Tires: act gives the action 6; give a whole number from 0 to 5"):
        play(ENV, [tires], np.zeros((2, 2), int), seed=0, record=lambda step: taken.append(step.actions.copy()))
    assert len(taken) == 3


def list_actions(policies: list[Policy], seats: list[list[int]]) -> np.ndarray:
    """(T, B, P) what is played."""
    taken = list[np.ndarray]()
    play(ENV, policies, np.array(seats), seed=0, record=lambda step: taken.append(step.actions.copy()))
    return np.stack(taken)


@pytest.mark.usefixtures("module")
def test_lists_of_whole_numbers_are_actions() -> None:
    assert (list_actions([open_user_agent("their_agents:Lists", ENV)()], [[0, 0]] * 2) == [5, 4]).all()


@pytest.mark.usefixtures("module")
@pytest.mark.parametrize("name", ["share", "one_for_all", "network", "Counts"])
def test_an_ego_and_a_partner_of_one_name_have_a_memory_each(name: str) -> None:
    make = open_user_agent(f"their_agents:{name}", ENV)
    steps = list_actions([make(), make()], [[0, 1], [1, 0]])
    np.testing.assert_array_equal(steps, np.broadcast_to(np.arange(12)[:, None, None] % 4, (12, 2, 2)))


@pytest.mark.usefixtures("module")
def test_an_agent_of_overcooked_ai_that_a_function_gives_again_has_a_memory_for_each_seat() -> None:
    steps = list_actions([open_user_agent("their_agents:share_agent", ENV)()], [[0, 0]] * 2)
    assert (steps == [0, 1]).all()


@pytest.mark.parametrize(("answer", "told"), [(260, "0 to 255, got 260 to 260"), (-1, "-1"), (1.7, "whole numbers")])
def test_a_batch_of_games_takes_no_action_that_a_cast_would_change(answer: float, told: str) -> None:
    policy = IdlePolicy(ENV.spec.action_names)
    policy.act = lambda obs, previous_actions, is_first: np.full(obs.shape[:2], answer)  # type: ignore[method-assign]
    with pytest.raises(ValueError, match=told):
        play(ENV, [policy], np.zeros((2, 2), int), seed=0)
