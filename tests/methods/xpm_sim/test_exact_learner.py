"""One member's learner: signs, which critic learns from what, partners, budget of a batch, going on from a state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.exact import kitchen, segment

from popgen.envs import BatchedEnv, make_env
from popgen.methods.xpm_sim.agent import XpmSimLearner, make_actor, self_play_target
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_sim.critics import SELF, SHARED
from popgen.methods.xpm_sim.restart_check import restart_check
from popgen.methods.xpm_sim.simulation import Partner
from popgen.nets.weights import weights_of
from popgen.types import Weights

SMALL = XpmSimConfig(
    units=16,
    layers=1,
    horizon=8,
    restart_horizon=4,
    xp_horizon=4,
    unroll=6,
    sims_sp=4,
    sims_restart=4,
    sims_xp=4,
    epochs=2,
    minibatches=2,
    partner_random=0.0,
    recent=2,
    check_pairs=6,
)


def learner(env: BatchedEnv | None = None, partners: int = 2, seed: int = 0, **changes: Any) -> XpmSimLearner:
    """Of member `partners + 1`, with some random real play in its buffers."""
    env = env or kitchen()
    config = XpmSimConfig.model_validate({**SMALL.model_dump(), **changes})
    member = partners + 1
    known = {k: make_actor(config, env.spec, 100 + k).weights() for k in range(1, member)}
    made = XpmSimLearner(config, env, member, seed, known)
    rng = np.random.default_rng(7)
    pairs = [(member, member), *((member, k) for k in known), *((k, member) for k in known)]
    made.starts.add([segment(env, pair, rng, 30, number) for number, pair in enumerate(pairs)])
    made.partner_scores = {k: float(k) for k in known}
    return made


def same(first: Weights, second: Weights) -> bool:
    return all(np.array_equal(first[name], second[name]) for name in first)


def test_cross_play_lowers_what_earns_with_the_partner_and_self_play_raises_it() -> None:
    """With one critic value everywhere, an action's advantage is its reward."""
    env = kitchen()
    for group in ("sp", "xp"):
        made = learner(env, 1, surrogate="reinforce", epochs=1, minibatches=1, lam=0.0, discount=0.0, entropy=0.0)
        batch = made.simulator.run(made.batch_columns(1), made.actor.net, Partner(1, made.partners[1].net))
        rewarded = torch.zeros_like(batch.reward)
        layout = batch.columns
        columns = layout.self_play if group == "sp" else layout.cross_play
        rewarded[:, columns] = (batch.actions[:, columns, 0] == 2).float()  # seat 0 is rewarded for east
        batch = type(batch)(**{**vars(batch), "reward": rewarded})
        for critic in made.critics.values():
            torch.nn.init.zeros_(critic[-1].weight)
            torch.nn.init.zeros_(critic[-1].bias)
        target = self_play_target(made.config, batch, made.evaluator.evaluate_self_play(batch))
        metrics = target.figures
        chosen = target if group == "sp" else made.cross_play(batch, 1, 1.0)
        actions = chosen.parts[0].actions
        mine = actions.seat == 0
        east = actions.advantage[mine & (actions.action == 2)]
        other = actions.advantage[mine & (actions.action != 2)]
        assert len(east) and len(other)
        if group == "sp":
            assert east.min() > other.max() and metrics["advantage_sp"] > 0
        else:
            assert east.max() < other.min()
            torch.testing.assert_close(other[0] - east[0], torch.tensor(made.lambda_now()))


def test_a_large_loss_in_cross_play_gains_no_more_than_the_bound() -> None:
    gains = []
    for clip in (0.0, 1.0):
        made = learner(partners=1, lambda_xp=1.0, lambda_ramp=0, xp_clip=clip, lam=0.0, discount=0.0)
        batch = made.simulator.run(made.batch_columns(1), made.actor.net, Partner(1, made.partners[1].net))
        reward = torch.zeros_like(batch.reward)
        reward[0, batch.columns.cross_play.start] = -500.0
        batch = type(batch)(**{**vars(batch), "reward": reward})
        signed = made.cross_play(batch, 1, 2.0).parts[0].actions.advantage
        gains.append(float(signed.max() - signed.median()))
    assert gains[0] > 200.0 and gains[1] < 2.0


def test_lambda_rises_over_the_ramp() -> None:
    made = learner(lambda_xp=0.5, lambda_ramp=4)
    seen = []
    for made.updates in range(6):
        seen.append(made.lambda_now())
    assert seen == [0.125, 0.25, 0.375, 0.5, 0.5, 0.5]
    assert learner(lambda_xp=0.5, lambda_ramp=0).lambda_now() == 0.5


def test_pressure_can_end_before_training_does() -> None:
    made = learner(lambda_xp=0.5, lambda_ramp=0, lambda_until=0.4, updates=10)
    assert [made.lambda_now() for made.updates in (0, 3, 4, 9)] == [0.5, 0.5, 0.0, 0.0]
    assert made.choose_partner() is None  # at update 9: only self-play, restarted from B_XP too
    assert made.batch_columns(None).restart == SMALL.sims_restart


