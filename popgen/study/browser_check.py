"""Proof that the browser does what Python does: transitions by the rules of both, compared byte by byte, and games of
egos, compared action by action with the same random numbers.

An ego's actions are compared with those of its program in Python, which must be equal to the last bit of every
probability, and with its own network's (PyTorch, float32), whose probabilities are inverted at the same numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import nn

from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.env import OvercookedEnv
from popgen.envs.overcooked.exported_kitchen import export_kitchen
from popgen.envs.overcooked.layout import layout_names
from popgen.errors import UserError
from popgen.humans.recordings import HumanGame, make_human_env
from popgen.methods.ego.ego_policy import EgoPolicy
from popgen.play.policy import Policy
from popgen.play.stacked_partners import Stackable
from popgen.policies.portable_kernels import invert_distribution
from popgen.policies.portable_program import write_program
from popgen.policies.program_runner import ProgramRunner, describe_generator
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
    pots = len(tables.pots)
    items, contents = (np.append(0, np.flatnonzero(tables.table[row] >= 0)) for row in (k.ITEM_BIT, k.POT_BIT))
    floor = np.flatnonzero(tables.table[k.FLOOR] >= 0)
    order = rng.random((count, len(floor))).argpartition(1, axis=1)[:, :2]  # two different cells
    states[:, :2] = floor[order]
    states[:, k.ORIENT : k.HELD] = rng.integers(0, 4, (count, 2))
    for place in (*range(k.HELD, k.TIME), *range(k.POTS + 2 * pots, states.shape[1])):
        states[:, place] = rng.choice(items, count)
    for slot in range(k.POTS, k.POTS + 2 * pots, 2):
        states[:, slot] = rng.choice(contents, count)
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


@dataclass(frozen=True)
class CheckedEgo:
    """Steps of an ego that were played in the browser and here.

    Attributes:
        states: compared.
        differing: of them, those with another action or another bit of a probability than the program's in Python.
        network: those with another action than the network itself takes at the same random number; None where the
            policy does not tell its probabilities.
        furthest: the largest difference of a probability from the network's.
    """

    states: int
    differing: int
    network: int | None
    furthest: float


def check_ego(engine: ScriptEngine, env: OvercookedEnv, policy: Policy, games: int, seed: int) -> CheckedEgo:
    """Let an ego play whole games beside random keys, in both seats in turn.

    Raises:
        ValueError: the policy has no program.
    """
    program, steps, rng = write_program(policy), env.horizon, np.random.default_rng(seed)
    pressed = rng.integers(0, k.NUM_ACTIONS, (games, steps), dtype=np.uint8)
    seeds = rng.integers(0, 2**31, games).tolist()
    told = {"kitchen": export_kitchen(env), "games": games, "steps": steps}
    told["generators"] = [describe_generator(one) for one in seeds]
    answer = engine.run_task("partner", told, pressed.tobytes() + program.to_bytes())
    found = np.frombuffer(answer, np.uint8).reshape(games, steps, -1)
    replay = _EgoReplay(env, ProgramRunner(program, k.NUM_ACTIONS), _find_teller(policy))
    same = [replay.play_game(pressed[game], game % 2, seeds[game], found[game]) for game in range(games)]
    return CheckedEgo(games * steps, games * steps - sum(same), replay.network, replay.furthest)


class _EgoReplay:
    """Games that the browser played, played again.

    Attributes:
        network, furthest: see `CheckedEgo`, so far.
    """

    def __init__(self, env: OvercookedEnv, runner: ProgramRunner, teller: _Teller | None) -> None:
        self.env, self.runner, self.teller = env, runner, teller
        self.network, self.furthest = (None if teller is None else 0), 0.0

    def play_game(self, pressed: np.ndarray, seat: int, seed: int, found: np.ndarray) -> int:
        """Steps in which the browser's action and probabilities `found` are the program's."""
        state, previous, same = self.env.kitchen.start[None], np.zeros(2, np.uint8), 0
        uniforms = np.random.Generator(np.random.SFC64(seed))
        self.runner.begin(seat, seed)
        if self.teller is not None:
            self.teller.begin()
        for step, key in enumerate(pressed):
            obs = self.env.encode(state)
            action = self.runner.act(obs[0], previous, first=step == 0)
            wanted = np.concatenate([[action], self.runner.probabilities.view(np.uint8)])
            same += bool((found[step] == wanted).all())
            drawn = self.runner.count_draws()
            uniform = uniforms.random(drawn)[-1] if drawn else 0.0
            if self.teller is not None and self.network is not None:
                told = self.teller.tell(obs, previous, step == 0, self.runner.find_held())[seat]
                self.network += int(invert_distribution(told.astype(np.float64), uniform) != int(found[step, 0]))
                self.furthest = max(self.furthest, float(np.abs(told - self.runner.probabilities).max()))
            previous = np.array([action, key] if seat == 0 else [key, action], np.uint8)
            state = self.env.simulate(state, previous[None])[0]
        return same


class _Teller(Protocol):
    """A network's own probabilities, step by step."""

    def begin(self) -> None:
        """A fresh game."""

    def tell(self, obs: np.ndarray, previous: np.ndarray, first: bool, skill: int | None) -> np.ndarray:
        """(P, A) of both seats."""
        ...


class _EgoTeller:
    """Of policies that tell them."""

    def __init__(self, policy: EgoPolicy) -> None:
        self._policy = policy

    def begin(self) -> None:
        """See `_Teller`."""
        self._policy.reset(1, 0)

    def tell(self, obs: np.ndarray, previous: np.ndarray, first: bool, skill: int | None) -> np.ndarray:
        """See `_Teller`."""
        return self._policy.tell_probabilities(obs, previous[None], np.array([first]), skill)[0]


class _SeatTeller:
    """Of networks that act in one seat."""

    def __init__(self, policy: Stackable, network: nn.Module) -> None:
        self._size, self._network = policy.memory_size, network
        self._memory = torch.zeros(2, self._size)

    def begin(self) -> None:
        """See `_Teller`."""
        self._memory = torch.zeros(2, self._size)

    @torch.no_grad()
    def tell(self, obs: np.ndarray, previous: np.ndarray, first: bool, skill: int | None) -> np.ndarray:
        """See `_Teller`."""
        both, actions = (torch.from_numpy(np.repeat(rows, 2, 0)) for rows in (obs, previous[None].astype(np.int64)))
        logits, self._memory = self._network(
            self._memory, both, actions, torch.tensor([first, first]), torch.tensor([0, 1])
        )
        return logits.softmax(-1).numpy()


def _find_teller(policy: Policy) -> _Teller | None:
    if isinstance(policy, EgoPolicy):
        return _EgoTeller(policy)
    network = policy.seat_network() if isinstance(policy, Stackable) else None
    return None if network is None else _SeatTeller(policy, network)  # type: ignore[arg-type]
