"""Proof that the browser's rules are the simulator's: transitions played by both, compared byte by byte."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.env import OvercookedEnv
from popgen.envs.overcooked.exported_kitchen import export_kitchen
from popgen.envs.overcooked.layout import layout_names
from popgen.errors import UserError
from popgen.humans.recordings import HumanGame, make_human_env
from popgen.study.script_engine import ScriptEngine

CHUNK = 50_000
"""Transitions of a task, so that neither side holds more."""

MODES = ("auto", "interact")


@dataclass(frozen=True)
class CheckedRules:
    """Transitions of one kitchen that were played by both.

    Attributes:
        layout: its name.
        cooking: how pots start.
        transitions: compared.
        differing: of them, those with another next state, reward, score, end, event or observation.
    """

    layout: str
    cooking: str
    transitions: int
    differing: int


@dataclass(frozen=True)
class Transitions:
    """What is to be played: states (N, S) uint8 and joint actions (N, 2) uint8."""

    states: np.ndarray
    actions: np.ndarray


def open_kitchens(layouts: Sequence[str] | None = None) -> Iterator[OvercookedEnv]:
    """Each layout of overcooked_ai in each cooking mode that it allows; those that nobody can play are left out."""
    for layout in layouts or layout_names():
        for cooking in MODES:
            try:
                yield OvercookedEnv(layout, 1, cooking=cooking)
            except UserError:
                if layouts is not None:
                    raise


def draw_transitions(env: OvercookedEnv, count: int, rng: np.random.Generator) -> Transitions:
    """Half of them as random play meets them, half from states with anything in hands, pots and on counters."""
    actions = rng.integers(0, k.NUM_ACTIONS, (count, 2), dtype=np.uint8)
    half, row = count // 2, env.kitchen.start
    met = np.empty((half, len(row)), np.uint8)
    for number in range(half):
        if number % env.horizon == 0:
            row = env.kitchen.start
        met[number] = row
        row = env.simulate(row[None], actions[number][None])[0][0]
    return Transitions(np.concatenate([met, _draw_states(env, count - half, rng)]), actions)


def _draw_states(env: OvercookedEnv, count: int, rng: np.random.Generator) -> np.ndarray:
    """States (count, S) that need not be reachable: every object of the layout in every place."""
    tables, states = env.tables, np.zeros((count, env.spec.state_size), np.uint8)
    pots, items = len(tables.pots), np.flatnonzero(tables.table[k.ITEM_BIT] >= 0)
    contents = np.flatnonzero(tables.table[k.POT_BIT] >= 0)
    floor = np.flatnonzero(tables.table[k.FLOOR] >= 0)
    order = rng.random((count, len(floor))).argpartition(1, axis=1)[:, :2]  # two different cells
    states[:, :2] = floor[order]
    states[:, k.ORIENT : k.HELD] = rng.integers(0, 4, (count, 2))
    for place in (*range(k.HELD, k.TIME), *range(k.POTS + 2 * pots, states.shape[1])):
        states[:, place] = rng.choice([0, *items], count)
    for slot in range(k.POTS, k.POTS + 2 * pots, 2):
        states[:, slot] = rng.choice([0, *contents], count)
        cooking = rng.integers(0, int(tables.meta[k.M_COOK]) + 2, count)
        states[:, slot + 1] = np.where(states[:, slot] == 0, 0, cooking * rng.integers(0, 2, count))
        states[:, slot + 1] = np.where(rng.random(count) < 0.2, states[:, slot] > 0, states[:, slot + 1])
    time = rng.integers(0, env.horizon, count)
    states[:, k.TIME], states[:, k.TIME + 1] = time & 255, time >> 8
    return states


def list_recorded(games: Sequence[HumanGame]) -> Iterator[tuple[OvercookedEnv, Transitions]]:
    """All transitions of recorded games, layout by layout."""
    for layout in dict.fromkeys(game.layout for game in games):
        own = [game for game in games if game.layout == layout]
        states = np.concatenate([game.states[:-1] for game in own])
        yield make_human_env(layout), Transitions(states, np.concatenate([game.actions for game in own]))


def check_transitions(engine: ScriptEngine, env: OvercookedEnv, played: Transitions) -> CheckedRules:
    """Let both play, and count the transitions in which they differ."""
    told, differing = {"kitchen": export_kitchen(env)}, 0
    for start in range(0, len(played.states), CHUNK):
        part = Transitions(played.states[start : start + CHUNK], played.actions[start : start + CHUNK])
        sent = np.concatenate([part.states, part.actions], 1, dtype=np.uint8).tobytes()
        found = np.frombuffer(engine.run_task("transitions", told, sent), np.uint8)
        wanted = _play_transitions(env, part)
        same = found.size == wanted.size
        differing += int((found.reshape(wanted.shape) != wanted).any(1).sum()) if same else len(part.states)
    return CheckedRules(env.spec.name.rpartition("/")[2], env.cooking, len(played.states), differing)


def _play_transitions(env: OvercookedEnv, played: Transitions) -> np.ndarray:
    """Rows as task_runner.js gives them."""
    count = len(played.states)
    following, result = env.simulate(played.states, played.actions)
    parts = [
        following,
        result.reward.astype("<f4").view(np.uint8).reshape(count, 4),
        result.score.astype(np.uint8)[:, None],
        result.truncated.astype(np.uint8)[:, None],
        result.events.reshape(count, -1),
        env.encode(played.states).reshape(count, -1),
    ]
    return np.concatenate(parts, 1)
