"""The shared encoder: its loss by hand, what it learns from, what learns from it, and how members keep it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from support.exact import filled, kitchen

from popgen.envs import make_env
from popgen.losses.autoencoder import elbo_terms
from popgen.methods.xpm_sim.agent import XpmSimLearner, make_actor
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_sim.shared_encoder import SharedEncoder
from popgen.nets.weights import weights_of
from popgen.policies.policy_registry import build_policy

CONFIG = XpmSimConfig(
    **{"encoder": "shared", "latent": 4, "encoder_units": 16, "encoder_layers": 1, "encoder_updates": 3},
    **{"units": 16, "layers": 1, "unroll": 4, "restart_horizon": 4, "xp_horizon": 4, "horizon": 8},
    **{"sims_sp": 4, "sims_restart": 2, "sims_xp": 2, "minibatches": 2, "encoder_batch": 16},
)


def test_terms_by_hand() -> None:
    mean, log_variance = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, math.log(4.0)]])
    outputs, target = torch.tensor([[1.0, -2.0]]), torch.tensor([[0.0, -1.0]])
    error, divergence = elbo_terms(outputs, target, mean, log_variance, binary=False)
    assert float(error) == 1.0  # (1 + 1) / 2
    # (1 + 1 - 1 - 0) / 2 + (0 + 4 - 1 - ln 4) / 2
    assert float(divergence) == pytest.approx(0.5 + 1.5 - math.log(2.0))
    error, _ = elbo_terms(torch.tensor([[0.0, 0.0]]), torch.tensor([[1.0, 0.0]]), mean, log_variance, binary=True)
    assert float(error) == pytest.approx(2 * math.log(2.0))


def test_it_learns_to_reconstruct_buffered_states() -> None:
    env = make_env("rendezvous/mppmr", 4)
    starts = filled(env, CONFIG)
    encoder = SharedEncoder(CONFIG.model_copy(update={"encoder_lr": 0.01}), env.spec, 1, 0)
    errors = [encoder.update(starts)["encoder_reconstruction"] for _ in range(40)]
    assert np.mean(errors[-5:]) < 0.5 * np.mean(errors[:5])


def test_later_members_can_keep_it_frozen() -> None:
    env = kitchen()
    frozen = SharedEncoder(CONFIG.model_copy(update={"encoder_lr_later": 0.0}), env.spec, 2, 0)
    before = weights_of(frozen.vae)
    assert frozen.update(filled(env)) == {}
    assert all(np.array_equal(before[name], value) for name, value in weights_of(frozen.vae).items())
    assert SharedEncoder(CONFIG.model_copy(update={"encoder_lr_later": 0.0}), env.spec, 1, 0).update(filled(env))


def test_the_policy_gradient_does_not_reach_the_encoder_and_members_keep_a_copy() -> None:
    env = kitchen()
    first = XpmSimLearner(CONFIG, env, 1, 0, {})
    first.starts = first.simulator.starts = filled(env, CONFIG)
    encoder = first.encoder
    assert encoder is not None
    encoder.rate = 0.0  # leaves the policy gradient alone
    before = weights_of(encoder.vae), weights_of(first.actor.net.head)
    first.update()
    assert all(np.array_equal(before[0][name], value) for name, value in weights_of(encoder.vae).items())
    assert any(not np.array_equal(before[1][k], v) for k, v in weights_of(first.actor.net.head).items())
    archived = first.actor.weights()

    second = XpmSimLearner(CONFIG, env, 2, 1, {1: archived}, encoder.state())
    second.starts = second.simulator.starts = filled(env, CONFIG)
    assert all(np.array_equal(archived[k], v) for k, v in second.actor.weights().items() if k.startswith("encoder."))
    second.update()
    own, partner = second.actor.weights(), weights_of(second.partners[1].net)
    assert all(np.array_equal(archived[k], partner[k]) for k in archived)
    assert any(not np.array_equal(archived[k], own[k]) for k in archived if k.startswith("encoder."))
    copy = XpmSimLearner(CONFIG, env, 2, 5, {1: archived}, encoder.state())
    copy.load_state(second.state())
    assert copy.update() == second.update()


def test_a_saved_policy_acts_the_same() -> None:
    env = kitchen()
    policy = make_actor(CONFIG, env.spec, 3)
    again = build_policy(policy.kind, policy.config(), policy.weights(), env.spec)
    first = np.ones(4, bool)
    for one in (policy, again):
        one.reset(4, 7)
    given = env.observe(), np.zeros((4, 2), np.uint8), first
    np.testing.assert_array_equal(policy.act(*given), again.act(*given))
    assert policy.kind == "encoded"
