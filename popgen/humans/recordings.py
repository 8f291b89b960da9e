"""Recorded games of two people, read from the installed overcooked-ai package and turned into our states and actions.

The package brings two files with 76 games (Carroll et al. 2019, recorded in 2019): those of the original study's
training half and those of its test half. They are read where they lie and never copied.

The recorded dynamics are those of automatic cooking (`cooking=auto`): a full pot starts by itself. They differ from
today's game in two ways that are no difference of what happens next. Cook counters run on after a soup is done (to
239), where ours stop at "ready"; and a soup paid 5 points where it pays 20 today.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from popgen.envs import make_env
from popgen.envs.contract import BatchedEnv
from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.env import OvercookedEnv
from popgen.envs.overcooked.layout import DIRECTIONS
from popgen.envs.overcooked.rules import SOUP_CODE
from popgen.envs.overcooked.start import ITEM_CODE
from popgen.errors import UserError
from popgen.humans.pickled_frame import FrameError, read_columns

LAYOUTS = {
    "cramped_room": "cramped_room",
    "asymmetric_advantages": "asymmetric_advantages",
    "coordination_ring": "coordination_ring",
    "forced_coordination": "random0",
    "counter_circuit_o_1order": "random3",
}
"""Name of a layout today -> in the recordings."""

POINTS = 5.0
"""What a soup paid when the games were recorded."""

STEP_SECONDS = 0.15
"""Length of a recorded step."""


@dataclass(frozen=True)
class RecordedFile:
    """A file of the package: its name, its size and its sha256."""

    name: str
    size: int
    sha256: str


FILES = {
    "train": RecordedFile(
        "clean_train_trials.pickle", 27_723_418, "28659cfd09ee033d82b56bed905b239f078877e1b09d1f1b916e4bc0480ca4fa"
    ),
    "test": RecordedFile(
        "clean_test_trials.pickle", 27_549_202, "59979552a053f1efe762de976f37dd83e269d70d19b67613c61e856c86705666"
    ),
}
"""The two halves, split by game as the package ships them."""


@dataclass(frozen=True)
class HumanGame:
    """One game of two people.

    Attributes:
        layout: today's name.
        half: `train` or `test`.
        pair: number of the two people, who play one game of every layout at most.
        states: (T + 1, S) uint8, the last after the last step; the time step counts from 0 and runs on past 400.
        actions: (T, 2) uint8.
        dishes: (T,) float64, soups delivered in the step.
    """

    layout: str
    half: str
    pair: int
    states: np.ndarray
    actions: np.ndarray
    dishes: np.ndarray

    @property
    def steps(self) -> int:
        """T."""
        return len(self.actions)


def make_human_env(layout: str, num_envs: int = 1) -> OvercookedEnv:
    """The environment that people played in, with today's episodes of 400 steps.

    Raises:
        UserError: nobody was recorded in this layout.
    """
    if layout not in LAYOUTS:
        raise UserError("layout", f"nobody was recorded in {layout!r}", f"choose one of {', '.join(LAYOUTS)}")
    env: BatchedEnv = make_env(f"overcooked/{layout}", num_envs, cooking="auto")
    assert isinstance(env, OvercookedEnv)
    return env


def read_recorded_bytes(half: str) -> bytes:
    """The bytes of a half's file, after checking that they are the known ones.

    Raises:
        UserError: the package or its file is missing, or is not the known one.
    """
    fix = "pip install overcooked-ai==1.1.0"
    spec = importlib.util.find_spec("overcooked_ai_py")
    if spec is None or not spec.submodule_search_locations:
        raise UserError("overcooked_ai_py", "is not installed: it brings the recorded games", fix)
    file = FILES[half]
    path = Path(list(spec.submodule_search_locations)[0], "data", "human_data", file.name)
    try:
        size = path.stat().st_size
        data = path.read_bytes() if size == file.size else b""
    except OSError as error:
        raise UserError(str(path), f"cannot be read: {error.strerror}", fix) from None
    if hashlib.sha256(data).hexdigest() != file.sha256:
        raise UserError(str(path), "is not the known file of recorded games and will not be read", fix)
    return data


def load_games(halves: Sequence[str] = ("train", "test"), layouts: Sequence[str] | None = None) -> list[HumanGame]:
    """The games of the given halves and layouts, in the order in which the files hold them.

    Raises:
        UserError: the files are missing or are not the known ones, or an unknown layout.
    """
    wanted = tuple(LAYOUTS if layouts is None else layouts)
    converters = {LAYOUTS.get(layout, layout): _Converter(layout) for layout in wanted}
    games: list[HumanGame] = []
    for half in halves:
        try:
            columns = read_columns(read_recorded_bytes(half))
            games += _cut_games(columns, half, converters)
        except FrameError as error:
            raise UserError(FILES[half].name, str(error), "pip install overcooked-ai==1.1.0") from None
    return games


def _cut_games(columns: Mapping[str, np.ndarray], half: str, converters: Mapping[str, _Converter]) -> list[HumanGame]:
    pairs, names = columns["workerid_num"], columns["layout_name"]
    begins = np.flatnonzero(np.r_[True, (pairs[1:] != pairs[:-1]) | (names[1:] != names[:-1])])
    games = []
    for begin, end in zip(begins, np.r_[begins[1:], len(pairs)], strict=True):
        converter = converters.get(names[begin])
        if converter is None:
            continue
        rows = slice(begin, end)
        if not np.array_equal(columns["cur_gameloop"][rows], np.arange(end - begin)):
            raise FrameError(f"holds a game with missing steps (row {begin})")
        texts = [*columns["state"][rows], columns["next_state"][end - 1]]
        states = np.stack([converter.to_state(text, step) for step, text in enumerate(texts)])
        actions = np.array([converter.to_actions(text) for text in columns["joint_action"][rows]], np.uint8)
        dishes = columns["reward"][rows] / POINTS
        games.append(HumanGame(converter.layout, half, int(pairs[begin]), states, actions, dishes))
    return games


class _Converter:
    """From the texts of one layout's rows to states and actions."""

    def __init__(self, layout: str) -> None:
        self.layout = layout
        self._env = make_human_env(layout)
        self._rows: dict[str, np.ndarray] = {}
        self._joints: dict[str, tuple[int, int]] = {}

    def to_actions(self, text: str) -> tuple[int, int]:
        """Both players' actions; raises FrameError for a text that is none."""
        if text not in self._joints:
            joint = _parse(text)
            self._joints[text] = (_to_action(joint[0]), _to_action(joint[1]))
        return self._joints[text]

    def to_state(self, text: str, step: int) -> np.ndarray:
        """(S,) uint8 at the given time step; raises FrameError for a text that is no state of this layout."""
        if text not in self._rows:
            try:
                self._rows[text] = self._read(_parse(text))
            except (KeyError, IndexError, TypeError, ValueError) as error:
                raise FrameError(f"holds a state that does not fit {self.layout} ({error})") from None
        row = self._rows[text].copy()
        row[k.TIME], row[k.TIME + 1] = step & 255, step >> 8
        return row

    def _read(self, state: Mapping[str, Any]) -> np.ndarray:
        env, width = self._env, self._env.layout.width
        row = np.zeros(env.spec.state_size, np.uint8)
        for seat, player in enumerate(state["players"]):
            x, y = player["position"]
            row[seat] = y * width + x
            row[k.ORIENT + seat] = DIRECTIONS.index(tuple(player["orientation"]))
            if "held_object" in player:
                row[k.HELD + seat] = _to_item(player["held_object"])
        for place, thing in state["objects"].items():
            x, y = (int(number) for number in place.split(","))
            slot = env.tables.table[k.SLOT, y * width + x]
            if slot == 0:
                raise ValueError(f"an object at {place}")
            row[slot] = _to_item(thing)
            if env.tables.table[k.KIND, y * width + x] == k.POT:
                row[slot + 1] = self._to_cooking(thing["state"])
        return row

    def _to_cooking(self, soup: Sequence[Any]) -> int:
        """The counter of old runs from 0 for a pot that is not full, and past the cook time for one that is done."""
        _kind, ingredients, counter = soup
        if ingredients < self._env.rules.max_ingredients:
            return 0
        time = self._env.rules.cook_time[ingredients, 0]
        return 1 + max(0, time - counter)


def _parse(text: str) -> Any:
    """A literal of Python that holds text in single quotes, True and False only."""
    plain = text.replace("'", '"').replace("True", "true").replace("False", "false").replace("None", "null")
    try:
        return json.loads(plain)
    except (ValueError, RecursionError):
        raise FrameError("holds a text that is neither a state nor an action") from None


def _to_action(action: Any) -> int:
    if isinstance(action, str):
        if action.lower() != "interact":
            raise FrameError("holds an unknown action")
        return k.INTERACT
    if action == [0, 0]:
        return k.STAY
    return DIRECTIONS.index(tuple(action))


def _to_item(thing: Mapping[str, Any]) -> int:
    if thing["name"] != "soup":
        return ITEM_CODE[thing["name"]]
    kind, ingredients, _counter = thing["state"]
    return SOUP_CODE[(ingredients, 0) if kind == "onion" else (0, ingredients)]
