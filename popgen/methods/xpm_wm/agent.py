"""One member's learner: imagined self-play and cross-play, and the XPM-Sim objective (paper, eq. XPM-Sim).

J(j) = J_SP(j | starts in SP and XP states) - lambda_XP max_k J_XP(j, k | starts in XP states)

By REINFORCE, as in the paper, or by PPO's clipped surrogate in several passes over what was imagined.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from popgen.envs.contract import EnvSpec
from popgen.losses.policy_losses import (
    bound_advantage,
    clipped_loss,
    geometric,
    lambda_return,
    linear_schedule,
    reinforce,
    signed_advantage,
)
from popgen.methods.xpm_wm.actor_critic import SELF, Actor, AgentNetworks
from popgen.methods.xpm_wm.config import AgentConfig, DiscoveryConfig, WorldModelConfig
from popgen.methods.xpm_wm.imagination import (
    NEW_SP,
    Discovery,
    Imagined,
    ImaginedPlay,
    JointActor,
    PayLimits,
    Samples,
    cross_play_seats,
    draw_start_rows,
    expected_pay,
    imagine,
    joint_actor,
    start_latents,
)
from popgen.methods.xpm_wm.imagined_surprise import surprise_bonus
from popgen.methods.xpm_wm.latent_filter import Latent
from popgen.methods.xpm_wm.real_play import Tally
from popgen.methods.xpm_wm.world_model import Starts, WorldModel
from popgen.nets import weights as w
from popgen.play.partner_strength import PartnerConstraint, any_or_strongest
from popgen.types import Kind


def cross_play_weight(config: AgentConfig, updates: int) -> float:
    """lambda_XP after so many updates: rising from `lambda_start`, if that is less, to `lambda_xp` over `lambda_ramp`.

    Cross-play pressure must be there from the first update, or the member settles on its predecessor's convention; at
    full strength from the start it keeps self-play from starting at all.
    """
    start = min(config.lambda_start, config.lambda_xp)
    return linear_schedule(start, config.lambda_xp, updates, config.lambda_ramp)


def entropy_scale(
    config: AgentConfig, discovery: DiscoveryConfig, updates_since_discovery: int, updates_since_self_play: int
) -> float:
    """Scale of the entropy bonus: `entropy`, then falling to `found_entropy` over the updates since the highest-paying
    event was found, and to `entropy_end` over those since real self-play has begun, each within `entropy_ramp` and by
    the same factor in each.

    In units of the returns' range, which grows tenfold once dishes are delivered, advantages shrink: a scale that lets
    self-play start would then win over them, and the policy would get more random the better it plays.
    """
    scale, ramp = config.entropy, config.entropy_ramp
    if ramp and updates_since_discovery:
        scale = geometric(scale, min(discovery.found_entropy, scale), updates_since_discovery, ramp)
    if ramp and updates_since_self_play:
        scale = geometric(scale, min(config.entropy_end, scale), updates_since_self_play, ramp)
    return scale


def rollout_dtype(precision: str, device: torch.device = torch.device("cpu")) -> torch.dtype:  # noqa: B008
    """`auto` takes bfloat16 where the device multiplies it natively, which is several times faster, else float32."""
    if precision == "auto":
        cpu = getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
        native = torch.cuda.is_bf16_supported if device.type == "cuda" else cpu
        precision = "bfloat16" if native() else "float32"
    return getattr(torch, precision)


# ---- targets and losses ----------------------------------------------------------------------------------------------


Seats = Int[Tensor, " B"]
"""The member's seat in each row of imagined cross-play."""

Unit = Float[Tensor, ""]
"""What advantages are divided by."""

LEAST_SPREAD = 0.1
"""Least spread of self-play's advantages, in reward: as a unit it blows up no noise where nothing is at stake."""


class ReturnTargets(NamedTuple):
    """Lambda-returns and values, without gradient."""

    returns: Float[Tensor, "H B"]
    value: Float[Tensor, "H+1 B"]


@torch.no_grad()
def estimate_returns(networks: AgentNetworks, imagined: Imagined, key: int, seat: Int[Tensor, "T B"]) -> ReturnTargets:
    """Lambda-returns under the slow critic of `key`, which also sees the agent's `seat` in each of T = H + 1 states."""
    value = networks.critic(key, slow=True).value(imagined.latent, seat)
    discount = networks.config.discount * imagined.keep
    return ReturnTargets(lambda_return(imagined.reward, value, discount, networks.config.lam), value)


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
    """Losses of the policy and of a critic, to be minimised, and the policy's figures."""

    policy: Float[Tensor, ""]
    critic: Float[Tensor, ""]
    figures: dict[str, float]


