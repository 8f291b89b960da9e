"""One member's learner: imagined self-play and cross-play, and the XPM-Sim objective (paper, eq. XPM-Sim).

J(j) = J_SP(j | starts in SP and XP states) - lambda_XP max_k J_XP(j, k | starts in XP states)

By REINFORCE, as in the paper, or by PPO's clipped surrogate in several passes over what was imagined.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from popgen.envs.contract import EnvSpec
from popgen.losses.diversity import signed_advantage
from popgen.losses.ppo import clipped_loss
from popgen.losses.reinforce import ReturnScale, reinforce
from popgen.losses.returns import lambda_return
from popgen.methods.xpm_wm.actor_critic import Actor, Critic
from popgen.methods.xpm_wm.config import AgentConfig, WorldModelConfig
from popgen.methods.xpm_wm.imagination import Imagined, imagine
from popgen.methods.xpm_wm.latents import Latent, from_indices
from popgen.methods.xpm_wm.policy_samples import Samples
from popgen.methods.xpm_wm.start_states import Starts, draw_cross_play, draw_self_play
from popgen.methods.xpm_wm.world_model import WorldModel
from popgen.nets import weights as w
from popgen.types import Kind

SELF = 0
"""Key of the self-play critic among the critics; cross-play critics are keyed by partner."""

LEAST_SPREAD = 0.1
"""Of self-play's advantages, in units of reward: where nothing is at stake, noise is not blown up."""


def rollout_dtype(precision: str, device: torch.device = torch.device("cpu")) -> torch.dtype:  # noqa: B008
    """`auto` takes bfloat16 where the device multiplies it natively, which is several times faster, else float32."""
    if precision == "auto":
        cpu = getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
        native = torch.cuda.is_bf16_supported if device.type == "cuda" else cpu
        precision = "bfloat16" if native() else "float32"
    return getattr(torch, precision)