def test_the_strongest_partner_is_chosen_and_unseen_ones_first() -> None:
    made = learner(partners=3)
    assert made.choose_partner() == 3
    made.partner_scores = {1: 5.0, 2: 1.0, 3: 2.0}
    assert made.choose_partner() == 1
    made.partner_scores = {1: 5.0, 3: 2.0}
    assert made.choose_partner() == 2
    at_random = learner(partners=3, partner_random=1.0)
    assert {at_random.choose_partner() for _ in range(40)} == {1, 2, 3}
    assert learner(lambda_xp=0.0).choose_partner() is None
    assert learner(partners=0).choose_partner() is None


@pytest.mark.parametrize("kind", ["shared", "separate"])
def test_each_critic_learns_from_its_own_trajectories(kind: str) -> None:
    made = learner(partners=2, xp_critic=kind)
    assert set(made.critics) == ({SELF, SHARED} if kind == "shared" else {SELF, "1", "2"})
    before = {key: weights_of(critic) for key, critic in made.critics.items()}
    made.update()  # against partner 2
    after = {key: weights_of(critic) for key, critic in made.critics.items()}
    changed = {key for key in before if not same(before[key], after[key])}
    assert changed == ({SELF, SHARED} if kind == "shared" else {SELF, "2"})
    frozen = make_actor(made.config, made.env.spec, 102).weights()
    assert same(weights_of(made.partners[2].net), frozen)


def test_without_cross_play_only_self_play_is_simulated() -> None:
    made = learner(lambda_xp=0.0)
    figures = made.update()
    assert "simulated_reward_restart" in figures and not any(name.endswith("_xp") for name in figures)
    assert made.simulated == SMALL.unroll * (SMALL.sims_sp + SMALL.sims_restart)
    first = learner(partners=0)
    assert "simulated_reward_restart" not in first.update()
    assert first.simulated == SMALL.unroll * SMALL.sims_sp


def test_a_batch_does_not_grow_with_the_number_of_partners() -> None:
    steps = []
    for partners in (1, 4):
        made = learner(partners=partners)
        made.update()
        steps.append(made.simulated)
    assert steps[0] == steps[1] == SMALL.unroll * 12


def test_without_a_bound_gradients_are_as_they_are() -> None:
    free, wide = learner(grad_clip=0.0), learner(grad_clip=1e9)
    before = free.actor.weights()
    assert free.update() == wide.update()
    assert same(free.actor.weights(), wide.actor.weights()) and not same(free.actor.weights(), before)


def test_no_weight_no_restarted_trajectories() -> None:
    made = learner(restart_weight=0.0)
    assert made.batch_columns(1).restart == 0
    assert "simulated_reward_restart" not in made.update()


def test_going_on_from_a_state_gives_the_same_member() -> None:
    whole = learner(seed=3)
    whole.update()
    saved = whole.state()
    expected = whole.update()
    other = learner(seed=4)
    other.load_state(saved)
    other.partners = whole.partners
    assert other.update() == expected
    assert same(other.actor.weights(), whole.actor.weights())
    assert (other.updates, other.simulated) == (2, whole.simulated)


def test_another_seed_gives_another_member() -> None:
    first, second = learner(seed=1), learner(seed=2)
    assert first.update() != second.update()
    assert learner(seed=1).update() == learner(seed=1).update()


def test_reinforce_refuses_several_steps_per_batch() -> None:
    with pytest.raises(ValueError, match="reinforce"):
        XpmSimConfig(surrogate="reinforce")
    with pytest.raises(ValueError, match="unroll"):
        XpmSimConfig(unroll=20)


@pytest.mark.parametrize("surrogate", ["ppo", "reinforce"])
def test_self_play_learns_to_meet(surrogate: str) -> None:
    """Two point masses: the reward per episode rises clearly."""
    env = make_env("rendezvous/mppmr", 8, horizon=10)
    steps = {"epochs": 1, "minibatches": 1} if surrogate == "reinforce" else {}
    changes = {"unroll": 10, "horizon": 10, "sims_sp": 32, "learning_rate": 0.01, "surrogate": surrogate, **steps}
    made = learner(env, 0, **changes)
    rewards = [made.update()["simulated_reward_sp"] for _ in range(25)]
    assert np.mean(rewards[-5:]) > np.mean(rewards[:5]) + 1.0


def test_the_check_compares_equal_times_and_counts_its_steps() -> None:
    made = learner(partners=1)
    figures, steps = restart_check(made, 6)
    half = made.env.spec.horizon // 2
    assert steps == 2 * 6 * half and set(figures) <= {"score_sp", "score_restart", "restart_ratio"}
    alone = learner(partners=0)
    figures, steps = restart_check(alone, 6)
    assert set(figures) == {"score_sp"} and steps == 6 * half
