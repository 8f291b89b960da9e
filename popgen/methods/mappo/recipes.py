"""Recipes of the baselines on MAPPO. Where a number was measured or argued for, its reason stands beside it."""

from __future__ import annotations

from collections.abc import Mapping

from popgen.methods.recipe import Recipe, Settings, because, ours

_NOTES = "docs/notes/baselines.md"
_GENERATORS = "docs/notes/generators.md"
_NEVER = "never reached: the steps are what is run"

LAPTOP = Recipe(
    "laptop",
    "Two CPU cores, minutes a member. A member that meets others ends at the target only once cross-play is down too.",
    {
        "ppo.max_steps": 3_000_000,
        "ppo.target_score": 12.0,
        "ppo.entropy": 0.01,
        "ppo.entropy_end": 1.0,
    },
    {
        "overcooked/cramped_room": {"ppo.max_steps": 800_000, "ppo.target_score": 10.5},
        "overcooked/coordination_ring": {"ppo.max_steps": 1_000_000},
        "overcooked/counter_circuit_o_1order": {
            "ppo.max_steps": 2_995_200,
            "ppo.target_score": 9.5,
            "ppo.entropy": because(0.2, f"chance must find the first soup, {_NOTES}"),
            "ppo.entropy_end": 0.1,
        },
        "rendezvous/mppmr": {"ppo.max_steps": 400_000, "ppo.target_score": because(1_000_000.0, _NEVER)},
    },
)

DEMO = Recipe(
    "demo",
    "A small population that plays, in minutes on two cores: the laptop's recipe, stopped earlier.",
    {
        "population.size": 2,
        "evaluation.episodes": 10,
        "ppo.target_score": because(9.0, "plays well enough to watch"),
    },
    {
        "overcooked/cramped_room": {"ppo.max_steps": 500_000},
        "rendezvous/mppmr": {"ppo.target_score": because(1_000_000.0, _NEVER)},
    },
    base=LAPTOP,
)

SMOKE = Recipe(
    "smoke",
    "Seconds, for tests: every code path once, nothing learned.",
    {
        "evaluation.episodes": 2,
        "evaluation.weak_share": 0.0,
        "ppo.units": 16,
        "ppo.layers": 1,
        "ppo.envs": 4,
        "ppo.steps": 20,
        "ppo.epochs": 1,
        "ppo.minibatches": 2,
        "ppo.max_steps": 240,
        "ppo.window": 4,
        "ppo.target_score": because(1_000_000.0, _NEVER),
    },
)

PAPER = Recipe(
    "paper",
    'The tables "Hyperparameters for Overcooked AI Agents (LIPO and CoMeDi)" and "for MPPMR Agents". The budget is '
    "read per kind of trajectory and predecessor. Ours are environments, steps, epochs, minibatches, clip, discount, "
    "lambda, gradient clipping and channels.",
    {
        "evaluation.episodes": ours(40),
        "ppo.view": "lossless",
        "ppo.cnn_kernels": [5, 3, 3],
        "ppo.layers": because(3, "two MLP layers and the actor's or the critic's own one"),
        "ppo.units": 512,
        "ppo.activation": "leaky_relu",
        "ppo.learning_rate": 6e-4,
        "ppo.entropy": 8e-3,
        "ppo.max_steps": ours(6_000_000, "six budgets for five layouts: what all five have in common"),
        "ppo.target_score": ours(1_000_000.0, _NEVER),
    },
    {
        "overcooked/cramped_room": {"ppo.learning_rate": 6e-4, "ppo.entropy": 3e-3},
        "overcooked/asymmetric_advantages": {"ppo.learning_rate": 1e-3, "ppo.entropy": 4e-3},
        "overcooked/coordination_ring": {"ppo.learning_rate": 8e-4, "ppo.entropy": 5e-3},
        "rendezvous/mppmr": {
            "ppo.view": "features",
            "ppo.cnn_kernels": [],
            "ppo.layers": 5,
            "ppo.max_steps": 800_000,
            "ppo.learning_rate": 5e-4,
            "ppo.entropy": 1e-4,
        },
    },
)

_DIVERSITY: Mapping[str, Settings] = {
    "laptop": {"diversity.target_xp": 2.0},
    "demo": {"diversity.target_xp": 3.0},
    "smoke": {
        "diversity.warmup": 2,
        "diversity.xp_envs": 4,
        "diversity.mp_envs": 4,
        "diversity.select_every": 2,
        "diversity.select_episodes": 1,
        "diversity.window": 4,
    },
    "paper": {
        "diversity.warmup": because(0, "the weight of cross-play from the first iteration"),
        "diversity.xp_envs": ours(64, "cross-play with each partner takes as many steps as self-play"),
        "diversity.mp_envs": ours(64),
        "diversity.partner_random": because(0.0, "the strongest partner, always"),
        "diversity.select_every": 1,
        "diversity.select_episodes": ours(8, "of 400 steps in each seating: an iteration's 6,400 steps with each"),
    },
}

