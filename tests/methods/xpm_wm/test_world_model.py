from __future__ import annotations

import numpy as np
import pytest
import torch
from support.small import MODEL, PRIVATE, kitchen, random_latent, random_windows, with_other_group
from torch import Tensor

from popgen.methods.xpm_wm.config import WorldModelConfig
from popgen.methods.xpm_wm.latent_filter import Latent
from popgen.methods.xpm_wm.world_model import WorldModel

SPEC = kitchen().spec


def make_model(config: WorldModelConfig = MODEL, seed: int = 0) -> WorldModel:
    torch.manual_seed(seed)
    return WorldModel(config, SPEC)


def window(count: int, length: int, seed: int = 0, view: str = "features") -> tuple[Tensor, Tensor, Tensor]:
    """obs, actions and is_first, time first, of random play."""
    given = random_windows(count, length, view=view, seed=seed)
    return tuple(
        torch.from_numpy(np.ascontiguousarray(x.swapaxes(0, 1))) for x in (given.obs, given.actions, given.is_first)
    )


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("player", [0, 1])
def test_a_players_decoder_sees_the_joint_groups_and_its_own_only(player: int) -> None:
    model, latent = make_model(), random_latent(3, 4)
    before = model.decode(latent)
    assert before.shape == (3, 4, 2, *SPEC.views["features"].shape)
    for group in range(MODEL.groups):
        after = model.decode(with_other_group(latent, group))
        assert torch.equal(after[:, :, player], before[:, :, player]) == (group in PRIVATE[1 - player])


def test_the_encoder_is_joint() -> None:
    model = make_model()
    obs = torch.rand(1, 2, *SPEC.views["features"].shape)
    h = torch.zeros(1, MODEL.deter)
    before = model.filter.posterior(h, model.filter.encoder(obs))
    for player in (0, 1):
        other = obs.clone()
        other[:, player] = 1.0 - other[:, player]
        changed = (model.filter.posterior(h, model.filter.encoder(other)) != before).any(-2)
        assert changed.all(), "every group, private or not, is inferred from both observations"


def test_both_players_actions_enter_the_transition_and_a_negative_action_is_none() -> None:
    model, latent = make_model(), random_latent(1)

    def h(*actions: int) -> Tensor:
        return model.filter.transition(latent, torch.tensor([actions]))

    outcomes = [h(0, 0), h(1, 0), h(0, 1), h(-1, -1), h(5, 5)]
    assert all(not torch.equal(a, b) for i, a in enumerate(outcomes) for b in outcomes[:i])
    assert torch.equal(h(-1, -1), h(-7, -3))


def test_a_reset_makes_two_windows_of_one() -> None:
    model = make_model()
    obs, actions, is_first = window(3, 7)
    obs = model.filter.scaled(obs)
    is_first[4] = True
    joined = model.observe(obs, actions, is_first, generator())
    state = generator()
    parts = [model.observe(obs[span], actions[span], is_first[span], state) for span in (slice(0, 4), slice(4, 7))]
    for name in ("posterior", "prior"):
        torch.testing.assert_close(getattr(joined, name), torch.cat([getattr(part, name) for part in parts]))
    torch.testing.assert_close(joined.latent.h, torch.cat([part.latent.h for part in parts]))


def test_the_action_before_a_reset_is_not_seen() -> None:
    model = make_model()
    obs, actions, is_first = window(3, 6)
    obs = model.filter.scaled(obs)
    is_first[3, 1] = True
    before = model.observe(obs, actions, is_first, generator()).latent.h
    other = actions.clone()
    other[0] = (other[0] + 1) % SPEC.num_actions
    other[3, 1] = (other[3, 1] + 1) % SPEC.num_actions
    assert torch.equal(model.observe(obs, other, is_first, generator()).latent.h, before)
    other[3, 0] = (other[3, 0] + 1) % SPEC.num_actions
    after = model.observe(obs, other, is_first, generator()).latent.h
    assert torch.equal(after[:3], before[:3]) and torch.equal(after[:, 1:], before[:, 1:])
    assert not torch.equal(after[3, 0], before[3, 0])


def test_acting_filters_as_learning_observes() -> None:
    model = make_model()
    obs, actions, is_first = window(4, 6, seed=3)
    is_first[2, 0] = True
    seen = model.observe(model.filter.scaled(obs), actions, is_first, generator(5))
    state, draws = model.filter.initial(4), generator(5)
    for t in range(6):
        state = model.filter.filter(state, obs[t], actions[t], is_first[t], draws)
        torch.testing.assert_close(state.h, seen.latent.h[t])
        torch.testing.assert_close(state.z, seen.latent.z[t])


def test_posterior_and_prior_are_distributions_over_the_classes() -> None:
    obs, actions, is_first = window(4, 5)
    model = make_model()
    seen = model.observe(model.filter.scaled(obs), actions, is_first, generator())
    for probs in (seen.posterior, seen.prior):
        assert probs.shape == (5, 4, MODEL.classes, MODEL.groups)
        torch.testing.assert_close(probs.sum(-2), torch.ones(5, 4, MODEL.groups))
        assert probs.min() >= MODEL.unimix / MODEL.classes


