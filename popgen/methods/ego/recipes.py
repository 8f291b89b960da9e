"""Recipes of ego agents. Where a number was measured or argued for, its reason stands beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from popgen.methods.recipe import Recipe, because, ours

_HERE: Mapping[str, Any] = {
    "population.size": because(1, "the run's population is the ego"),
    "evaluation.episodes": 20,
    "run.transport": because("inline", "one learner: there is nothing to distribute; `ray` puts it in an actor"),
    "run.checkpoint_seconds": 30.0,
}
_BESIDE_MANY: Mapping[str, Any] = {
    "ego.other_starts": because(0.5, "without it scores beside strangers stop rising long before those in training"),
}
_WHOLE_EPISODES: Mapping[str, Any] = {
    **_BESIDE_MANY,
    "ego.unroll": because(400, "whole episodes: no segment of the high level is cut"),
    "ego.envs": because(64, "as many steps to an update as 128 environments with 200"),
    "ego.minibatches": 8,
}
_SKILLS: Mapping[str, Mapping[str, Any]] = {
    "overcooked/forced_coordination": {"hipt.skills": 5},
    "overcooked/counter_circuit_o_1order": {"hipt.skills": 6},
}

SMOKE_SETTINGS: Mapping[str, Any] = {
    "evaluation.episodes": 2,
    "ego.units": 16,
    "ego.channels": 4,
    "ego.head_units": 8,
    "ego.critic_units": 16,
    "ego.steps": 1600,
    "ego.envs": 4,
    "ego.unroll": 40,
    "ego.sequence": 20,
    "ego.epochs": 1,
    "ego.minibatches": 2,
    "run.checkpoint_seconds": 0.0,
}

PAPER_SETTINGS: Mapping[str, Any] = {
    "evaluation.episodes": 40,
    "ego.network": "conv_lstm",
    "ego.units": 512,
    "ego.channels": 26,
    "ego.head_units": 128,
    "ego.critic_units": ours(512, "a network of its own, which sees the partner's number and the seat"),
    "ego.steps": 100_000_000,
    "ego.envs": 30,
    "ego.unroll": 400,
    "ego.sequence": because(400, "whole episodes, from an empty memory"),
    "ego.epochs": 8,
    "ego.minibatches": 6,
    "ego.clip": 0.05,
    "ego.lam": 0.98,
    "ego.learning_rate": 1e-3,
    "ego.learning_rate_end": 0.333,
    "ego.entropy": 0.01,
    "ego.grad_clip": 0.1,
}
_PAPER_RATES: Mapping[str, Mapping[str, Any]] = {
    "overcooked/coordination_ring": {"ego.learning_rate": 6e-4, "ego.learning_rate_end": 0.667},
    "overcooked/forced_coordination": {"ego.learning_rate": 8e-4, "ego.learning_rate_end": 0.5},
    "overcooked/counter_circuit_o_1order": {"ego.learning_rate": 8e-4},
}
_RENDEZVOUS: Mapping[str, Any] = {
    "ego.unroll": because(50, "an episode"),
    "ego.sequence": 50,
}


def _make_recipes(own: Mapping[str, Any], rows: Mapping[str, Mapping[str, Any]]) -> dict[str, Recipe]:
    """The four recipes of a method whose settings are `own`, with rows by layout."""
    by_layout = {**rows, "rendezvous/mppmr": {**rows.get("rendezvous/mppmr", {}), **_RENDEZVOUS}}
    paper = {name: {**_PAPER_RATES.get(name, {}), **rows.get(name, {})} for name in {**_PAPER_RATES, **rows}}
    laptop = Recipe("laptop", "Two CPU cores, minutes an ego.", {**_HERE, **own}, by_layout)
    demo = Recipe("demo", "An ego that plays, in a minute or two.", {"ego.steps": 500_000}, base=laptop)
    smoke = Recipe("smoke", "Seconds, for tests: every code path once, nothing learned.", {**_HERE, **SMOKE_SETTINGS})
    published = Recipe(
        "paper",
        "HiPT's published network, budget and rates; it learns on the CPU, for days.",
        {**_HERE, **PAPER_SETTINGS},
        paper,
    )
    return {recipe.name: recipe for recipe in (laptop, demo, published, smoke)}


FLAT_RECIPES = _make_recipes(_BESIDE_MANY, {})
ALONE_RECIPES = _make_recipes({}, {})
BR_RECIPES = _make_recipes({"ego.steps": because(600_000, "one partner: one convention to learn"), "ego.envs": 64}, {})
_TWO_LEVELS: Mapping[str, Any] = {
    **_WHOLE_EPISODES,
    "hipt.entropy": because(0.05, "at 0.01 one of four z falls out of use (docs/notes/ego_learning.md)"),
}
HIPT_RECIPES = _make_recipes(_TWO_LEVELS, _SKILLS)
