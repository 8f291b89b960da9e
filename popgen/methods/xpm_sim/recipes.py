"""Recipes of XPM-Sim. Where a number was measured or argued for, its reason stands beside it."""

from __future__ import annotations

from popgen.methods.recipe import Recipe, because, ours

_NOTES = "docs/notes/xpm_sim.md"

LAPTOP = Recipe(
    "laptop",
    "Two CPU cores, minutes a member.",
    {
        "xpm_sim.updates": 100,
        "xpm_sim.entropy": 0.01,
        "xpm_sim.unroll": 100,
        "xpm_sim.xp_horizon": 100,
        "xpm_sim.restart_horizon": 50,
        "xpm_sim.lambda_xp": because(0.5, f"the paper's; {_NOTES}"),
        "xpm_sim.lambda_until": 1.0,
        "xpm_sim.xp_clip": 0.0,
    },
    {
        "overcooked/cramped_room": {
            "xpm_sim.updates": because(75, f"measured, {_NOTES}"),
            "xpm_sim.lambda_xp": because(0.75, f"with 0.5 some pairs of eight still deliver, {_NOTES}"),
        },
        "overcooked/counter_circuit_o_1order": {
            "xpm_sim.updates": 200,
            "xpm_sim.entropy": because(0.1, f"with 0.01 two of four members found no delivery, {_NOTES}"),
        },
        "rendezvous/mppmr": {
            "xpm_sim.updates": 60,
            "xpm_sim.unroll": because(50, "an episode"),
            "xpm_sim.xp_horizon": 50,
            "xpm_sim.restart_horizon": because(3, f"its steps stay at the states of cross-play, {_NOTES}"),
            "xpm_sim.restart_weight": because(0.25, f"more teaches members to follow each other, {_NOTES}"),
            "xpm_sim.xp_clip": because(1.5, f"leaving is no larger gain than another convention, {_NOTES}"),
            "xpm_sim.xp_floor": because(-0.9, f"of a step: holding to another landmark costs more, {_NOTES}"),
            "xpm_sim.lambda_xp": because(1.5, f"of all partners drawn in turn, {_NOTES}"),
            "xpm_sim.xp_limit": because(-45.0, f"two members that hold to different landmarks get less, {_NOTES}"),
        },
    },
)

DEMO = Recipe(
    "demo",
    "A population of two that plays, in minutes on two cores: the laptop's recipe for two members.",
    {"population.size": 2, "evaluation.episodes": 10},
    base=LAPTOP,
)

SMOKE = Recipe(
    "smoke",
    "Seconds, for tests: every code path once, nothing learned.",
    {
        "evaluation.episodes": 2,
        "evaluation.weak_share": 0.0,
        "xpm_sim.units": 16,
        "xpm_sim.layers": 1,
        "xpm_sim.capacity": 4000,
        "xpm_sim.recent": 2,
        "xpm_sim.episodes_sp": 2,
        "xpm_sim.episodes_xp": 2,
        "xpm_sim.updates_per_round": 2,
        "xpm_sim.updates": 4,
        "xpm_sim.horizon": 20,
        "xpm_sim.restart_horizon": 5,
        "xpm_sim.xp_horizon": 10,
        "xpm_sim.unroll": 10,
        "xpm_sim.sims_sp": 4,
        "xpm_sim.sims_restart": 4,
        "xpm_sim.sims_xp": 4,
        "xpm_sim.minibatches": 2,
        "xpm_sim.check_pairs": 4,
    },
)

PAPER = Recipe(
    "paper",
    'The table "Hyperparameters for MPPMR Agents" to the letter, its objective and its start states. Ours are '
    "discount, lambda of GAE, gradient clipping, the moving scale of returns, and advantages in units of their spread.",
    {
        "evaluation.episodes": ours(40),
        "xpm_sim.units": 512,
        "xpm_sim.layers": 5,
        "xpm_sim.activation": "leaky_relu",
        "xpm_sim.xp_critic": because("separate", "M (M + 1) / 2 critics in all"),
        "xpm_sim.capacity": 200_000,
        "xpm_sim.recent": ours(4000, "more than the buffers hold: starts are drawn evenly"),
        "xpm_sim.horizon": 30,
        "xpm_sim.restart_horizon": 30,
        "xpm_sim.xp_horizon": 30,
        "xpm_sim.unroll": 30,
        "xpm_sim.starts_initial": because(0.0, "every trajectory starts in a buffered state"),
        "xpm_sim.xp_initial": 0.0,
        "xpm_sim.surrogate": "reinforce",
        "xpm_sim.epochs": 1,
        "xpm_sim.minibatches": 1,
        "xpm_sim.learning_rate": 5e-4,
        "xpm_sim.entropy": 1e-4,
        "xpm_sim.lambda_xp": 0.5,
        "xpm_sim.lambda_ramp": 0,
        "xpm_sim.sp_weight": ours(0.5, "half of the self-play starts from B_SP, half from B_XP"),
        "xpm_sim.restart_weight": ours(0.5),
        "xpm_sim.partner": "max_window",
        "xpm_sim.partner_random": 0.0,
        "xpm_sim.sims_sp": ours(16, "8e5 simulated SP and XP steps a member, in batches of 32 trajectories"),
        "xpm_sim.sims_restart": ours(16),
        "xpm_sim.sims_xp": ours(32),
        "xpm_sim.updates": because(834, "8e5 steps, 960 an update"),
        "xpm_sim.updates_per_round": ours(10),
        "xpm_sim.episodes_sp": ours(4),
        "xpm_sim.episodes_xp": ours(4),
    },
)

OBJECTIVES = {
    "self-play": {"xpm_sim.lambda_xp": 0.0, "xpm_sim.restart_weight": 0.0, "xpm_sim.xp_floor": None},
    "paper": {
        "xpm_sim.lambda_xp": 0.5,
        "xpm_sim.lambda_until": 1.0,
        "xpm_sim.xp_clip": 0.0,
        "xpm_sim.xp_floor": None,
        "xpm_sim.xp_limit": None,
        "xpm_sim.sp_weight": 0.5,
        "xpm_sim.restart_weight": 0.5,
        "xpm_sim.restart_horizon": 30,
        "xpm_sim.partner_random": 0.0,
    },
    "ours": {
        "xpm_sim.lambda_until": 1.0,
        "xpm_sim.xp_clip": 1.5,
        "xpm_sim.xp_floor": -0.9,
        "xpm_sim.xp_limit": -45.0,
    },
}
"""Self-play alone is the control: independent seeds. `paper` is its objective, with the recipe's networks and budget;
`ours` gives cross-play's rewards a floor, bounds its advantages and makes it a constraint, as in every method with that
row."""

RECIPES = {recipe.name: recipe for recipe in (LAPTOP, DEMO, PAPER, SMOKE)}
