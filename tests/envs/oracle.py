"""Compares popgen's Overcooked with overcooked_ai step by step: `python -m tests.envs.oracle --steps 20000`.

overcooked_ai's own classes give states, rewards, events and the lossless encoding; automatic cooking, which version
1.1.0 lacks, is added to them as later versions have it (`popgen.envs.overcooked.bridge.AutomaticGridworld`).
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from overcooked_ai_py.mdp.actions import Action
from overcooked_ai_py.mdp.overcooked_mdp import OvercookedGridworld

from popgen.envs.overcooked import OvercookedEnv
from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.bridge import AutomaticGridworld, from_overcooked_ai, to_overcooked_ai
from tests.envs.cooks import Cook, Kitchen

LAYOUTS = (
    "cramped_room",
    "asymmetric_advantages",
    "coordination_ring",
    "forced_coordination",
    "counter_circuit_o_1order",
)
MODES = ("auto", "interact")
GAMES = 8
RANDOMNESS = (0.1, 0.1, 0.1, 0.1, 0.25, 0.25, 0.5, 1.0)  # of the cooks of each game; 1 plays at random


@dataclass
class Report:
    """What was compared: joint steps, and how often things happened in them."""

    layout: str
    cooking: str
    steps: int = 0
    seconds: float = 0.0
    differences: int = 0
    events: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    raw_events: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    drops: int = 0
    counter_pickups: int = 0
    unpaid: int = 0
    reward: float = 0.0


class Comparison:
    """GAMES games in both simulators, always from the reference's states."""

    def __init__(self, layout: str, cooking: str, seed: int = 0, *, mdp: Any = None, **params: Any) -> None:
        self.env = OvercookedEnv(layout, GAMES, cooking=cooking, **params)
        self.raw = OvercookedEnv(layout, 1, cooking=cooking, events="raw", **params)
        self.mdp = OvercookedGridworld.from_layout_name(layout) if mdp is None else mdp
        if cooking == "auto":
            self.mdp.__class__ = AutomaticGridworld
        self.report = Report(layout, cooking)
        rngs = [np.random.default_rng([seed, game]) for game in range(GAMES)]
        kitchen = Kitchen(self.env)
        self.cooks = [
            [Cook(kitchen, seat, rng, randomness) for seat in (0, 1)]
            for rng, randomness in zip(rngs, RANDOMNESS, strict=True)
        ]
        self.swap = list(self.env.spec.views["features"].swap)

    def run(self, steps: int) -> Report:
        """Compare at least `steps` joint steps; raises AssertionError at the first difference."""
        began = time.perf_counter()
        states = self._restart()
        for step in range(-(-steps // GAMES)):
            rows = self.env.get_state()
            self._compare_states(states, rows, thorough=step % 16 == 0)
            self._compare_views(states, rows)
            actions = np.array([[cook.act(row) for cook in pair] for pair, row in zip(self.cooks, rows, strict=True)])
            states = self._compare_step(states, rows, actions)
            if (step + 1) % self.env.horizon == 0:
                states = self._restart()
        self.report.seconds = time.perf_counter() - began
        return self.report

    def _restart(self) -> list[Any]:
        self.env.reset()
        return [self.mdp.get_standard_start_state() for _ in range(GAMES)]

    def _compare_states(self, states: list[Any], rows: np.ndarray, *, thorough: bool) -> None:
        for state, row in zip(states, rows, strict=True):
            want = from_overcooked_ai(self.env, state)
            assert np.array_equal(want, row), f"states differ: {want} is {row}\n{state}"
            if thorough:
                back = to_overcooked_ai(self.env, row)
                assert _sorted_soups(back) == _sorted_soups(state.deepcopy()), f"{back}\nis not\n{state}"

    def _compare_views(self, states: list[Any], rows: np.ndarray) -> None:
        want = np.stack([self.mdp.lossless_state_encoding(state, self.env.horizon) for state in states])
        got = self.env.encode(rows, "lossless")
        assert np.array_equal(want, got), f"lossless differs at {np.argwhere(want != got)[:5].tolist()}"
        features = self.env.encode(rows, "features")
        assert features.max() <= 1
        assert np.array_equal(features[:, 1], features[:, 0][:, self.swap]), "swap is wrong"
        inverse = self.env.features_to_lossless(features)
        assert np.array_equal(want, inverse), f"inverse differs at {np.argwhere(want != inverse)[:5].tolist()}"

    def _compare_step(self, states: list[Any], rows: np.ndarray, actions: np.ndarray) -> list[Any]:
        batch = self.env.step(actions)
        following, raw = self.raw.simulate(rows, actions)
        assert np.array_equal(following, self.env.get_state()), "events=raw changes the dynamics"
        after = []
        for game, state in enumerate(states):
            joint = tuple(Action.INDEX_TO_ACTION[action] for action in actions[game])
            next_state, infos = self.mdp.get_state_transition(state, joint)
            paid = infos["sparse_reward_by_agent"]
            assert batch.reward[game] == raw.reward[game] == sum(paid), f"reward {batch.reward[game]} is not {paid}"
            assert batch.score[game] == raw.score[game] == sum(value > 0 for value in paid)
            logged = infos["event_infos"]
            want_raw = self._paid_events(raw_event_vector(logged), next_state, paid)
            assert np.array_equal(raw.events[game], want_raw), f"{raw.events[game]} is not {want_raw}"
            want = self._paid_events(event_vector(self.mdp, state, next_state, joint, logged), next_state, paid)
            assert np.array_equal(batch.events[game], want), f"{batch.events[game]} is not {want}"
            self._count(want, want_raw, logged, paid)
            self._compare_training_reward(batch.events[game], paid)
            after.append(next_state)
        assert np.array_equal(batch.truncated, [state.timestep >= self.env.horizon for state in after])
        return after

    def _paid_events(self, events: np.ndarray, after: Any, paid: list[float]) -> np.ndarray:
        """(2, E) of overcooked_ai's five events: deliveries by what they paid, soups only if they are paid for."""
        worths = self.env.tables.worths
        found = np.zeros((2, self.env.spec.num_events), np.uint8)
        found[:, : k.DELIVERS_SOUP] = events[:, : k.DELIVERS_SOUP]
        for seat, player in enumerate(after.players):
            if events[seat, k.TAKES_SOUP]:
                found[seat, k.TAKES_SOUP] = self.mdp.get_recipe_value(after, player.held_object.recipe) > 0
            if events[seat, k.DELIVERS_SOUP] and paid[seat] > 0:
                found[seat, k.DELIVERS_SOUP + worths.index(float(paid[seat]))] = 1
        return found

    def _compare_training_reward(self, events: np.ndarray, paid: list[float]) -> None:
        """A delivery pays in training what the game pays for it, in units of its dearest soup, and else nothing."""
        weights, worth = self.env.spec.event_weights, self.env.tables.worths[-1]
        deliveries = float(events[:, k.DELIVERS_SOUP :].sum(0) @ np.array(weights[k.DELIVERS_SOUP :]))
        shares = [1.0 if value == worth else max(0.0, value) / worth for value in paid]
        assert abs(deliveries - 12.0 * sum(shares)) < 1e-9, f"{deliveries} is paid for {paid}"

    def _count(self, events: np.ndarray, raw: np.ndarray, logged: dict[str, list[bool]], paid: list[float]) -> None:
        report = self.report
        report.steps += 1
        report.reward += sum(paid)
        report.events = report.events + events.sum(0, dtype=int) if len(report.events) else events.sum(0, dtype=int)
        report.raw_events = (
            report.raw_events + raw.sum(0, dtype=int) if len(report.raw_events) else raw.sum(0, dtype=int)
        )
        report.drops += sum(sum(logged[f"{name}_drop"]) for name in ("onion", "tomato", "dish", "soup"))
        report.counter_pickups += int((raw & ~events & 1)[:, : k.DELIVERS_SOUP].sum())
        report.unpaid += int(raw_event_vector(logged)[:, k.DELIVERS_SOUP].sum()) - sum(value > 0 for value in paid)


def raw_event_vector(logged: dict[str, list[bool]]) -> np.ndarray:
    """(2, E) events as overcooked_ai logs them."""
    columns = (
        ("onion_pickup", "tomato_pickup"),
        ("dish_pickup",),
        ("potting_onion", "potting_tomato"),
        ("soup_pickup",),
        ("soup_delivery",),
    )
    return np.array([[any(logged[name][seat] for name in names) for names in columns] for seat in (0, 1)], np.uint8)


def event_vector(mdp: Any, state: Any, after: Any, joint: tuple[Any, ...], logged: dict[str, list[bool]]) -> np.ndarray:
    """(2, E) events that happened at dispensers and pots, from what hands held before and after."""
    events = raw_event_vector(logged)
    for seat, (player, action) in enumerate(zip(state.players, joint, strict=True)):
        tile = mdp.get_terrain_type_at_pos(Action.move_in_direction(player.position, player.orientation))
        took = action == Action.INTERACT and player.held_object is None and after.players[seat].held_object is not None
        events[seat, k.TAKES_INGREDIENT] = took and tile in "OT"
        events[seat, k.TAKES_DISH] = took and tile == "D"
        events[seat, k.TAKES_SOUP] &= tile == "P"
    return events


def _sorted_soups(state: Any) -> Any:
    """State rows do not hold the order in which a soup's ingredients went in."""
    held = [player.held_object for player in state.players if player.held_object is not None]
    for thing in [*held, *state.objects.values()]:
        if thing.name == "soup":
            thing._ingredients.sort(key=lambda ingredient: ingredient.name)
    return state


def main() -> None:
    """Compare every layout in both modes and print what was seen."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000, help="joint steps per layout and cooking mode")
    parser.add_argument("--layouts", nargs="+", default=list(LAYOUTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    args = parser.parse_args()
    reports = []
    for layout in args.layouts:
        for cooking in MODES:
            report = Comparison(layout, cooking, args.seed).run(args.steps)
            reports.append(report)
            if not args.json:
                print(
                    f"{layout:26} {cooking:9}{report.steps:7} steps, no difference; events {report.events.tolist()}, "
                    f"raw {report.raw_events.tolist()}, drops {report.drops}, unpaid {report.unpaid}, "
                    f"reward {report.reward:.0f}, {report.seconds:.1f} s",
                    flush=True,
                )
    total = sum(report.steps for report in reports)
    if args.json:
        rows = [{name: _plain(value) for name, value in vars(report).items()} for report in reports]
        print(json.dumps({"steps": total, "differences": 0, "comparisons": rows}))
    else:
        print(f"{total} steps in all, no difference")


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


if __name__ == "__main__":
    main()