class PolicyTerms(NamedTuple):
    """Log-probability of the actions taken, and entropy."""

    log_prob: Float[Tensor, "R K"]
    entropy: Float[Tensor, "R K"]


def self_play_target(networks: AgentNetworks, imagined: Imagined, entropy_scale: float) -> PolicyTarget:
    """+J_SP. The unit of all advantages is the range of the returns, or the advantages' spread.

    Args:
        networks: actor, critics and the running range of the returns, which takes this batch in.
        imagined: self-play, (H, B).
        entropy_scale: of the entropy bonus.
    """
    steps, batch = imagined.reward.shape
    players = torch.tensor([0, 1], device=networks.device).expand(batch, 2)
    returns, value = estimate_returns(networks, imagined, SELF, players[:, 0].expand(steps + 1, batch))
    advantage, return_range = returns - value[:-1], networks.return_range.update(returns)
    unit = return_range
    if networks.config.advantage_unit == "spread":  # centred as usual: a shift of all advantages only adds noise
        running = advantage[imagined.running > 0.5]
        advantage, unit = advantage - running.mean(), running.std().clamp(min=LEAST_SPREAD)
        if networks.config.advantage_clip:
            advantage, unit = clip_advantages(advantage, imagined.running > 0.5, networks.config.advantage_clip)
    signed = signed_advantage(Kind.SP, advantage, weight=1.0, unit=unit)
    figures = {
        "entropy_scale": entropy_scale,
        "return_scale": float(return_range),
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
    seats: Seats,
    *,
    unit: Unit,
    weight: float,
    entropy_scale: float,
) -> PolicyTarget:
    """-lambda_XP J_XP with `partner`. Advantages are divided by `unit` and clipped to +-`agent.xp_clip` units.

    Args:
        networks: actor and critics.
        imagined: cross-play, (H, B).
        partner: whose critic gives the values.
        seats: (B,) int64, the agent's seat.
        unit: self-play's.
        weight: lambda_XP times the partners' pressure (`PartnerConstraint.pressure`; 1 without a constraint).
        entropy_scale: of the entropy bonus; `AgentLearner.cross_play` scales self-play's by `weight` too.
    """
    steps, batch = imagined.reward.shape
    returns, value = estimate_returns(networks, imagined, partner, seats.expand(steps + 1, batch))
    advantage = returns - value[:-1]
    bounded = bound_advantage(advantage, clip=networks.config.xp_clip, unit=unit)
    signed = signed_advantage(Kind.XP, bounded, weight=weight, unit=unit)
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
    """Losses of the policy and of the samples' critic."""
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


# ---- the learner -----------------------------------------------------------------------------------------------------


