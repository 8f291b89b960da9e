"""Recipes of XPM-WM. Where a number was measured or argued for, its reason stands beside it."""

from __future__ import annotations

from collections.abc import Mapping

from popgen.methods.recipe import Recipe, Settings, because, ours

_CHANCE = "chance must find the first soups, and better ways later (docs/notes/learning.md, More chance)"
_FORCED = "docs/notes/learning.md, Later members in forced_coordination"
_CRAMPED = f"its populations of eight were trained so ({_FORCED})"
_FALSE_DELIVERIES = "imagined deliveries must not outnumber real ones (docs/notes/learning.md, The counter circuit)"
_MADE_UP = "made-up deliveries are not worth having (docs/notes/learning.md, A delivery in every step)"
_NO_LIMIT = because(0.0, "its published populations were trained without; to be trained anew")
_DREAMER = "DreamerV3's (Hafner et al. 2025), which the paper builds on; its table has none"
_NEVER = "never reached: the table's steps are what is run"

LAPTOP = Recipe(
    "laptop",
    "Two CPU cores, minutes a member.",
    {
        "phase1.prefill_steps": because(
            400_000,
            "random play delivers two soups there by then (docs/notes/learning.md, Forced coordination)",
        ),
        "phase1.max_steps": because(1_600_000, "a budget: the plateau ends member 1 before, where it plays"),
        "phase1.target_score": because(10.0, "half of it tells that self-play has begun; the plateau ends the phase"),
        "phase1.plateau": because(10, "member 1 learns until it gains no more; self-play is what populations are for"),
        "phase1.model_updates": because(40, "the model learns more from the few soups that there are"),
        "agent.entropy": because(0.04, _CHANCE),
        "phase2.entropy": because(
            0.02, "the model has seen soups by then (docs/notes/learning.md, What holds later members back)"
        ),
        "phase2.partner_fits": because(
            100, "partners are themselves on the latents (docs/notes/learning.md, What holds later members back)"
        ),
        "phase2.first_updates": because(200, "self-play begins a round or two sooner"),
        "phase2.starts_new": because(0.8, "it plays better, and more slowly: more of its own states"),
        "phase2.discount": because(0.97, f"with 0.99 its values run away ({_FORCED})"),
        "phase2.rounds": because(14, "they are at two thirds of their dishes after eight rounds, at all after twelve"),
        "phase2.max_rounds": because(16, "a member that is still weak by then gets some more"),
        "phase2.plateau": because(2, "so does one that still improves"),
        "phase2.pay_limit": because(1.25, _MADE_UP),
        "phase2.model_lag": because(1, "the second core works (docs/notes/learning.md, A model that lags)"),
    },
    {
        "overcooked/cramped_room": {
            "phase1.prefill_steps": because(256_000, "random play finds soups here"),
            "phase1.max_steps": 680_000,
            "phase1.target_score": 10.5,
            "phase2.first_updates": because(100, _CRAMPED),
            "phase2.starts_new": because(0.5, _CRAMPED),
            "phase2.discount": because(None, _CRAMPED),
            "phase2.pay_limit": _NO_LIMIT,
            "phase2.rounds": because(8, "members are at 10 dishes by then"),
            "phase2.max_rounds": 9,
        },
        "overcooked/coordination_ring": {
            "phase2.pay_limit": _NO_LIMIT,
            "phase2.model_lag": because(0, "measured so (docs/notes/learning.md, What holds later members back)"),
        },
        "overcooked/forced_coordination": {
            "phase2.model_lag": because(0, f"measured so ({_FORCED})"),
        },
        "overcooked/counter_circuit_o_1order": {
            "world_model.batch": because(32, "more and smaller updates know the kitchen sooner"),
            "agent.discount": because(0.97, "with 0.99 values at the end of imagination run away"),
            "agent.advantage_clip": because(5.0, "the first deliveries would inflate the unit of all advantages"),
            "agent.entropy": because(0.08, "at less, roles settle before soups are carried to the counter"),
            "agent.entropy_end": 0.02,
            "phase2.entropy": because(None, "as member 1's, for the same reason; not measured"),
            "replay.event_fraction": because(0.25, "few windows repeated often are believed"),
            "phase1.pretrain_updates": 3000,
            "phase1.steps_per_iteration": 200,
            "phase1.model_updates": because(120, _FALSE_DELIVERIES),
            "phase1.agent_updates": 7,
            "phase1.event_starts": "always",
            "phase1.max_steps": 3_200_000,
            "phase1.plateau": because(15, "the target is not reached: rounds of 12,800 steps without a gain end it"),
            "discovery.count_bonus": because(1.0, "carries soups across the border between the players' roles"),
            "discovery.trust": because(2.0, _FALSE_DELIVERIES),
            "discovery.rare_events": 300,
            "discovery.found_events": because(500, "some hundred deliveries, from which the model learns the rest"),
            "discovery.found_entropy": 0.03,
            "discovery.event_factors": because(
                {"takes_ingredient": 0.2, "takes_dish": 0.2}, "counters are near: pick-ups alone would be farmed"
            ),
            "discovery.scaffolds": because(
                {"takes_ingredient": "pots_ingredient", "takes_dish": "takes_soup"},
                "with both pots full, onions would fill the hands that dishes need (docs/notes/learning.md, Scaffolds)",
            ),
        },
    },
)