class AgentLearner:
    """Actor, one self-play critic and one cross-play critic per partner of member `member`.

    Set the world model, start states and partners, then call `update`; set `plays` as soon as real self-play has
    started. All tensors are on `device`; weights come and go as arrays. What the generators give differs between kinds
    of devices, initial weights do not.
    """

    def __init__(
        self,
        config: AgentConfig,
        model_config: WorldModelConfig,
        spec: EnvSpec,
        member: int,
        seed: int,
        device: str | torch.device = "cpu",
    ) -> None:
        self.config, self.model_config, self.spec, self.member = config, model_config, spec, member
        self.device = torch.device(device)
        self.dtype = rollout_dtype(config.precision, self.device)
        self.generator = torch.Generator(self.device).manual_seed(seed + 1)
        self.rng = np.random.default_rng(seed + 2)
        self.model = WorldModel(model_config, spec).to(self.device, self.dtype).eval().requires_grad_(False)
        self.partners: dict[int, Actor] = {}
        self.starts: Starts | None = None
        self.new_share = 0.0
        self.partner_scores: dict[int, float] = {}
        self.imagined_scores: dict[int, float] = {}
        self.plays = False
        self.restart(seed)

    def restart(self, seed: int) -> None:
        """Fresh actor, critics and return scale: the world model stays."""
        torch.manual_seed(seed)
        self.actor = Actor(self.config, self.model_config, self.spec.num_actions).to(self.device)
        self.critics = torch.nn.ModuleDict()
        self.scale = ReturnScale(self.config.return_percentiles).to(self.device)
        self._add_critic(SELF)
        for partner in self.partners:
            self._add_critic(partner)
        self.slow = copy.deepcopy(self.critics).requires_grad_(False)
        self._make_optimisers()
        self.updates = self.playing = 0

    def _add_critic(self, key: int) -> None:
        self.critics[str(key)] = Critic(self.config, self.model_config).to(self.device)

    def _make_optimisers(self) -> None:
        eps = self.config.adam_eps
        self.actor_optimiser = torch.optim.Adam(self.actor.parameters(), lr=self.config.actor_lr, eps=eps)
        self.critic_optimiser = torch.optim.Adam(self.critics.parameters(), lr=self.config.critic_lr, eps=eps)
        self.rollout_actor = copy.deepcopy(self.actor).to(self.dtype).requires_grad_(False)

    def add_partner(self, member: int, actor_weights: w.Weights) -> None:
        """A frozen predecessor, with a critic of its own; it acts on the current world model's latents."""
        actor = Actor(self.config, self.model_config, self.spec.num_actions)
        w.load_weights(actor, actor_weights)
        self.partners[member] = actor.to(self.device, self.dtype).eval().requires_grad_(False)
        self._add_critic(member)
        self.slow = copy.deepcopy(self.critics).requires_grad_(False)
        self._make_optimisers()

    def set_model(self, weights: w.Weights) -> None:
        """The world model to imagine with, in the rollout's precision."""
        w.load_weights(self.model, weights, cast=True)

    def set_starts(self, starts: Starts, new_share: float) -> None:
        """States to start from; `new_share` of the draws come from this member's own data."""
        self.starts, self.new_share = starts, new_share

    def choose_partner(self) -> int | None:
        """The strongest cross-play partner, at times a random one; None in pure self-play.

        Scores are real returns of each partner's latest window in B_XP; a partner without any comes first, the
        one with the highest imagined return leading. Randomness keeps the other partners' estimates fresh.
        """
        if not self.partners or self.config.lambda_xp == 0.0:
            return None
        members = sorted(self.partners)
        if self.rng.random() < self.config.partner_random:
            return int(self.rng.choice(members))
        unseen = [k for k in members if k not in self.partner_scores]
        if unseen:
            return max(unseen, key=lambda k: self.imagined_scores.get(k, float("inf")))
        return max(members, key=lambda k: self.partner_scores[k])

    def update(self) -> dict[str, float]:
        """Imagine, compute the XPM-Sim objective, and step actor and critics over the batch; mean figures."""
        partner = self.choose_partner()
        imagined, seats = self._imagine(partner)
        sp_rows = self.config.starts_sp
        with self._autocast():
            own, unit, figures = self._self_play(_rows(imagined, slice(None, sp_rows)))
            samples = [own]
            if partner is not None:
                cross, more = self._cross_play(_rows(imagined, slice(sp_rows, None)), partner, seats, unit)
                samples, figures = [own, cross], figures | more
        figures |= self._learn(samples)
        self._follow()
        self.updates += 1
        self.playing += self.plays
        return figures

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.dtype is torch.bfloat16)

    def _start_rows(self, rows: np.ndarray) -> Latent:
        starts = self.starts
        z = from_indices(torch.from_numpy(starts.z[rows]).to(self.device), self.model_config.classes).flatten(-2)
        return Latent(torch.from_numpy(starts.h[rows]).to(self.device, self.dtype), z.to(self.dtype))

    def lambda_now(self) -> float:
        """lambda_XP of this update: rising from `lambda_start`, if that is less, to `lambda_xp` over
        `lambda_ramp` updates.

        Cross-play pressure must be there from the first update, or the member settles on its predecessor's
        convention; at full strength from the start it keeps self-play from starting at all.
        """
        end, ramp = self.config.lambda_xp, self.config.lambda_ramp
        start = min(self.config.lambda_start, end)
        return end if not ramp else start + (end - start) * min(1.0, self.updates / ramp)

    def entropy_now(self) -> float:
        """Entropy scale of this update: `entropy` until self-play has started, then falling to `entropy_end` within
        `entropy_ramp` updates, by the same factor in each.

        In units of the returns' range, which grows tenfold once dishes are delivered, advantages shrink: a scale that
        lets self-play start would then win over them, and the policy would get more random the better it plays.
        """
        config = self.config
        if not config.entropy_ramp or not self.playing:
            return config.entropy
        share = min(1.0, self.playing / config.entropy_ramp)
        end = min(config.entropy_end, config.entropy)
        return config.entropy * (end / config.entropy) ** share if end else config.entropy * (1.0 - share)

    def _imagine(self, partner: int | None) -> tuple[Imagined, Tensor]:
        """Self-play rows and, after them, cross-play rows in one batch; the agent's seat in the latter."""
        if self.starts is None:
            raise RuntimeError("set_starts before update")
        config = self.config
        rows = draw_self_play(self.starts, config.starts_sp, self.new_share, config.sp_from_xp, self.rng)
        count = config.starts_xp if partner is not None else 0
        if count:
            only = partner if config.xp_starts == "partner" else None
            rows = np.concatenate([rows, draw_cross_play(self.starts, count, self.new_share, only, self.rng)])
        order = torch.arange(count, device=self.device)
        seats, partner_rows = (order >= count // 2).long(), config.starts_sp + order
        partner_actor = self.partners[partner] if count else None
        both = torch.tensor([0, 1], device=self.device)

        def act(latent: Latent) -> Tensor:
            pair = Latent(*(x.unsqueeze(-2).expand(*x.shape[:-1], 2, x.shape[-1]) for x in (latent.h, latent.z)))
            actions = self.rollout_actor.sample(pair, both.expand(pair.h.shape[:-1]), self.generator)
            if partner_actor is not None:
                theirs = partner_actor.sample(latent[config.starts_sp :], 1 - seats, self.generator)
                actions[partner_rows, 1 - seats] = theirs
            return actions

        return imagine(self.model, act, self._start_rows(rows), config.horizon, self.generator), seats

    def _targets(self, imagined: Imagined, key: int, seat: Tensor) -> tuple[Tensor, Tensor]:
        """Lambda-returns (H, B) and values (H + 1, B), from the slow critic, no gradient."""
        with torch.no_grad():
            value = self.slow[str(key)].value(imagined.latent, seat)
            returns = lambda_return(imagined.reward, value, self.config.discount * imagined.keep, self.config.lam)
        return returns, value

    def _self_play(self, imagined: Imagined) -> tuple[Samples, Tensor, dict[str, float]]:
        """What self-play teaches, the unit of all advantages, and figures."""
        steps, batch = imagined.reward.shape
        players = torch.tensor([0, 1], device=self.device).expand(batch, 2)
        returns, value = self._targets(imagined, SELF, players[:, 0].expand(steps + 1, batch))
        advantage, scale = returns - value[:-1], self.scale.update(returns)
        unit = scale
        if self.config.advantage_unit == "spread":  # centred as usual: a shift of all advantages only adds noise
            running = advantage[imagined.running > 0.5]
            advantage, unit = advantage - running.mean(), running.std().clamp(min=LEAST_SPREAD)
        signed = signed_advantage(Kind.SP, advantage, weight=1.0, scale=unit)
        figures = {
            "entropy_scale": self.entropy_now(),
            "return_scale": float(scale),
            "imagined_shaped_sp": float(imagined.reward.mean()),
            "imagined_return_sp": float(returns.mean()),
            "value_sp": float(value.mean()),
            "advantage_sp": float(advantage.std()),
        }
        samples = Samples.of(imagined, SELF, players, returns, signed, self.entropy_now())
        return self._with_log_probs(samples), unit, figures

    def _cross_play(
        self, imagined: Imagined, partner: int, seats: Tensor, unit: Tensor
    ) -> tuple[Samples, dict[str, float]]:
        """The same for cross-play, whose advantages enter with -lambda_XP in units of self-play's."""
        steps, batch = imagined.reward.shape
        returns, value = self._targets(imagined, partner, seats.expand(steps + 1, batch))
        advantage, weight = returns - value[:-1], self.lambda_now()
        signed = signed_advantage(Kind.XP, advantage, weight=weight, scale=unit)
        reward = float(imagined.reward.mean())
        self.imagined_scores[partner] = 0.95 * self.imagined_scores.get(partner, reward) + 0.05 * reward
        figures = {
            "imagined_shaped_xp": reward,
            "imagined_return_xp": float(returns.mean()),
            "advantage_xp": float(advantage.std()),
            "lambda": weight,
            "partner": float(partner),
        }
        samples = Samples.of(imagined, partner, seats.unsqueeze(-1), returns, signed, self.entropy_now() * weight)
        return self._with_log_probs(samples), figures

    def _with_log_probs(self, samples: Samples) -> Samples:
        """With those of the actions under the present policy, where the surrogate compares with them."""
        if self.config.surrogate == "reinforce":
            return samples
        with torch.no_grad():
            return replace(samples, log_prob=self._policy_terms(samples)[0])

    def _policy_terms(self, samples: Samples) -> tuple[Tensor, Tensor]:
        """Log-probability of the taken actions and entropy, both (R, K)."""
        latent, seats = samples.latent, samples.seats
        seen = Latent(*(x.unsqueeze(1).expand(*seats.shape, x.shape[-1]) for x in (latent.h, latent.z)))
        log_probs = self.actor.log_probs(seen, seats)
        taken = log_probs.gather(-1, samples.actions.unsqueeze(-1)).squeeze(-1)
        return taken, -(log_probs.exp() * log_probs).sum(-1)

    def _learn(self, samples: list[Samples]) -> dict[str, float]:
        """`epochs` passes over the batch in `minibatches`, of every kind of samples its share; mean figures."""
        config, totals = self.config, []
        for _ in range(config.epochs):
            parts = [part.split(config.minibatches, self.generator) for part in samples]
            totals += [self._step(list(together)) for together in zip(*parts, strict=True)]
        return {name: float(np.mean([figures[name] for figures in totals])) for name in totals[0]}

    def _step(self, parts: list[Samples]) -> dict[str, float]:
        """One step of the actor and of the critics that the samples are of."""
        with self._autocast():
            losses = [self._losses(part) for part in parts]
        self._descend(self.actor_optimiser, sum(actor for actor, _, _ in losses), self.actor.parameters())
        self._descend(self.critic_optimiser, sum(critic for _, critic, _ in losses), self.critics.parameters())
        figures = losses[0][2]  # of the policy in self-play
        for part, (_, critic, _) in zip(parts, losses, strict=True):
            figures["critic_loss_sp" if part.key == SELF else "critic_loss_xp"] = float(critic.detach())
        return figures

    def _losses(self, samples: Samples) -> tuple[Tensor, Tensor, dict[str, float]]:
        """Of the policy and of the critic, to be minimised, and the policy's figures."""
        log_prob, entropy = self._policy_terms(samples)
        advantage, running = samples.advantage.unsqueeze(-1), samples.running.unsqueeze(-1)
        figures = {"entropy": float(entropy.detach().mean())}
        if samples.log_prob is None:
            policy = reinforce(log_prob, advantage, entropy, running, entropy_scale=samples.entropy_scale)
        else:
            given = (log_prob, samples.log_prob, advantage, entropy, running)
            policy = clipped_loss(*given, clip=self.config.clip, entropy_scale=samples.entropy_scale)
            change = (log_prob.detach() - samples.log_prob).exp() - 1.0
            figures["clipped"] = float((change.abs() > self.config.clip).float().mean())
        critic = self.critics[str(samples.key)].loss(samples.latent, samples.seat, samples.returns)
        return policy, (samples.running * critic).mean(), figures

    def _descend(self, optimiser: torch.optim.Optimizer, loss: Any, parameters: Any) -> None:
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, self.config.grad_clip)
        optimiser.step()

    @torch.no_grad()
    def _follow(self) -> None:
        """Slow critics move towards the fast ones; the rollout copy of the actor is refreshed."""
        for slow, fast in zip(self.slow.parameters(), self.critics.parameters(), strict=True):
            slow.lerp_(fast, 1.0 - self.config.slow_critic)
        for rollout, trained in zip(self.rollout_actor.parameters(), self.actor.parameters(), strict=True):
            rollout.copy_(trained)

    def actor_weights(self) -> w.Weights:
        """What a sampler needs of this member besides the world model's filter."""
        return w.weights_of(self.actor)

    def state(self) -> dict[str, Any]:
        """Everything to go on from exactly here, except the world model and the start states."""
        return {
            "actor": w.weights_of(self.actor),
            "critics": w.weights_of(self.critics),
            "slow": w.weights_of(self.slow),
            "scale": w.weights_of(self.scale),
            "actor_optimiser": w.optimiser_state(self.actor_optimiser),
            "critic_optimiser": w.optimiser_state(self.critic_optimiser),
            "generator": self.generator.get_state().numpy(),
            "rng": self.rng.bit_generator.state,
            "updates": self.updates,
            "playing": self.playing,
            "partner_scores": {str(k): v for k, v in self.partner_scores.items()},
            "imagined_scores": {str(k): v for k, v in self.imagined_scores.items()},
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over `state()`; the partners must have been added before."""
        for name in ("actor", "critics", "slow", "scale"):
            w.load_weights(getattr(self, name), state[name])
        w.load_weights(self.rollout_actor, state["actor"], cast=True)
        w.load_optimiser_state(self.actor_optimiser, state["actor_optimiser"])
        w.load_optimiser_state(self.critic_optimiser, state["critic_optimiser"])
        self.generator.set_state(torch.from_numpy(np.array(state["generator"])))
        self.rng.bit_generator.state = state["rng"]
        self.updates, self.playing = int(state["updates"]), int(state["playing"])
        self.partner_scores = {int(k): float(v) for k, v in state["partner_scores"].items()}
        self.imagined_scores = {int(k): float(v) for k, v in state["imagined_scores"].items()}


def _rows(imagined: Imagined, rows: slice) -> Imagined:
    """Part of the batch."""
    return Imagined(
        Latent(imagined.latent.h[:, rows], imagined.latent.z[:, rows]),
        imagined.actions[:, rows],
        imagined.reward[:, rows],
        imagined.keep[:, rows],
        imagined.running[:, rows],
    )