def test_the_prior_does_not_see_the_observation_of_its_step() -> None:
    model = make_model()
    obs, actions, is_first = window(2, 5)
    obs = model.filter.scaled(obs)
    before = model.observe(obs, actions, is_first, generator())
    other = obs.clone()
    other[3] = 1.0 - other[3]
    after = model.observe(other, actions, is_first, generator())
    assert torch.equal(after.prior[:4], before.prior[:4]) and not torch.equal(after.prior[4], before.prior[4])
    assert torch.equal(after.posterior[:3], before.posterior[:3])
    assert not torch.equal(after.posterior[3], before.posterior[3])


def test_reward_is_the_weighted_sum_of_both_players_event_probabilities() -> None:
    model, latent = make_model(), random_latent(3)
    probs = torch.sigmoid(model.event_logits(latent)).detach().unflatten(-1, (2, SPEC.num_events))
    weights = np.array(SPEC.event_weights)
    for row in range(3):
        expected = sum(float(probs[row, p, e]) * weights[e] for p in range(2) for e in range(SPEC.num_events))
        assert float(model.reward(latent)[row].detach()) == pytest.approx(expected, rel=1e-5)


def test_output_biases_start_at_the_means_of_the_data() -> None:
    model, latent = make_model(), random_latent(50)
    size = SPEC.views["features"].shape[0]
    obs_mean = torch.linspace(0.0, 1.0, 2 * size).reshape(2, size)
    event_mean = torch.linspace(0.001, 0.2, 2 * SPEC.num_events)
    with torch.no_grad():
        for layer in (
            *(decoder.trunk[-1] for decoder in model.decoders),
            model.event_head[-1],
            model.continue_head[-1],
        ):
            layer.weight.zero_()
    model.set_outputs(obs_mean[None, None], event_mean[None, None])
    wanted = obs_mean.clamp(1e-3, 1 - 1e-3)
    torch.testing.assert_close(torch.sigmoid(model.decode(latent)[7]), wanted, atol=1e-6, rtol=1e-4)
    wanted = event_mean.clamp(1e-3, 1 - 1e-3)
    torch.testing.assert_close(torch.sigmoid(model.event_logits(latent)[7]), wanted, atol=1e-6, rtol=1e-4)
    assert (model.continuation(latent) > 0.95).all()


def test_lossless_outputs_start_at_the_means_too_and_grids_are_centred() -> None:
    model = make_model(MODEL.model_copy(update={"view": "lossless", "cnn_channels": 2, "cnn_kernels": (3,)}))
    obs = model.filter.scaled(window(40, 6, view="lossless")[0])
    with torch.no_grad():
        for decoder in model.decoders:
            decoder.conv.layers[-1].weight.zero_()
    model.set_outputs(obs, torch.zeros(6, 40, 2 * SPEC.num_events))
    mean = obs.mean((0, 1))
    torch.testing.assert_close(torch.sigmoid(model.decode(random_latent(3))[1]), mean.clamp(1e-3, 1 - 1e-3))
    seen: list[Tensor] = []
    model.filter.encoder.conv.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    model.filter.encoder(obs.flatten(0, 1))
    assert float(seen[0].mean(0).abs().max()) < 1e-5 and float(seen[0].std()) > 0.01


@pytest.mark.parametrize(("view", "channel"), [("features", None), ("lossless", 20), ("lossless", 21)])
def test_the_likelihood_is_best_at_the_observation_itself(view: str, channel: int | None) -> None:
    """Also between two counts that differ by one: 20 is the channel of the steps left to cook, 21 is binary."""
    model = make_model(MODEL.model_copy(update={"view": view, "cnn_channels": 2, "cnn_kernels": (3,)}))
    largest = 1.0 if channel is None else float(model.filter.maxima[channel])
    obs = torch.zeros(1, 1, 2, *SPEC.views[view].shape)
    losses = []
    for count in np.arange(0.0, largest + 1):
        obs[0, 0, 0, ..., channel] = count / largest
        shares = torch.arange(largest + 1) / largest
        found = []
        for share in shares:
            decoded = torch.full_like(obs, -9.0)
            decoded[0, 0, 0, ..., channel] = torch.logit(share, eps=1e-4)
            found.append(float(model.observation_loss(decoded, obs)))
        losses.append(int(np.argmin(found)))
        assert len(losses) == count + 1 and losses[-1] == count


def test_exact_needs_every_number_of_both_players() -> None:
    model = make_model()
    obs = (torch.rand(3, 2, *SPEC.views["features"].shape, generator=generator()) > 0.5).float()
    decoded = torch.where(obs > 0.5, 0.1, -0.1)
    assert model.exact(decoded, obs).tolist() == [True] * 3
    decoded[1, 1, 4] *= -1
    assert model.exact(decoded, obs).tolist() == [True, False, True]