DEMO = Recipe(
    "demo",
    "A small population that plays, in minutes on two cores: the laptop's recipe, stopped earlier.",
    {
        "population.size": 2,
        "evaluation.episodes": 10,
        "phase1.target_score": because(9.0, "plays well enough to watch"),
        "phase1.plateau": because(0, "stops there"),
        "phase2.rounds": 4,
        "phase2.max_rounds": 5,
        "phase2.plateau": 0,
        "phase2.model_lag": because(0, "four rounds are too few to lose one"),
        "phase2.target_score": 5.0,
    },
    {"overcooked/cramped_room": {"phase1.max_steps": 600_000}},
    base=LAPTOP,
)

SMOKE = Recipe(
    "smoke",
    "Seconds, for tests: every code path once, nothing learned.",
    {
        "world_model.encoder_layers": 1,
        "world_model.decoder_layers": 1,
        "world_model.units": 16,
        "world_model.deter": 16,
        "world_model.recurrent_units": 16,
        "world_model.head_layers": 1,
        "world_model.groups": 4,
        "world_model.joint_groups": 2,
        "world_model.classes": 4,
        "world_model.batch": 8,
        "world_model.length": 4,
        "agent.units": 16,
        "agent.layers": 1,
        "agent.horizon": 4,
        "agent.starts_sp": 8,
        "agent.starts_xp": 8,
        "agent.bins": 15,
        "replay.capacity": 20_000,
        "phase1.envs": 4,
        "phase1.prefill_steps": 1600,
        "phase1.pretrain_updates": 2,
        "phase1.steps_per_iteration": 50,
        "phase1.model_updates": 2,
        "phase1.agent_updates": 2,
        "phase1.max_steps": 2400,
        "phase1.check_every": 2,
        "phase2.first_updates": 2,
        "phase2.updates_per_round": 2,
        "phase2.model_updates": 2,
        "phase2.episodes_sp": 2,
        "phase2.episodes_xp": 2,
        "phase2.rounds": 1,
        "phase2.max_rounds": 1,
        "phase2.cache": 64,
        "evaluation.episodes": 2,
        "evaluation.weak_share": because(0.0, "nobody plays"),
    },
)

