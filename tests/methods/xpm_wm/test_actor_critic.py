from __future__ import annotations

import pytest
import torch
from support.small import AGENT, MODEL, PRIVATE, random_latent, with_other_group

from popgen.methods.xpm_wm.actor_critic import SELF, Actor, AgentNetworks, Critic
from popgen.methods.xpm_wm.latent_filter import Latent
from popgen.nets.weights import weights_of

ACTIONS = 6
CONFIG = AGENT.model_copy(update={"unimix": 0.06})


def make_actor(**changes: object) -> Actor:
    torch.manual_seed(0)
    actor = Actor(CONFIG.model_copy(update=changes), MODEL, ACTIONS)
    with torch.no_grad():  # the output layer starts near zero
        actor.net[-1].weight.mul_(200.0)
    return actor


@pytest.mark.parametrize("seat", [0, 1])
def test_the_actor_sees_the_joint_groups_and_its_own_only(seat: int) -> None:
    actor, latent, seats = make_actor(), random_latent(20), torch.full((20,), seat)
    before = actor.log_probs(latent, seats)
    for group in range(MODEL.groups):
        after = actor.log_probs(with_other_group(latent, group), seats)
        assert torch.equal(before, after) == (group in PRIVATE[1 - seat])


def test_both_seats_share_the_network_and_are_told_apart() -> None:
    actor, latent = make_actor(), random_latent(20)
    actor.masks.fill_(1.0)  # nothing but the seat is left to differ
    first, other = (actor.log_probs(latent, torch.full((20,), seat)) for seat in (0, 1))
    assert (first - other).abs().max() > 1e-3


@pytest.mark.parametrize(("actor_input", "sees"), [("model", True), ("latent", False)])
def test_actor_input_decides_whether_h_is_seen(actor_input: str, sees: bool) -> None:
    actor, latent, seats = make_actor(actor_input=actor_input), random_latent(20), torch.zeros(20, dtype=torch.long)
    other = Latent(latent.h + 1.0, latent.z)
    assert torch.equal(actor.log_probs(latent, seats), actor.log_probs(other, seats)) != sees


def test_without_a_bound_gradients_are_as_they_are() -> None:
    latent, seats = random_latent(20), torch.zeros(20, dtype=torch.long)
    left = []
    for bound in (0.0, 1e9, 1e-9):
        config = CONFIG.model_copy(update={"grad_clip": bound, "adam_eps": 1e-3})
        networks = AgentNetworks(config, MODEL, ACTIONS, (), 0, torch.device("cpu"), torch.float32)
        before = weights_of(networks.actor) | weights_of(networks.critics)
        networks.step_actor(networks.actor.log_probs(latent, seats)[:, 0].mean())
        networks.step_critics(networks.critic(SELF).logits(latent, seats)[:, 0].mean())
        after = weights_of(networks.actor) | weights_of(networks.critics)
        left.append((after, max(abs(after[name] - before[name]).max() for name in after)))
    assert all((left[0][0][name] == left[1][0][name]).all() for name in left[0][0])
    assert left[0][1] > 100 * left[2][1]


def test_no_action_dies_and_a_fresh_actor_is_nearly_uniform() -> None:
    latent, seats = random_latent(50), torch.zeros(50, dtype=torch.long)
    actor = make_actor()
    with torch.no_grad():
        actor.net[-1].bias.copy_(torch.tensor([100.0, 0, 0, 0, 0, 0]))
    probs = actor.log_probs(latent, seats).exp()
    torch.testing.assert_close(probs.sum(-1), torch.ones(50))
    torch.testing.assert_close(probs[:, 1:], torch.full((50, 5), 0.01), atol=1e-6, rtol=0)
    torch.manual_seed(0)
    fresh = Actor(CONFIG, MODEL, ACTIONS).log_probs(latent, seats).exp()
    assert (fresh - 1 / ACTIONS).abs().max() < 0.1


def test_samples_are_as_frequent_as_their_probabilities() -> None:
    actor, count = make_actor(), 20_000
    latent, seats = random_latent(2), torch.tensor([0, 1])
    many = Latent(latent.h.expand(count, 2, -1), latent.z.expand(count, 2, -1))
    actions = actor.sample(many, seats.expand(count, 2), torch.Generator().manual_seed(0))
    assert actions.shape == (count, 2) and actions.dtype == torch.int64
    wanted = actor.log_probs(latent, seats).exp()
    seen = torch.stack([(actions == a).float().mean(0) for a in range(ACTIONS)], -1)
    assert ((seen - wanted).abs() < 4 * (wanted * (1 - wanted) / count).sqrt()).all()


def test_the_critic_starts_at_zero_and_learns_from_everything() -> None:
    torch.manual_seed(0)
    critic, latent = Critic(AGENT, MODEL), random_latent(30)
    seats = (torch.arange(30) % 2).long()
    assert critic.value(latent, seats).abs().max() < 1e-4
    target = latent.z[:, 4] + 2.0 * seats + latent.h[:, 0]
    optimiser = torch.optim.Adam(critic.parameters(), lr=0.01)
    first = float(critic.loss(latent, seats, target).mean().detach())
    for _ in range(200):
        optimiser.zero_grad()
        critic.loss(latent, seats, target).mean().backward()
        optimiser.step()
    assert float(critic.loss(latent, seats, target).mean().detach()) < 0.5 * first
    assert (critic.value(latent, seats) - target).abs().mean() < 0.5
    # It looks at the joint state: at every group of either player, at h and at the seat.
    value = critic.value(latent, seats)
    for group in range(MODEL.groups):
        assert not torch.equal(critic.value(with_other_group(latent, group), seats), value)
    assert not torch.equal(critic.value(latent, 1 - seats), value)
    assert not torch.equal(critic.value(Latent(latent.h + 1, latent.z), seats), value)
