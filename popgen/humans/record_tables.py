"""Recorded games as tables with the 14 columns of the field's public data (2020), read and written.

The columns: state (JSON of overcooked_ai's `OvercookedState`, before the step), joint_action (JSON), reward, time_left,
score (after the step), time_elapsed, cur_gameloop (the step), layout (JSON of its rows), layout_name, trial_id,
player_0_id, player_1_id, player_0_is_human, player_1_is_human. Further columns may follow: `environment` (JSON: name
and params) says what was played, which is otherwise the layout of that name with automatic cooking; `status` says
`finished` of a game that was played to its end.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from popgen.envs import make_env
from popgen.envs.overcooked import OvercookedEnv
from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.layout import DIRECTIONS
from popgen.errors import UserError

COLUMNS = (
    *("state", "joint_action", "reward", "time_left", "score", "time_elapsed", "cur_gameloop", "layout"),
    *("layout_name", "trial_id", "player_0_id", "player_1_id", "player_0_is_human", "player_1_is_human"),
)


@dataclass(frozen=True)
class TableGame:
    """One game of a table.

    Attributes:
        env: what was played.
        layout, trial: names.
        players: who played in seat 0 and seat 1.
        people: which of them are people.
        states: (T, S) uint8, before each step.
        actions: (T, 2) uint8.
        dishes: (T,) float64, delivered in the step.
        finished: played to its end.
    """

    env: OvercookedEnv
    layout: str
    trial: str
    players: tuple[str, str]
    people: tuple[bool, bool]
    states: np.ndarray
    actions: np.ndarray
    dishes: np.ndarray
    finished: bool = True


class StateWriter:
    """States and actions of one environment as the columns' texts.

    Args:
        env: overcooked_ai's recipes are set to its own.
    """

    def __init__(self, env: OvercookedEnv) -> None:
        from popgen.envs.overcooked.bridge import to_overcooked_mdp

        to_overcooked_mdp(env)
        self._env = env
        self.layout = json.dumps([list(row) for row in env.layout.rows])

    def write_state(self, row: np.ndarray) -> str:
        """JSON of a state (S,)."""
        from popgen.envs.overcooked.bridge import to_overcooked_ai

        return json.dumps(to_overcooked_ai(self._env, row).to_dict())


def write_actions(actions: np.ndarray) -> str:
    """JSON of both players' actions (2,)."""
    return json.dumps([_write_action(int(action)) for action in actions])


def _write_action(action: int) -> Any:
    if action == k.INTERACT:
        return "interact"
    return [0, 0] if action == k.STAY else list(DIRECTIONS[action])


def read_table_games(path: Path) -> list[TableGame]:
    """All games of a table (.parquet, .csv), each checked against the simulator.

    Of every game the first state and the actions are read; the states that follow are the simulator's, and the last
    recorded one must be the same.

    Raises:
        UserError: no such file, missing columns, or games that are not those of our rules.
    """
    table = _read_columns(path)
    envs: dict[str, OvercookedEnv] = {}
    games = []
    for trial, rows in table.groupby("trial_id", sort=False):
        try:
            games.append(_read_game(str(trial), rows, envs))
        except (ValueError, KeyError, TypeError, IndexError, AttributeError, AssertionError) as error:
            raise UserError(str(path), f"trial {trial}: {error}", "export it again") from None
    if not games:
        raise UserError(str(path), "holds no games", "give another file")
    return games


def _read_columns(path: Path) -> pd.DataFrame:
    try:
        table = pd.read_parquet(path) if path.suffix == ".parquet" else pd.read_csv(path)
    except (OSError, ValueError) as error:  # pyarrow's errors are ValueErrors
        raise UserError(
            str(path), f"cannot be read ({str(error).splitlines()[0]})", "give a .parquet or .csv"
        ) from None
    if missing := [name for name in COLUMNS if name not in table.columns]:
        raise UserError(str(path), f"has no column {missing[0]}", "give a table of recorded games")
    return table


def _read_game(trial: str, rows: pd.DataFrame, envs: dict[str, OvercookedEnv]) -> TableGame:
    from popgen.envs.overcooked.bridge import to_overcooked_mdp

    first = rows.iloc[0]
    key = str(first.get("environment") or json.dumps({"name": f"overcooked/{first['layout_name']}", "params": {}}))
    if key not in envs:
        envs[key] = _make_table_env(json.loads(key))
    env = envs[key]
    to_overcooked_mdp(env)
    if not np.array_equal(rows["cur_gameloop"], np.arange(len(rows)) + int(first["cur_gameloop"])):
        raise ValueError("steps are missing")
    actions = np.array([_read_actions(text) for text in rows["joint_action"]], np.uint8)
    states = np.empty((len(rows), env.spec.state_size), np.uint8)
    dishes = np.empty(len(rows))
    states[0] = _read_state(env, first["state"])
    for step in range(len(rows)):
        following, result = env.simulate(states[step][None], actions[step][None])
        dishes[step] = result.score[0]
        if step + 1 < len(rows):
            states[step + 1] = following[0]
    if not np.array_equal(states[-1], _read_state(env, rows.iloc[-1]["state"])):
        raise ValueError("the recorded steps are not those of these rules")
    people = tuple(_is_true(first[f"player_{seat}_is_human"]) for seat in (0, 1))
    names = tuple(str(first[f"player_{seat}_id"]) for seat in (0, 1))
    finished = str(first.get("status", "finished")) == "finished"
    return TableGame(
        env=env,
        layout=str(first["layout_name"]),
        trial=trial,
        players=(names[0], names[1]),
        people=(people[0], people[1]),
        states=states,
        actions=actions,
        dishes=dishes,
        finished=finished,
    )


def _make_table_env(told: Mapping[str, Any]) -> OvercookedEnv:
    env = make_env(told["name"], 1, **told["params"])
    if not isinstance(env, OvercookedEnv):
        raise ValueError(f"{told['name']} is not Overcooked")
    return env


def _read_state(env: OvercookedEnv, text: str) -> np.ndarray:
    from overcooked_ai_py.mdp.overcooked_mdp import OvercookedState

    from popgen.envs.overcooked.bridge import from_overcooked_ai

    return from_overcooked_ai(env, OvercookedState.from_dict(json.loads(text)))


def _read_actions(text: str) -> list[int]:
    first, second = json.loads(text)
    return [_read_action(first), _read_action(second)]


def _read_action(action: Any) -> int:
    if isinstance(action, str):
        if action.lower() != "interact":
            raise ValueError(f"there is no action {action!r}")
        return k.INTERACT
    return k.STAY if action == [0, 0] else DIRECTIONS.index(tuple(action))


def _is_true(value: Any) -> bool:
    return str(value) in ("True", "true", "1", "1.0")