_DIVERSITY_ROWS: Mapping[str, Mapping[str, Settings]] = {
    "paper": {"rendezvous/mppmr": {"diversity.select_episodes": ours(64)}},
}


def _with_diversity(own: Settings) -> dict[str, Recipe]:
    """MAPPO's recipes with those of a method that plays with other members."""
    return {
        base.name: Recipe(
            base.name,
            base.summary,
            {**own, **_DIVERSITY[base.name]},
            _DIVERSITY_ROWS.get(base.name, {}),
            base=base,
        )
        for base in RECIPES.values()
    }


def _with_pairs(own: Settings) -> dict[str, Recipe]:
    """MAPPO's recipes for pools of pairs: an even population where the schema's size is none."""
    small = {"smoke": {"hsp.pool": 2}, "demo": {"hsp.pool": 2}}
    return {
        base.name: Recipe(
            base.name,
            base.summary,
            {"population.size": _PAIRED[base.name], **own, **small.get(base.name, {})},
            base=base,
        )
        for base in RECIPES.values()
    }


def _with_crossed_pairs() -> dict[str, Recipe]:
    """MAPPO's recipes for pairs that meet each other: at least two."""
    small = {"smoke": {"brdiv.warmup": 2, "brdiv.xp_envs": 4}, "demo": {"brdiv.target_xp": 3.0}}
    return {
        base.name: Recipe(
            base.name,
            base.summary,
            {"population.size": max(4, _PAIRED[base.name]), **small.get(base.name, {})},
            base=base,
        )
        for base in RECIPES.values()
    }


_PAIRED = {"laptop": 8, "demo": 2, "paper": 8, "smoke": 2}
"""Members, two of a pair."""

RECIPES = {recipe.name: recipe for recipe in (LAPTOP, DEMO, PAPER, SMOKE)}

_ONE_SEED: Settings = {"population.size": because(3, "the members of one seed")}

FCP_RECIPES = RECIPES | {"demo": Recipe("demo", DEMO.summary, _ONE_SEED, base=DEMO)}


def _objectives(lambda_xp: float) -> dict[str, Settings]:
    """The paper's objective, and with a floor, a bound and a constraint as XPM-Sim has them."""
    names = ("diversity.xp_floor", "diversity.xp_clip", "diversity.xp_limit")
    rows = {"paper": (None, 0.0, None), "ours": (-0.9, 1.5, -45.0)}
    return {
        row: {"diversity.lambda_xp": lambda_xp, **dict(zip(names, values, strict=True))} for row, values in rows.items()
    }


LIPO_RECIPES = _with_diversity(
    {
        "diversity.order": because("concurrent", "all members together; `sequential` trains one after the other"),
        "diversity.lambda_xp": because(0.25, "the paper's"),
    }
)

COMEDI_RECIPES = _with_diversity(
    {
        "diversity.order": because("sequential", "one member after the other against frozen predecessors"),
        "diversity.lambda_xp": because(0.5, "the paper's"),
        "diversity.lambda_mp": because(0.25, "the paper's"),
    }
)

LIPO_OBJECTIVES, COMEDI_OBJECTIVES = _objectives(0.25), _objectives(0.5)
"""Rows of the table of self-sabotage."""

HSP_RECIPES = _with_pairs(
    {
        "hsp.select": because("events", "the paper's: the biased agents do different things"),
        "hsp.least_score": because(0.1, "ZSC-Eval drops pairs of HSP that deliver nothing"),
    }
)

BP_RECIPES = _with_pairs(
    {
        "hsp.select": because("responses", "ZSC-Eval's: their best responses do different things"),
        "hsp.least_score": because(0.5, "ZSC-Eval drops pairs with at most 10 points, half a dish"),
    }
)

BRDIV_RECIPES = _with_crossed_pairs()

_AFTER_SOUPS: Settings = {
    "trajedi.full_score": because(3.0, f"divergence before the first soups keeps members from them, {_GENERATORS}")
}
_AT_ONCE: Settings = {"trajedi.full_score": because(0.0, "scores are below 0 at first")}

TRAJEDI_RECIPES = RECIPES | {
    base.name: Recipe(base.name, base.summary, _AFTER_SOUPS, {"rendezvous/mppmr": _AT_ONCE}, base=base)
    for base in (LAPTOP, DEMO)
}
