"""One update of the agent: networks, samples of imagined play, targets of each kind of play, losses, gradient steps."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from popgen.losses.policy_losses import (
    ReturnScale,
    bound_advantage,
    clipped_loss,
    lambda_return,
    reinforce,
    signed_advantage,
)
from popgen.methods.xpm_wm.actor_critic import Actor, Critic
from popgen.methods.xpm_wm.config import AgentConfig, WorldModelConfig
from popgen.methods.xpm_wm.imagination import Imagined
from popgen.methods.xpm_wm.latent_filter import Latent
from popgen.nets import weights as w
from popgen.types import Kind

SELF = 0
"""Key of the self-play critic among the critics; cross-play critics are keyed by partner."""


class ReturnTargets(NamedTuple):
    """Lambda-returns (H, B) and values (H + 1, B), without gradient."""

    returns: Float[Tensor, "H B"]
    value: Float[Tensor, "T B"]


class AgentNetworks:
    """Fresh networks on `device`; `rollout_actor` is the actor's copy in `dtype`, with which it acts in imagination.

    Args:
        partners: predecessors, each with a critic of its own.
        seed: of the initial weights.
    """

    def __init__(
        self,
        config: AgentConfig,
        model_config: WorldModelConfig,
        num_actions: int,
        partners: Iterable[int],
        seed: int,
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.config, self.model_config, self.device, self.dtype = config, model_config, device, dtype
        torch.manual_seed(seed)
        self.actor = Actor(config, model_config, num_actions).to(device)
        self.scale = ReturnScale(config.return_percentiles).to(device)
        self.critics = nn.ModuleDict({str(key): self._fresh_critic() for key in (SELF, *partners)})
        self.slow = copy.deepcopy(self.critics).requires_grad_(False)
        self.actor_optimiser = self._make_optimiser(self.actor, config.actor_lr)
        self.critic_optimiser = self._make_optimiser(self.critics, config.critic_lr)
        self.rollout_actor = copy.deepcopy(self.actor).to(dtype).requires_grad_(False)

    def _fresh_critic(self) -> Critic:
        return Critic(self.config, self.model_config).to(self.device)

    def _make_optimiser(self, module: nn.Module, rate: float) -> torch.optim.Adam:
        return torch.optim.Adam(module.parameters(), lr=rate, eps=self.config.adam_eps, fused=True)

    def add_critic(self, partner: int) -> None:
        """A critic of cross-play with one more partner; the optimisers begin anew."""
        self.critics[str(partner)] = self._fresh_critic()
        self.slow = copy.deepcopy(self.critics).requires_grad_(False)
        self.actor_optimiser = self._make_optimiser(self.actor, self.config.actor_lr)
        self.critic_optimiser = self._make_optimiser(self.critics, self.config.critic_lr)
        self.rollout_actor = copy.deepcopy(self.actor).to(self.dtype).requires_grad_(False)

    def critic(self, key: int, *, slow: bool = False) -> Critic:
        """The critic of a key, or its slow copy."""
        critic = (self.slow if slow else self.critics)[str(key)]
        assert isinstance(critic, Critic)
        return critic

    @torch.no_grad()
    def targets(self, imagined: Imagined, key: int, seat: Int[Tensor, "T B"]) -> ReturnTargets:
        """Lambda-returns under the slow critic of `key`, which is told the agent's seat."""
        value = self.critic(key, slow=True).value(imagined.latent, seat)
        discount = self.config.discount * imagined.keep
        return ReturnTargets(lambda_return(imagined.reward, value, discount, self.config.lam), value)

    def step_actor(self, loss: Tensor) -> None:
        """One step of the actor down the gradient of `loss`."""
        self._step_down(self.actor_optimiser, loss, self.actor.parameters())

    def step_critics(self, loss: Tensor) -> None:
        """The same for the critics."""
        self._step_down(self.critic_optimiser, loss, self.critics.parameters())

    def _step_down(self, optimiser: torch.optim.Optimizer, loss: Tensor, parameters: Iterable[nn.Parameter]) -> None:
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, self.config.grad_clip)
        optimiser.step()

    @torch.no_grad()
    def update_copies(self) -> None:
        """Slow critics move towards the fast ones; the rollout copy of the actor is refreshed."""
        for slow, fast in zip(self.slow.parameters(), self.critics.parameters(), strict=True):
            slow.lerp_(fast, 1.0 - self.config.slow_critic)
        for rollout, trained in zip(self.rollout_actor.parameters(), self.actor.parameters(), strict=True):
            rollout.copy_(trained)

    def state(self) -> dict[str, Any]:
        """Weights and optimisers."""
        return {
            "actor": w.weights_of(self.actor),
            "critics": w.weights_of(self.critics),
            "slow": w.weights_of(self.slow),
            "scale": w.weights_of(self.scale),
            "actor_optimiser": w.optimiser_state(self.actor_optimiser),
            "critic_optimiser": w.optimiser_state(self.critic_optimiser),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Replace the contents with `state()`; the partners' critics must have been added before."""
        w.load_weights(self.actor, state["actor"])
        w.load_weights(self.critics, state["critics"])
        w.load_weights(self.slow, state["slow"])
        w.load_weights(self.scale, state["scale"])
        w.load_weights(self.rollout_actor, state["actor"], cast=True)
        w.load_optimiser_state(self.actor_optimiser, state["actor_optimiser"])
        w.load_optimiser_state(self.critic_optimiser, state["critic_optimiser"])


# ---- samples ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Samples:
    """R imagined states of one pair of policies; no gradient flows into them.

    key: of the critic that learns from them.
    latent: (R, .), seat: (R,) int64, what that critic sees; returns: (R,), its targets.
    seats, actions: (R, K) int64, where the member sat and what it did: K is 2 in self-play, 1 in cross-play.
    advantage: (R,), with the objective's sign, weight and unit.
    running: (R,), probability that the imagined episode still runs.
    entropy_scale: of the bonus in these states.
    log_prob: (R, K), of the actions under the policy that took them; None where one step is taken on the whole batch.
    """

    key: int
    latent: Latent
    seat: Tensor
    returns: Tensor
    seats: Tensor
    actions: Tensor
    advantage: Tensor
    running: Tensor
    entropy_scale: float
    log_prob: Tensor | None = None

    @staticmethod
    def from_imagined(
        imagined: Imagined, key: int, seats: Tensor, returns: Tensor, advantage: Tensor, entropy_scale: float
    ) -> Samples:
        """Trajectories (H, B) in one row each: `seats` (B, K) int64 are the member's, the critic is told the first."""
        steps, batch = imagined.reward.shape
        seats = seats.expand(steps, batch, -1)
        latent, actions = imagined.latent[:-1], imagined.actions.gather(-1, seats)
        return Samples(
            key=key,
            latent=Latent(latent.h.flatten(0, 1), latent.z.flatten(0, 1)),
            seat=seats[..., 0].flatten(0, 1),
            returns=returns.flatten(0, 1),
            seats=seats.flatten(0, 1),
            actions=actions.flatten(0, 1),
            advantage=advantage.flatten(0, 1),
            running=imagined.running.flatten(0, 1),
            entropy_scale=entropy_scale,
        )

    def __len__(self) -> int:
        return len(self.returns)

    def __getitem__(self, rows: Tensor) -> Samples:
        return replace(
            self,
            latent=self.latent[rows],
            seat=self.seat[rows],
            returns=self.returns[rows],
            seats=self.seats[rows],
            actions=self.actions[rows],
            advantage=self.advantage[rows],
            running=self.running[rows],
            log_prob=None if self.log_prob is None else self.log_prob[rows],
        )

    def minibatches(self, parts: int, generator: torch.Generator) -> list[Samples]:
        """All rows in random order in so many parts; as they are if that is one."""
        if parts == 1:
            return [self]
        order = torch.randperm(len(self), generator=generator, device=self.returns.device)
        return [self[rows] for rows in torch.tensor_split(order, parts)]


# ---- targets and losses ----------------------------------------------------------------------------------------------


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
    """-lambda_XP J_XP with `partner`, in self-play's `unit`, at most `agent.xp_clip` of them; `weight` is lambda_XP."""
    steps, batch = imagined.reward.shape
    returns, value = networks.targets(imagined, partner, seats.expand(steps + 1, batch))
    advantage = returns - value[:-1]
    bounded = bound_advantage(advantage, clip=networks.config.xp_clip, spread=unit)
    signed = signed_advantage(Kind.XP, bounded, weight=weight, scale=unit)
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


# ---- gradient steps --------------------------------------------------------------------------------------------------


def cast_automatically(networks: AgentNetworks) -> torch.autocast:
    """Products in bfloat16 where the networks' rollouts are."""
    return torch.autocast(networks.device.type, torch.bfloat16, enabled=networks.dtype is torch.bfloat16)


def learn_batch(networks: AgentNetworks, samples: Sequence[Samples], generator: torch.Generator) -> dict[str, float]:
    """`epochs` passes over the batch in `minibatches`, of every kind of samples its share; mean figures."""
    config, totals = networks.config, []
    for _ in range(config.epochs):
        parts = [part.minibatches(config.minibatches, generator) for part in samples]
        totals += [step_networks(networks, together) for together in zip(*parts, strict=True)]
    return {name: float(np.mean([figures[name] for figures in totals])) for name in totals[0]}


def step_networks(networks: AgentNetworks, parts: Sequence[Samples]) -> dict[str, float]:
    """One step of the actor and of the critics that the samples are of."""
    with cast_automatically(networks):
        losses = [sample_losses(networks, part) for part in parts]
    zero = torch.zeros((), device=networks.device)
    networks.step_actor(sum((loss.policy for loss in losses), zero))
    networks.step_critics(sum((loss.critic for loss in losses), zero))
    figures = losses[0].figures  # of the policy in self-play
    for part, loss in zip(parts, losses, strict=True):
        figures["critic_loss_sp" if part.key == SELF else "critic_loss_xp"] = float(loss.critic.detach())
    return figures