class AgentLearner:
    """Actor, one self-play critic and one cross-play critic per partner of member `member`.

    Set the world model, start states and partners, then call `update`; real play tells when `self_play_has_begun`.
    Tensors are on `device`, weights come and go as arrays. Generators differ between devices, initial weights do not.
    """

    def __init__(
        self,
        config: AgentConfig,
        model_config: WorldModelConfig,
        spec: EnvSpec,
        member: int,
        seed: int,
        device: str | torch.device = "cpu",
        discovery: DiscoveryConfig | None = None,
    ) -> None:
        self.config, self.model_config, self.spec, self.member = config, model_config, spec, member
        self.device = torch.device(device)
        self.dtype = rollout_dtype(config.precision, self.device)
        self.generator, self.rng = torch.Generator(self.device).manual_seed(seed + 1), np.random.default_rng(seed + 2)
        self.model = WorldModel(model_config, spec).to(self.device, self.dtype).eval().requires_grad_(False)
        self.discovery = Discovery(discovery or DiscoveryConfig(), spec, model_config.view, self.device)
        self.partners: dict[int, Actor] = {}
        self.starts: Starts | None = None
        self.pay_limits = PayLimits()
        self.partner_scores: dict[int, float] = {}
        self.imagined_scores: dict[int, float] = {}
        self.constraint = PartnerConstraint(config.xp_limit, config.multiplier_step)
        self.self_play_has_begun, self.new_share = False, 0.0
        self.networks = self._fresh_networks(seed)
        self.updates = self.updates_since_self_play = self.updates_since_discovery = 0

    def _fresh_networks(self, seed: int) -> AgentNetworks:
        sizes = self.config, self.model_config, self.spec.num_actions
        return AgentNetworks(*sizes, self.partners, seed, self.device, self.dtype)

    @property
    def actor(self) -> Actor:
        """The member's policy."""
        return self.networks.actor

    @property
    def critics(self) -> nn.ModuleDict:
        """Critics by key."""
        return self.networks.critics

    def restart(self, seed: int) -> None:
        """Fresh actor, critics and return scale: the world model stays."""
        self.networks = self._fresh_networks(seed)
        self.updates = self.updates_since_self_play = self.updates_since_discovery = 0

    def add_partner(self, member: int, actor_weights: w.Weights) -> None:
        """A frozen predecessor, with a critic of its own; it acts on the current world model's latents."""
        actor = Actor(self.config, self.model_config, self.spec.num_actions)
        w.load_weights(actor, actor_weights)
        self.partners[member] = actor.to(self.device, self.dtype).eval().requires_grad_(False)
        self.networks.add_critic(member)

    def set_model(self, weights: w.Weights, partners: Mapping[int, w.Weights] | None = None) -> None:
        """The world model to imagine with, in the rollout's precision, and partners' actors that were fitted to it."""
        w.load_weights(self.model, weights, cast=True)
        for member, actor in (partners or {}).items():
            w.load_weights(self.partners[member], actor, cast=True)

    def set_starts(self, starts: Starts, new_share: float) -> None:
        """States to start from; `new_share` of the draws come from this member's own data."""
        self.starts, self.new_share = starts, new_share

    def choose_partner(self) -> int | None:
        """The strongest by real returns, at times a random one, those without any first, by imagined returns; under a
        constraint one drawn in proportion to the multipliers; None in pure self-play."""
        if not self.partners or self.config.lambda_xp == 0.0:
            return None
        if self.config.xp_limit is not None:
            return self.constraint.draw_partner(sorted(self.partners), self.rng)
        share = self.config.partner_random
        return any_or_strongest(self.partners, self.partner_scores, share, self.rng, self.imagined_scores)

    def update(self) -> dict[str, float]:
        """Imagine, compute the XPM-Sim objective, and step actor and critics over the batch; mean figures."""
        partner = self.choose_partner()
        imagined, seats = self.imagine_play(partner)
        count = self.config.starts_sp
        with cast_automatically(self.networks):
            own = self.self_play(imagined.of_columns(slice(None, count)))
            targets = [own]
            if partner is not None:
                targets.append(self.cross_play(imagined.of_columns(slice(count, None)), partner, seats, own.unit))
        figures = {name: value for target in targets for name, value in target.figures.items()}
        figures |= learn_batch(self.networks, [target.samples for target in targets], self.generator)
        self.networks.update_copies()
        self.updates += 1
        self.updates_since_self_play += self.self_play_has_begun
        self.updates_since_discovery += self.discovery.found()
        return figures

    def lambda_now(self) -> float:
        """lambda_XP of this update."""
        return cross_play_weight(self.config, self.updates)

    def entropy_now(self) -> float:
        """Entropy scale of this update."""
        counts = self.updates_since_discovery, self.updates_since_self_play
        return entropy_scale(self.config, self.discovery.config, *counts)

    def imagine_play(self, partner: int | None) -> ImaginedPlay:
        """A batch of imagined self-play and, with a partner, of cross-play."""
        if self.starts is None:
            raise RuntimeError("set_starts before update")
        rows = draw_start_rows(self.config, self.starts, self.new_share, partner, self.rng)
        seats = cross_play_seats(self.config.starts_xp if partner is not None else 0, self.device)
        other = self.partners[partner] if partner is not None and len(seats) else None
        act = joint_actor(self.networks.rollout_actor, other, self.config.starts_sp, seats, self.generator)
        return ImaginedPlay(self._imagine(act, rows), seats)

    def start_states(self, rows: np.ndarray) -> Latent:
        """The stored model states of `rows`, on the learner's device."""
        assert self.starts is not None
        return start_latents(self.starts, rows, self.model_config.classes, self.device, self.dtype)

    def _imagine(self, act: JointActor, rows: np.ndarray) -> Imagined:
        pay = self.discovery.pay if self.discovery.changes_pay else expected_pay
        imagined = imagine(self.model, act, self.start_states(rows), self.config.horizon, self.generator, pay)
        return self.pay_limits.hold(imagined)

    def compare_with_real_play(self, tally: Tally, recent: Starts | None) -> dict[str, float]:
        """Take in what real play has shown; how often each event happens in it and in imagination from `recent`
        states of it, or from this member's self-play among the states to start from; figures of both."""
        self.discovery.tally = tally
        if not self.discovery.config.trust or (events := self._imagined_rates(recent)) is None:
            return {}
        return self.discovery.compare(events, tally)

    def _imagined_rates(self, recent: Starts | None) -> np.ndarray | None:
        """(E,) events a step that the present policy imagines; None without states to start from."""
        if (starts := recent if recent is not None else self.starts) is None:
            return None
        rows = np.arange(len(starts)) if recent is not None else np.flatnonzero(starts.pool == NEW_SP)
        if not len(rows):
            return None
        rows = self.rng.choice(rows, self.discovery.config.trust_starts)
        start = start_latents(starts, rows, self.model_config.classes, self.device, self.dtype)
        actor, alone = self.networks.rollout_actor, cross_play_seats(0, self.device)
        act = joint_actor(actor, None, len(rows), alone, self.generator)
        imagined = imagine(self.model, act, start, self.config.horizon, self.generator)
        happened = self.model.event_probs(imagined.latent[1:]).unflatten(-1, (self.spec.num_players, -1)) > 0.5
        return happened.sum(2).float().mean((0, 1)).cpu().numpy().astype(np.float64)

    # ---- what a batch teaches ------------------------------------------------------------------------------------

    def self_play(self, imagined: Imagined) -> PolicyTarget:
        """+J_SP, which sets the unit of all advantages; with the bonuses, where there are any."""
        bonuses = find_bonuses(self, imagined)
        if not bonuses:
            return self_play_target(self.networks, imagined, self.entropy_now())
        paid = replace(imagined, reward=imagined.reward + torch.stack(list(bonuses.values())).sum(0))
        target = self_play_target(self.networks, paid, self.entropy_now())
        figures = {name: float(bonus.mean()) for name, bonus in bonuses.items()}
        return replace(target, figures=target.figures | figures | {"imagined_shaped_sp": float(imagined.reward.mean())})

    def cross_play(self, imagined: Imagined, partner: int, seats: Seats, unit: Unit) -> PolicyTarget:
        """-lambda_XP J_XP and the entropy bonus at the same weight; what is earned with the partner is remembered."""
        weight = self.lambda_now() * self.constraint.pressure(list(self.partners))
        target = cross_play_target(
            self.networks, imagined, partner, seats, unit=unit, weight=weight, entropy_scale=self.entropy_now() * weight
        )
        reward = target.figures["imagined_shaped_xp"]
        self.imagined_scores[partner] = 0.95 * self.imagined_scores.get(partner, reward) + 0.05 * reward
        return target

    # ---- what is kept --------------------------------------------------------------------------------------------

    def actor_weights(self) -> w.Weights:
        """What a sampler needs of this member besides the world model's filter."""
        return w.weights_of(self.actor)

    def state(self) -> dict[str, Any]:
        """Everything to continue from exactly here, except the world model and the start states."""
        return self.networks.state() | {
            "generator": self.generator.get_state().numpy(),
            "rng": self.rng.bit_generator.state,
            "updates": self.updates,
            "playing": self.updates_since_self_play,
            "finding": self.updates_since_discovery,
            "discovery": self.discovery.state(),
            "partner_scores": {str(k): v for k, v in self.partner_scores.items()},
            "imagined_scores": {str(k): v for k, v in self.imagined_scores.items()},
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Replace the contents with `state()`; the partners must have been added before."""
        self.networks.load_state(state)
        self.generator.set_state(torch.from_numpy(np.array(state["generator"])))
        self.rng.bit_generator.state = state["rng"]
        self.updates, self.updates_since_self_play = int(state["updates"]), int(state["playing"])
        self.updates_since_discovery = int(state["finding"])
        self.discovery.load_state(state["discovery"])
        self.partner_scores = {int(k): float(v) for k, v in state["partner_scores"].items()}
        self.imagined_scores = {int(k): float(v) for k, v in state["imagined_scores"].items()}


def find_bonuses(learner: AgentLearner, imagined: Imagined) -> dict[str, Tensor]:
    """What imagined self-play earns beside the reward, (H, B) by name: for states that were seldom seen, and for what
    the population seldom does."""
    found: dict[str, Tensor] = {}
    if scale := learner.discovery.bonus_scale(learner.self_play_has_begun):
        found["count_bonus"] = learner.discovery.bonus(learner.model, imagined.latent[1:], scale)
    if learner.config.surprise and learner.partners:
        actors = [*learner.partners.values(), learner.networks.rollout_actor]
        found["surprise_bonus"] = surprise_bonus(learner.config, actors, imagined)
    return found