def test_exact_of_counts_is_after_rounding() -> None:
    model = make_model(MODEL.model_copy(update={"view": "lossless", "cnn_channels": 2, "cnn_kernels": (3,)}))
    largest = model.filter.maxima
    shape = (2, 2, *SPEC.views["lossless"].shape)
    counts = torch.floor(torch.rand(shape, generator=generator()) * largest)
    obs, decoded = counts / largest, torch.logit((counts + 0.4) / largest, eps=1e-6)
    assert model.exact(decoded, obs).tolist() == [True, True]
    decoded[0, 0, 1, 1, 3] = torch.logit((counts[0, 0, 1, 1, 3] + 0.6) / largest[..., 3].max(), eps=1e-6)
    assert model.exact(decoded, obs).tolist() == [False, True]


def test_lossless_view_goes_through_the_convolutions() -> None:
    config = MODEL.model_copy(update={"view": "lossless", "cnn_channels": 3, "cnn_kernels": (5, 3, 3)})
    model = make_model(config)
    obs, actions, is_first = window(3, 4, view="lossless")
    scaled = model.filter.scaled(obs)
    assert float(scaled.max()) <= 1.0
    seen = model.observe(scaled, actions, is_first, generator())
    decoded = model.decode(seen.latent)
    assert decoded.shape == (4, 3, 2, *SPEC.views["lossless"].shape)
    (decoded - scaled).square().mean().backward()
    grads = {name: p.grad for name, p in model.named_parameters() if "conv" in name}
    assert len(grads) >= 12 and all(grad is not None and grad.any() for grad in grads.values())


def test_step_follows_the_transition_and_the_prior() -> None:
    model, latent = make_model(), random_latent(500)
    actions = torch.randint(0, 6, (500, 2), generator=generator())
    following = model.step(latent, actions, generator(1))
    h = model.filter.transition(latent, actions)
    torch.testing.assert_close(following.h, h)
    drawn = following.z.unflatten(-1, (MODEL.classes, MODEL.groups))
    assert (drawn.sum(-2) == 1).all()
    wanted = model.prior(h).detach().mean(0)
    assert (drawn.mean(0) - wanted).abs().max() < 4 * np.sqrt(0.25 / 500)


def test_mode_takes_the_likeliest_class_in_acting_and_in_imagination() -> None:
    model, latent = make_model(MODEL.model_copy(update={"imagination": "mode"})), random_latent(20)
    actions = torch.randint(0, 6, (20, 2), generator=generator())
    best = model.prior(model.filter.transition(latent, actions)).argmax(-2)
    for draws in (generator(1), generator(2)):
        z = model.step(latent, actions, draws).z.unflatten(-1, (MODEL.classes, MODEL.groups))
        assert torch.equal(z.argmax(-2), best) and (z.sum(-2) == 1).all() and ((z == 0) | (z == 1)).all()
    obs, before, is_first = window(4, 1)
    state = model.filter.filter(model.filter.initial(4), obs[0], before[0], is_first[0], generator(3))
    posterior = model.filter.posterior(state.h, model.filter.encoder(model.filter.scaled(obs[0])))
    z = state.z.unflatten(-1, (MODEL.classes, MODEL.groups))
    assert torch.equal(z.argmax(-2), posterior.argmax(-2)) and (z.sum(-2) == 1).all()


def test_mode_counts_events_that_are_more_likely_than_not() -> None:
    probs = torch.tensor([0.9, 0.4, 0.51, 0.0, 0.2, 0.3, 0.7, 0.1, 0.49, 0.6])  # (P, E) = (2, 5)
    weights = np.tile(np.array(SPEC.event_weights), 2)
    for imagination, counted in (("sample", probs), ("mode", torch.where(probs > 0.5, probs, 0.0))):
        model = make_model(MODEL.model_copy(update={"imagination": imagination}))
        with torch.no_grad():
            model.event_head[-1].weight.zero_()
            model.event_head[-1].bias.copy_(torch.logit(probs, eps=1e-9))
        reward = model.reward(random_latent(3)).detach()
        assert reward.tolist() == pytest.approx([float((counted.numpy() * weights).sum())] * 3, rel=1e-4)


def test_a_view_that_is_not_there_is_named() -> None:
    from popgen.envs import make_env

    with pytest.raises(KeyError, match="lossless"):
        WorldModel(MODEL.model_copy(update={"view": "lossless"}), make_env("rendezvous/mppmr").spec)


def test_latent_slices_its_first_dimension() -> None:
    latent = random_latent(5, 2)
    part = latent[1:3]
    assert isinstance(part, Latent) and torch.equal(part.h, latent.h[1:3]) and torch.equal(part.z, latent.z[1:3])
    assert latent.flat().shape == (5, 2, MODEL.deter + MODEL.classes * MODEL.groups)
