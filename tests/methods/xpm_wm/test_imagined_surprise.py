"""MEP's reward in imagination: against brute force, and nothing is left of it where it weighs nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from support.small import AGENT, MODEL, kitchen, random_latent

from popgen.methods.xpm_wm.actor_critic import Actor
from popgen.methods.xpm_wm.agent import AgentLearner, find_bonuses
from popgen.methods.xpm_wm.imagination import OLD, Imagined
from popgen.methods.xpm_wm.imagined_surprise import joint_log_probs, surprise_bonus
from popgen.methods.xpm_wm.world_model import Starts, WorldModel
from popgen.nets import weights as w

SPEC = kitchen().spec
MEMBERS, STEPS, COLUMNS, ACTIONS = 3, 10, 2, SPEC.num_actions
FLOOR = 0.05
ALONE = {"lambda_xp": 0.0, "epochs": 1, "minibatches": 2}


def make_actor(seed: int, loud: float = 3.0) -> Actor:
    """An actor with opinions: its last layer is scaled up."""
    torch.manual_seed(seed)
    actor = Actor(AGENT, MODEL, ACTIONS)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(loud)
    return actor


def make_learner(partners: tuple[int, ...], **changes: Any) -> AgentLearner:
    learner = AgentLearner(AGENT.model_copy(update={**ALONE, **changes}), MODEL, SPEC, member=3, seed=0)
    for partner in partners:
        learner.add_partner(partner, w.weights_of(make_actor(partner)))
    rng = np.random.default_rng(0)
    h = rng.normal(size=(40, MODEL.deter)).astype(np.float32)
    z = rng.integers(0, MODEL.classes, (40, MODEL.groups)).astype(np.uint8)
    learner.set_starts(Starts(h, z, np.full(40, OLD, np.uint8), np.zeros(40, np.int16)), 0.0)
    torch.manual_seed(5)
    learner.set_model(w.weights_of(WorldModel(MODEL, SPEC)))
    return learner


def imagined_play(steps: int = STEPS, columns: int = COLUMNS) -> Imagined:
    actions = torch.randint(0, ACTIONS, (steps, columns, 2), generator=torch.Generator().manual_seed(3))
    ones = torch.ones(steps, columns)
    return Imagined(random_latent(steps + 1, columns), actions, ones, 0.9 * ones, ones)


def test_the_bonus_is_the_surprise_of_all_members_at_both_seats_actions() -> None:
    """Three members, ten steps: one state, one seat, one member at a time; the action of a step in the state before."""
    actors, imagined = [make_actor(seed, 30.0) for seed in range(MEMBERS)], imagined_play()
    config = AGENT.model_copy(update={"surprise": 0.3, "surprise_floor": FLOOR})
    found, bounded = surprise_bonus(config, actors, imagined), 0
    for t in range(STEPS):
        for column in range(COLUMNS):
            expected = 0.0
            for seat in range(2):
                state, action = imagined.latent[t, column], int(imagined.actions[t, column, seat])
                asked = [actor.log_probs(state, torch.tensor(seat))[action].detach() for actor in actors]
                probs = [math.exp(float(log_prob)) for log_prob in asked]
                mean = sum(probs) / MEMBERS
                bounded += mean < FLOOR
                expected += 0.3 * -math.log(max(mean, FLOOR))
            assert float(found[t, column]) == pytest.approx(expected, abs=1e-6)
    assert 0 < bounded < 2 * STEPS * COLUMNS  # the floor is met, and not everywhere


def test_each_member_is_asked_for_every_seats_action() -> None:
    found = joint_log_probs([make_actor(seed) for seed in range(MEMBERS)], imagined_play())
    assert found.shape == (MEMBERS, STEPS, COLUMNS, 2) and found.dtype == torch.float32
    assert len(torch.unique(found[:, 0, 0, 0])) == MEMBERS


def test_a_weight_of_zero_is_self_play_alone_bit_for_bit() -> None:
    plain, weightless, paid = make_learner(()), make_learner((1, 2), surprise=0.0), make_learner((1, 2), surprise=0.1)
    for _ in range(2):
        figures = [learner.update() for learner in (plain, weightless, paid)]
    assert figures[0] == figures[1] and "surprise_bonus" not in figures[1] and figures[2]["surprise_bonus"] > 0.0
    for name, value in w.weights_of(plain.networks.actor).items():
        assert np.array_equal(value, w.weights_of(weightless.networks.actor)[name])
        assert np.array_equal(plain.state()["critics"][f"0.{name}"], weightless.state()["critics"][f"0.{name}"])
    actors = [w.weights_of(learner.networks.actor) for learner in (plain, paid)]
    assert any(not np.array_equal(value, actors[1][name]) for name, value in actors[0].items())


def test_without_predecessors_nobody_is_surprised() -> None:
    """Member 1 is trained as in XPM-WM."""
    learner = make_learner((), surprise=0.1)
    assert find_bonuses(learner, imagined_play()) == {} and "surprise_bonus" not in learner.update()


def test_what_the_predecessors_do_is_done_less() -> None:
    """Nothing else is paid, and the predecessors always take action 2."""
    learner = make_learner((1, 2), surprise=1.0, entropy=0.0, starts_sp=64, actor_lr=1e-2, horizon=5, minibatches=4)
    for partner in learner.partners.values():
        last = [module for module in partner.net.modules() if isinstance(module, torch.nn.Linear)][-1]
        with torch.no_grad():
            last.weight.zero_()
            last.bias.copy_(8.0 * torch.eye(ACTIONS)[2])
    states, seats = random_latent(200, seed=9), torch.zeros(200, dtype=torch.int64)
    for _ in range(15):
        learner.update()
    mean = learner.actor.log_probs(states, seats).detach().exp().mean(0)
    assert float(mean[2]) < 0.5 / ACTIONS


def test_the_reward_itself_is_told_apart_from_the_bonus() -> None:
    learner, imagined = make_learner((1, 2), surprise=0.1), imagined_play()
    figures = learner.self_play(imagined).figures
    assert figures["imagined_shaped_sp"] == pytest.approx(1.0)
    bonus = surprise_bonus(learner.config, [*learner.partners.values(), learner.networks.rollout_actor], imagined)
    assert figures["surprise_bonus"] == pytest.approx(float(bonus.mean()))
