"""From imagined play to the losses: targets of each kind of play, log-probabilities, policy and critic losses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from popgen.losses.policy_losses import clipped_loss, reinforce, signed_advantage
from popgen.methods.xpm_wm.actor_critic import Actor
from popgen.methods.xpm_wm.agent_networks import SELF, AgentNetworks
from popgen.methods.xpm_wm.imagination import Imagined
from popgen.methods.xpm_wm.latents import Latent
from popgen.methods.xpm_wm.policy_samples import Samples
from popgen.types import Kind

LEAST_SPREAD = 0.1
"""Of self-play's advantages, in units of reward: where nothing is at stake, noise is not blown up."""


@dataclass(frozen=True)
class PolicyTarget:
    """What one kind of imagined play teaches.

    Attributes:
        samples: for the policy and for the critic of that play.
        unit: of all advantages of the update, which self-play sets.
        figures: for the logs.
    """

    samples: Samples
    unit: Tensor
    figures: dict[str, float]


class Losses(NamedTuple):
    """Of the policy and of a critic, to be minimised, and the policy's figures."""

    policy: Float[Tensor, ""]
    critic: Float[Tensor, ""]
    figures: dict[str, float]


class PolicyTerms(NamedTuple):
    """Log-probability of the actions taken, and entropy."""

    log_prob: Float[Tensor, "R K"]
    entropy: Float[Tensor, "R K"]


def self_play_target(networks: AgentNetworks, imagined: Imagined, entropy_scale: float) -> PolicyTarget:
    """+J_SP. The unit of all advantages is the range of the returns, or the advantages' spread."""
    steps, batch = imagined.reward.shape
    players = torch.tensor([0, 1], device=networks.device).expand(batch, 2)
    returns, value = networks.targets(imagined, SELF, players[:, 0].expand(steps + 1, batch))
    advantage, scale = returns - value[:-1], networks.scale.update(returns)
    unit = scale
    if networks.config.advantage_unit == "spread":  # centred as usual: a shift of all advantages only adds noise
        running = advantage[imagined.running > 0.5]
        advantage, unit = advantage - running.mean(), running.std().clamp(min=LEAST_SPREAD)
        if networks.config.advantage_clip:
            advantage, unit = clip_advantages(advantage, imagined.running > 0.5, networks.config.advantage_clip)
    signed = signed_advantage(Kind.SP, advantage, weight=1.0, scale=unit)
    figures = {
        "entropy_scale": entropy_scale,
        "return_scale": float(scale),
        "imagined_shaped_sp": float(imagined.reward.mean()),
        "imagined_return_sp": float(returns.mean()),
        "value_sp": float(value.mean()),
        "advantage_sp": float(advantage.std()),
    }
    samples = Samples.from_imagined(imagined, SELF, players, returns, signed, entropy_scale)
    return PolicyTarget(add_log_probs(networks, samples), unit, figures)


def clip_advantages(
    advantage: Float[Tensor, "H B"], running: Bool[Tensor, "H B"], times: float
) -> tuple[Float[Tensor, "H B"], Float[Tensor, ""]]:
    """Centred advantages cut at so many `times` their mean magnitude in running states, and their spread then."""
    bound = times * advantage[running].abs().mean()
    cut = advantage.clamp(-bound, bound)
    return cut, cut[running].std().clamp(min=LEAST_SPREAD)


def cross_play_target(
    networks: AgentNetworks,
    imagined: Imagined,
    partner: int,
    seats: Int[Tensor, " B"],
    *,
    unit: Float[Tensor, ""],
    weight: float,
    entropy_scale: float,
) -> PolicyTarget:
    """-lambda_XP J_XP with `partner`, in self-play's `unit`; `weight` is lambda_XP."""
    steps, batch = imagined.reward.shape
    returns, value = networks.targets(imagined, partner, seats.expand(steps + 1, batch))
    advantage = returns - value[:-1]
    signed = signed_advantage(Kind.XP, advantage, weight=weight, scale=unit)
    figures = {
        "imagined_shaped_xp": float(imagined.reward.mean()),
        "imagined_return_xp": float(returns.mean()),
        "advantage_xp": float(advantage.std()),
        "lambda": weight,
        "partner": float(partner),
    }
    samples = Samples.from_imagined(imagined, partner, seats.unsqueeze(-1), returns, signed, entropy_scale)
    return PolicyTarget(add_log_probs(networks, samples), unit, figures)


def add_log_probs(networks: AgentNetworks, samples: Samples) -> Samples:
    """With those of the actions under the present policy, where the surrogate compares with them."""
    if networks.config.surrogate == "reinforce":
        return samples
    with torch.no_grad():
        return replace(samples, log_prob=policy_terms(networks.actor, samples).log_prob)


def policy_terms(actor: Actor, samples: Samples) -> PolicyTerms:
    """Log-probability of the actions taken and entropy under `actor`."""
    latent, seats = samples.latent, samples.seats
    shown = Latent(*(x.unsqueeze(1).expand(*seats.shape, x.shape[-1]) for x in (latent.h, latent.z)))
    log_probs = actor.log_probs(shown, seats)
    taken = log_probs.gather(-1, samples.actions.unsqueeze(-1)).squeeze(-1)
    return PolicyTerms(taken, -(log_probs.exp() * log_probs).sum(-1))


def sample_losses(networks: AgentNetworks, samples: Samples) -> Losses:
    """Of the policy and of the critic of the samples."""
    log_prob, entropy = policy_terms(networks.actor, samples)
    advantage, running = samples.advantage.unsqueeze(-1), samples.running.unsqueeze(-1)
    figures, clip = {"entropy": float(entropy.detach().mean())}, networks.config.clip
    if samples.log_prob is None:
        policy = reinforce(log_prob, advantage, entropy, running, entropy_scale=samples.entropy_scale)
    else:
        terms = (log_prob, samples.log_prob, advantage, entropy, running)
        policy = clipped_loss(*terms, clip=clip, entropy_scale=samples.entropy_scale)
        change = (log_prob.detach() - samples.log_prob).exp() - 1.0
        figures["clipped"] = float((change.abs() > clip).float().mean())
    errors = networks.critic(samples.key).loss(samples.latent, samples.seat, samples.returns)
    return Losses(policy, (samples.running * errors).mean(), figures)