PAPER = Recipe(
    "paper",
    'The table "Hyperparameters for XPM-WM on Overcooked AI Layout" to the letter, its objective and algorithm 1. '
    "Beside it DreamerV3's numbers where that has some; what is not set here keeps the schema's default and is ours; "
    "events count at dispensers and pots only (ours, since pick-ups from counters can be farmed): the table's are "
    "env.params.events=raw.",
    {
        "world_model.view": "lossless",
        "world_model.imagination": "sample",
        "world_model.cnn_kernels": [5, 3, 3],
        "world_model.encoder_layers": 3,
        "world_model.decoder_layers": 3,
        "world_model.units": 512,
        "world_model.deter": 512,
        "world_model.recurrent_units": ours(512, "the layer before the GRU"),
        "world_model.prior_layers": 2,
        "world_model.posterior_layers": 2,
        "world_model.head_layers": 5,
        "world_model.groups": ours(32, '"joint 28, agent specific 4": 28 groups and 2 a player (36 if 4 for each)'),
        "world_model.joint_groups": 28,
        "world_model.classes": 32,
        "world_model.activation": "leaky_relu",
        "world_model.learning_rate": 2e-4,
        "world_model.event_scale": because(1.0, "the terms of the loss are summed"),
        "world_model.continue_scale": 1.0,
        "world_model.kl_dyn": because(1.0, _DREAMER),
        "world_model.kl_rep": because(0.1, _DREAMER),
        "world_model.free_nats": because(1.0, _DREAMER),
        "world_model.batch": ours(22, "windows of as many states as DreamerV3's 16 of 64"),
        "world_model.length": ours(46, "DreamerV3's 64 do not fit into the update interval of 50 steps"),
        "world_model.kl_predecessors": ours(1.0, "the paper's gamma has no value in the table"),
        "world_model.predecessors": ours("partner", "of the partner that the window was played with"),
        "agent.units": 512,
        "agent.layers": 5,
        "agent.activation": "leaky_relu",
        "agent.actor_input": ours("model", "h beside z^i, as the decoder's"),
        "agent.horizon": 15,
        "agent.bins": because(255, _DREAMER),
        "agent.discount": because(0.997, _DREAMER),
        "agent.lam": because(0.95, _DREAMER),
        "agent.actor_lr": 4e-5,
        "agent.critic_lr": 1e-4,
        "agent.entropy": 0.03,
        "agent.entropy_ramp": because(0, "the same throughout"),
        "agent.surrogate": "reinforce",
        "agent.epochs": 1,
        "agent.minibatches": 1,
        "agent.advantage_unit": "returns",
        "agent.adam_eps": 1e-8,
        "agent.grad_clip": 100.0,
        "agent.slow_critic": 0.98,
        "agent.lambda_xp": 0.25,
        "agent.lambda_ramp": because(0, "lambda_XP from the first update"),
        "agent.sp_from_xp": ours(0.5, "half of the self-play starts from B_SP, half from B_XP"),
        "agent.xp_starts": ours("partner", "states recorded with that partner"),
        "agent.partner": because("max_window", "the strongest by each partner's latest episodes, always"),
        "agent.partner_random": 0.0,
        "replay.capacity": 1_000_000,
        "replay.event_fraction": because(0.0, "windows are drawn evenly"),
        "phase1.steps_per_iteration": ours(50, '"update interval", read as steps of each environment'),
        "phase1.model_updates": ours(25, "C, in every round"),
        "phase1.agent_updates": 25,
        "phase1.event_starts": "always",
        "phase1.prefill_interact": ours(0.0, "K random episodes play all actions alike"),
        "phase1.prefill_steps": ours(256_000, "K has no value in the table"),
        "phase1.pretrain_updates": because(1, "algorithm 1 has none; one fills the states to start from"),
        "phase1.recent_fraction": 0.0,
        "phase1.max_steps": 80_000_000,
        "phase1.target_score": ours(1000.0, _NEVER),
        "phase1.patience": ours(1_000_000),
        "phase2.max_steps": 4_000_000,
        "phase2.rounds": ours(1_000_000, "the steps end the phase"),
        "phase2.max_rounds": 1,
        "phase2.model_lr": 2e-4,
        "phase2.new_fraction": ours(
            1.0,
            "both buffers are this member's own; before its first real episodes, imagination starts from the late data "
            "of the earlier members (algorithm 1 plays K random episodes for each, which would cost environment steps)",
        ),
        "phase2.starts_new": 1.0,
        "phase2.starts_random": 0.0,
        "phase2.starts_event": 0.0,
        "phase2.first_updates": ours(200, "a round is whole episodes: eight update intervals of 50 steps"),
        "phase2.updates_per_round": ours(200, "the updates of phase 1 for each interval"),
        "phase2.model_updates": ours(200, "the updates of phase 1 for each interval"),
        "evaluation.episodes": ours(40),
    },
    {
        "overcooked/cramped_room": {"phase1.max_steps": 20_000_000, "phase2.max_steps": 2_000_000},
        "overcooked/asymmetric_advantages": {"phase1.max_steps": 60_000_000, "phase2.max_steps": 2_000_000},
        "overcooked/coordination_ring": {"phase1.max_steps": 60_000_000, "phase2.max_steps": 3_000_000},
        "overcooked/forced_coordination": {"phase1.max_steps": 50_000_000, "phase2.max_steps": 4_000_000},
        "overcooked/counter_circuit_o_1order": {"agent.lambda_xp": 0.1},
    },
)

RECIPES = {recipe.name: recipe for recipe in (LAPTOP, DEMO, PAPER, SMOKE)}


_ALONE: Settings = {
    "agent.lambda_xp": because(0.0, "members differ by their seeds, as in the method without a model"),
    "agent.sp_from_xp": because(0.0, "there are no cross-play states of their own"),
    "phase2.episodes_xp": because(0, "nobody is met"),
}
"""Later members that learn by self-play alone."""

_UNTIL_TARGET: Settings = {
    "phase2.first_updates": because(40, "policies of several skills are seen on the way"),
    "phase2.updates_per_round": 30,
    "phase2.rounds": because(1, "a member ends at the target, as one on MAPPO does"),
    "phase2.max_rounds": 24,
    "phase2.plateau": 0,
    "phase2.model_lag": because(0, "few short rounds: none is to be lost"),
    "phase2.target_score": 10.0,
}
"""On the laptop: shorter rounds, and an end at the score that ends the model-free method."""

_SIZED: Mapping[str, Settings] = {
    "laptop": _UNTIL_TARGET,
    "demo": {**_UNTIL_TARGET, "phase2.max_rounds": 8, "phase2.target_score": 5.0},
}
_TARGETS: Mapping[str, Settings] = {
    "overcooked/cramped_room": {"phase2.target_score": 10.5},
    "overcooked/counter_circuit_o_1order": {"phase2.target_score": because(8.0, "the target 10 is not reached")},
}


def _without_partners(own: Settings) -> dict[str, Recipe]:
    """XPM-WM's recipes for later members that meet nobody."""
    return {
        base.name: Recipe(
            base.name,
            base.summary,
            {**_ALONE, **_SIZED.get(base.name, {}), **own},
            _TARGETS if base is LAPTOP else {},
            base=base,
        )
        for base in RECIPES.values()
    }


FCP_RECIPES = _without_partners({"population.size": because(4, "member 1, and the three of one seed")})

MEP_RECIPES = _without_partners({"agent.surprise": because(0.01, "the paper's alpha")})
