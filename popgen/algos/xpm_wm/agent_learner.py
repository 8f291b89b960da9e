"""One member's learner: imagined self-play and cross-play, and the XPM-Sim objective (paper, eq. XPM-Sim).

J(j) = J_SP(j | starts in SP and XP states) - lambda_XP max_k J_XP(j, k | starts in XP states)
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from torch import Tensor

from popgen.algos.xpm_wm.starts import Starts, draw_cross_play, draw_self_play
from popgen.config import AgentConfig, WorldModelConfig
from popgen.envs.base import EnvSpec
from popgen.losses.actor_critic import ReturnScale, reinforce
from popgen.losses.diversity import signed_advantage
from popgen.losses.returns import lambda_return
from popgen.nets import weights as w
from popgen.nets.actor_critic import Actor, Critic
from popgen.nets.latents import Latent, from_indices
from popgen.types import Kind
from popgen.world_model.imagination import Imagined, imagine
from popgen.world_model.model import WorldModel

SELF = 0
"""Key of the self-play critic among the critics; cross-play critics are keyed by partner."""


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
    started. All tensors are on `device`; weights come and
    go as arrays. What the generators give differs between kinds of devices, initial weights do not.
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
        self.actor_optimiser = torch.optim.Adam(self.actor.parameters(), lr=self.config.actor_lr, eps=1e-8)
        self.critic_optimiser = torch.optim.Adam(self.critics.parameters(), lr=self.config.critic_lr, eps=1e-8)
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
        """Imagine, compute the XPM-Sim objective, and take one step of actor and critics."""
        partner = self.choose_partner()
        imagined, seats = self._imagine(partner)
        sp_rows = self.config.starts_sp
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.dtype is torch.bfloat16):
            actor_loss, critic_loss, metrics = self._self_play_losses(_rows(imagined, slice(None, sp_rows)))
            if partner is not None:
                cross = _rows(imagined, slice(sp_rows, None))
                actor_xp, critic_xp, metrics_xp = self._cross_play_losses(cross, partner, seats)
                actor_loss, critic_loss = actor_loss + actor_xp, critic_loss + critic_xp
                metrics |= metrics_xp
        self._step(self.actor_optimiser, actor_loss, self.actor.parameters())
        self._step(self.critic_optimiser, critic_loss, self.critics.parameters())
        self._follow()
        self.updates += 1
        self.playing += self.plays
        return metrics

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

        Advantages are divided by the spread of returns, which grows tenfold once dishes are delivered: a scale that
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

    def _policy_terms(self, latent: Latent, seat: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Log-probability of the taken actions and entropy, both (H, B[, P])."""
        log_probs = self.actor.log_probs(latent, seat)
        taken = log_probs.gather(-1, actions.unsqueeze(-1)).squeeze(-1)
        return taken, -(log_probs.exp() * log_probs).sum(-1)

    def _self_play_losses(self, imagined: Imagined) -> tuple[Tensor, Tensor, dict[str, float]]:
        steps, batch = imagined.reward.shape
        latent = imagined.latent[:-1]
        seat = torch.zeros(steps + 1, batch, dtype=torch.long, device=self.device)
        returns, value = self._targets(imagined, SELF, seat)
        scale = self.scale.update(returns)
        advantage = signed_advantage(Kind.SP, returns - value[:-1], weight=1.0, scale=scale)
        pair = Latent(*(x.unsqueeze(2).expand(*x.shape[:2], 2, x.shape[-1]) for x in (latent.h, latent.z)))
        both = torch.tensor([0, 1], device=self.device).expand(steps, batch, 2)
        log_prob, entropy = self._policy_terms(pair, both, imagined.actions)
        running = imagined.running.unsqueeze(-1)
        actor_loss = reinforce(log_prob, advantage.unsqueeze(-1), entropy, running, entropy_scale=self.entropy_now())
        critic_loss = (imagined.running * self.critics[str(SELF)].loss(latent, seat[:-1], returns)).mean()
        metrics = {
            "entropy": float(entropy.detach().mean()),
            "entropy_scale": self.entropy_now(),
            "return_scale": float(scale),
            "imagined_shaped_sp": float(imagined.reward.mean()),
            "imagined_return_sp": float(returns.mean()),
            "value_sp": float(value.mean()),
            "advantage_sp": float(advantage.std()),
            "critic_loss_sp": float(critic_loss.detach()),
        }
        return actor_loss, critic_loss, metrics

    def _cross_play_losses(
        self, imagined: Imagined, partner: int, seats: Tensor
    ) -> tuple[Tensor, Tensor, dict[str, float]]:
        steps, batch = imagined.reward.shape
        latent, seat = imagined.latent[:-1], seats.expand(steps, batch)
        returns, value = self._targets(imagined, partner, seats.expand(steps + 1, batch))
        weight = self.lambda_now()
        advantage = signed_advantage(Kind.XP, returns - value[:-1], weight=weight, scale=self.scale.value())
        own = imagined.actions.gather(-1, seat.unsqueeze(-1)).squeeze(-1)
        log_prob, entropy = self._policy_terms(latent, seat, own)
        actor_loss = reinforce(
            log_prob, advantage, entropy, imagined.running, entropy_scale=self.entropy_now() * weight
        )
        critic_loss = (imagined.running * self.critics[str(partner)].loss(latent, seat, returns)).mean()
        reward = float(imagined.reward.mean())
        self.imagined_scores[partner] = 0.95 * self.imagined_scores.get(partner, reward) + 0.05 * reward
        metrics = {
            "imagined_shaped_xp": reward,
            "imagined_return_xp": float(returns.mean()),
            "advantage_xp": float(advantage.std()),
            "critic_loss_xp": float(critic_loss.detach()),
            "partner": float(partner),
        }
        return actor_loss, critic_loss, metrics

    def _step(self, optimiser: torch.optim.Optimizer, loss: Tensor, parameters: Any) -> None:
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
        self.updates, self.playing = state["updates"], state["playing"]
        self.partner_scores = {int(k): v for k, v in state["partner_scores"].items()}
        self.imagined_scores = {int(k): v for k, v in state["imagined_scores"].items()}


def _rows(imagined: Imagined, rows: slice) -> Imagined:
    """Part of the batch."""
    return Imagined(
        Latent(imagined.latent.h[:, rows], imagined.latent.z[:, rows]),
        imagined.actions[:, rows],
        imagined.reward[:, rows],
        imagined.keep[:, rows],
        imagined.running[:, rows],
    )
