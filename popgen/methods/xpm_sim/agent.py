"""One member's learner: XPM-Sim on trajectories of the exact dynamics F (paper, section 3, eq. XPM-Sim).

    J(j) = u J_SP(j | starts in SP states) + w J_SP(j | starts in XP states) - lambda_XP max_k J_XP(j, k | XP states)

The paper's one J_SP draws its starts from both buffers (u = w = 1/2 if evenly); here each kind of start is a group with
a mean of its own, so that its weight against lambda_XP does not depend on how many trajectories each kind has.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from popgen.envs.contract import BatchedEnv, EnvSpec
from popgen.losses.policy_losses import (
    bound_advantage,
    clipped_loss,
    floor_reward,
    linear_schedule,
    reinforce,
    signed_advantage,
)
from popgen.methods.xpm_sim.advantages import Actions, WeightedActions
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_sim.critics import CriticBatch, Evaluation, MemberCritics
from popgen.methods.xpm_sim.encoded_policy import EncodedNet, EncodedPolicy
from popgen.methods.xpm_sim.shared_encoder import SharedEncoder
from popgen.methods.xpm_sim.simulation import BatchColumns, Partner, SimulatedBatch, Simulator
from popgen.methods.xpm_sim.simulation_starts import StartStates
from popgen.nets import weights as w
from popgen.nets.feed_forward import FeedForwardNet, orthogonal
from popgen.play.partner_strength import PartnerConstraint, any_or_strongest
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.types import Kind


@dataclass(frozen=True)
class PolicyTarget:
    """What the policy learns from one kind of play.

    Attributes:
        parts: its actions with signed advantages.
        lesson: what the critic of that play learns.
        spread: deviation of the advantages before they were signed; self-play's is the unit of all.
        figures: for the logs.
    """

    parts: Sequence[WeightedActions]
    lesson: CriticBatch
    spread: float
    figures: dict[str, float]


def make_actor(config: XpmSimConfig, spec: EnvSpec, seed: int = 0) -> FeedForwardPolicy:
    """A fresh policy that serves all seats: feed-forward, on the observation or on the shared encoder's latent."""
    view, shape = spec.views["features"], (spec.num_actions, spec.num_players)
    sizes: dict[str, Any] = {"units": config.units, "layers": config.layers, "activation": config.activation}
    if config.encoder == "none":
        return FeedForwardPolicy(view, *shape, **sizes, seed=seed)
    encoder = {name: getattr(config, name) for name in ("latent", "encoder_units", "encoder_layers")}
    return EncodedPolicy(view, *shape, **sizes, **encoder, seed=seed)


def self_play_target(config: XpmSimConfig, batch: SimulatedBatch, evaluation: Evaluation) -> PolicyTarget:
    """+J_SP from both kinds of starts; every seat learns from the joint advantage."""
    columns, advantage = batch.columns, evaluation.advantage
    spread = advantage[batch.valid[:, columns.self_play]].std().clamp(min=1e-6)
    # Centred as usual: a shift of all advantages only adds noise.
    signed = signed_advantage(Kind.SP, advantage - advantage.mean(), weight=1.0, unit=spread)
    parts = []
    for part, weight in ((columns.started, config.sp_weight), (columns.restarted, config.restart_weight)):
        for seat in range(players := batch.actions.shape[-1]):
            seats = torch.full((part.stop - part.start,), seat)
            actions = Actions.of_seats(batch, part, seats, signed[:, part])
            parts.append(WeightedActions(actions, weight / players))
    figures = {"advantage_sp": float(spread), "return_sp": float(evaluation.lesson.returns.mean())}
    return PolicyTarget(parts, evaluation.lesson, float(spread), figures)


def cross_play_target(
    batch: SimulatedBatch, evaluation: Evaluation, *, weight: float, unit: float, clip: float
) -> PolicyTarget:
    """-lambda_XP J_XP: advantages are divided by self-play's `unit` and clipped to +-`clip` units (0: no bound)."""
    advantage = evaluation.advantage
    bounded = bound_advantage(advantage, clip=clip, unit=unit)
    signed = signed_advantage(Kind.XP, bounded, weight=weight, unit=unit)
    seats = torch.from_numpy(batch.columns.seats)
    parts = [WeightedActions(Actions.of_seats(batch, batch.columns.cross_play, seats, signed), 1.0)]
    figures = {"advantage_xp": float(advantage.std()), "return_xp": float(evaluation.lesson.returns.mean())}
    return PolicyTarget(parts, evaluation.lesson, figures["advantage_xp"], figures | {"lambda": weight})


def simulated_figures(batch: SimulatedBatch, horizon: int) -> dict[str, float]:
    """Reward and score per simulated step, by kind of column, brought to the length of an episode."""
    columns, figures = batch.columns, {}
    for name, part in (("sp", columns.started), ("restart", columns.restarted), ("xp", columns.cross_play)):
        if part.stop > part.start:
            valid = batch.valid[:, part]
            figures[f"simulated_reward_{name}"] = float(batch.reward[:, part][valid].mean()) * horizon
            figures[f"simulated_score_{name}"] = float(batch.score[:, part][valid].mean()) * horizon
    return figures


def frozen_actor(config: XpmSimConfig, spec: EnvSpec, weights: w.Weights) -> FeedForwardPolicy:
    """A predecessor's policy, which does not learn."""
    actor = make_actor(config, spec)
    w.load_weights(actor.net, weights)
    actor.net.requires_grad_(False)
    return actor


class XpmSimLearner:
    """Actor, self-play critic and cross-play critics of member `member` beside frozen predecessors.

    Args:
        config: of the method.
        env: a batch of at least one environment of the run; serves as F and encodes.
        member: its number.
        seed: of weights, simulations and draws.
        partners: predecessor -> its policy's weights.
        encoder: state of the shared encoder after the member before, if there is one.
    """

    def __init__(
        self,
        config: XpmSimConfig,
        env: BatchedEnv,
        member: int,
        seed: int,
        partners: Mapping[int, w.Weights],
        encoder: dict[str, Any] | None = None,
    ) -> None:
        self.config, self.env, self.member = config, env, member
        self.starts = StartStates(config, env, member, seed + 1)
        self.simulator = Simulator(config, self.starts, seed + 4)
        self.generator = torch.Generator().manual_seed(seed + 5)
        self.rng = np.random.default_rng(seed + 6)
        self.actor = make_actor(config, env.spec, seed)
        self.encoder = None if config.encoder == "none" else SharedEncoder(config, env.spec, member, seed + 8)
        if self.encoder is not None and encoder is not None:
            self.encoder.load_state(encoder)
        head = self._attach_encoder()
        orthogonal(head, 0.01, torch.Generator().manual_seed(seed))
        self.partners = {k: frozen_actor(config, env.spec, weights) for k, weights in sorted(partners.items())}
        self.partner_scores: dict[int, float] = {}
        self.constraint = PartnerConstraint(config.xp_limit, config.multiplier_step)
        self.updates = self.simulated = self.trajectories = 0
        self.evaluator = MemberCritics(config, env.spec, self.partners, self.encoder, seed + 7)
        self.critics = self.evaluator.nets
        rate = config.learning_rate
        self.trained = list(head.parameters())
        self.actor_optimiser = torch.optim.Adam(self.trained, lr=rate, eps=1e-5)
        self.critic_optimiser = torch.optim.Adam(self.critics.parameters(), lr=rate, eps=1e-5)

    def _attach_encoder(self) -> FeedForwardNet:
        """The actor's part that learns; what comes before it is the shared encoder, if there is one."""
        net = self.actor.net
        if self.encoder is None:
            assert isinstance(net, FeedForwardNet)
            return net
        assert isinstance(net, EncodedNet)
        net.encoder = self.encoder.vae.encoder
        return net.head

    # ---- one update ----------------------------------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """Simulate a batch, compute the objective on it, and step actor and critics; the batch's figures."""
        partner = self.choose_partner()
        other = None if partner is None else Partner(partner, self.partners[partner].net)
        batch = self.simulator.run(self.batch_columns(partner), self.actor.net, other)
        self.simulated += batch.steps
        self.trajectories += batch.count
        targets = [self_play_target(self.config, batch, self.evaluator.evaluate_self_play(batch))]
        if partner is not None:
            targets.append(self.cross_play(batch, partner, targets[0].spread))
        figures = {name: value for target in targets for name, value in target.figures.items()}
        actions = Actions.join([part for target in targets for part in target.parts])
        figures |= self._learn_batch(actions, [target.lesson for target in targets])
        if self.encoder is not None:
            figures |= self.encoder.update(self.starts)
        self.updates += 1
        return figures | simulated_figures(batch, self.env.spec.horizon)

    def cross_play(self, batch: SimulatedBatch, partner: int, unit: float) -> PolicyTarget:
        """What the cross-play columns with `partner` teach, in self-play's `unit`."""
        floored = replace(batch, reward=floor_reward(batch.reward, batch.covered, self.config.xp_floor))
        evaluation = self.evaluator.evaluate_cross_play(floored, partner)
        weight = self.lambda_now() * self.constraint.pressure(list(self.partners))
        target = cross_play_target(batch, evaluation, weight=weight, unit=unit, clip=self.config.xp_clip)
        return replace(target, figures=target.figures | {"partner": float(partner)})

    def batch_columns(self, partner: int | None) -> BatchColumns:
        """The columns of a batch: no cross-play without a partner, no restarts without their weight."""
        config = self.config
        restart = config.sims_restart if self.partners and config.restart_weight else 0
        return BatchColumns(config.sims_sp, restart, 0 if partner is None else config.sims_xp)

    def choose_partner(self) -> int | None:
        """The strongest by the latest real cross-play, at times a random one; under a constraint one that is drawn in
        proportion to the multipliers. None in pure self-play."""
        if not self.partners or self.lambda_now() == 0.0 or not self.config.sims_xp:
            return None
        if self.config.xp_limit is not None:
            return self.constraint.draw_partner(list(self.partners), self.rng)
        return any_or_strongest(self.partners, self.partner_scores, self.config.partner_random, self.rng)

    def lambda_now(self) -> float:
        """lambda_XP of this update, rising linearly over the first `lambda_ramp`; 0 after the share `lambda_until`."""
        config = self.config
        if self.updates >= config.lambda_until * config.updates:
            return 0.0
        return linear_schedule(0.0, config.lambda_xp, self.updates + 1, config.lambda_ramp)

    # ---- losses --------------------------------------------------------------------------------------------------

    def _learn_batch(self, actions: Actions, lessons: Sequence[CriticBatch]) -> dict[str, float]:
        """`epochs` passes over the batch in `minibatches`; means of the losses and of the policy's figures."""
        self.evaluator.update_statistics(lessons)
        totals: list[dict[str, float]] = []
        for _ in range(self.config.epochs):
            parts = self._shuffle_rows(len(actions.action))
            minibatches = [self._shuffle_rows(len(lesson.returns)) for lesson in lessons]
            for number, part in enumerate(parts):
                figures = self._step_actor(actions[part])
                now = [lesson[rows[number]] for lesson, rows in zip(lessons, minibatches, strict=True)]
                totals.append(figures | self._step_critics(now))
        return {name: float(np.mean([figures[name] for figures in totals])) for name in totals[0]}

    def _shuffle_rows(self, count: int) -> tuple[Tensor, ...]:
        order = torch.randperm(count, generator=self.generator)
        return torch.tensor_split(order, self.config.minibatches)

    def _step_actor(self, part: Actions) -> dict[str, float]:
        config = self.config
        log_probs = torch.log_softmax(self.actor.net(part.obs, self.simulator.seats[part.seat]), -1)
        log_prob = log_probs.gather(-1, part.action.unsqueeze(-1)).squeeze(-1)
        entropy = -(log_probs.exp() * log_probs).sum(-1)
        if config.surrogate == "reinforce":
            loss = reinforce(log_prob, part.advantage, entropy, part.weight, entropy_scale=config.entropy)
        else:
            terms = (log_prob, part.log_prob, part.advantage, entropy, part.weight)
            loss = clipped_loss(*terms, clip=config.clip, entropy_scale=config.entropy)
        self._step_optimiser(self.actor_optimiser, loss, self.trained)
        with torch.no_grad():
            change = log_prob - part.log_prob
            kl = float((change.exp() - 1.0 - change).mean())
            clipped = float(((change.exp() - 1.0).abs() > config.clip).float().mean())
        return {
            "actor_loss": float(loss.detach()),
            "entropy": float(entropy.detach().mean()),
            "kl": kl,
            "clipped": clipped,
        }

    def _step_critics(self, lessons: Sequence[CriticBatch]) -> dict[str, float]:
        losses = self.evaluator.losses(lessons)
        total = sum(losses.values(), torch.zeros(()))
        self._step_optimiser(self.critic_optimiser, total, self.critics.parameters())
        return {name: float(loss.detach()) for name, loss in losses.items()}

    def _step_optimiser(
        self, optimiser: torch.optim.Optimizer, loss: Tensor, parameters: Iterable[nn.Parameter]
    ) -> None:
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        w.clip_gradients(parameters, self.config.grad_clip)
        optimiser.step()

    # ---- what is kept --------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything to continue from exactly here; partners are given again."""
        return {
            "actor": w.weights_of(self.actor.net),
            "critics": w.weights_of(self.critics),
            "actor_optimiser": w.optimiser_state(self.actor_optimiser),
            "critic_optimiser": w.optimiser_state(self.critic_optimiser),
            "generator": self.generator.get_state().numpy(),
            "rng": self.rng.bit_generator.state,
            "starts": self.starts.state(),
            "simulator": self.simulator.state(),
            "updates": self.updates,
            "simulated": self.simulated,
            "trajectories": self.trajectories,
            "partner_scores": {str(k): v for k, v in self.partner_scores.items()},
            "constraint": self.constraint.state(),
            "encoder": None if self.encoder is None else self.encoder.state(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()` of a learner of the same member and partners."""
        w.load_weights(self.actor.net, state["actor"])
        if self.encoder is not None:
            self.encoder.load_state(state["encoder"])
        w.load_weights(self.critics, state["critics"])
        w.load_optimiser_state(self.actor_optimiser, state["actor_optimiser"])
        w.load_optimiser_state(self.critic_optimiser, state["critic_optimiser"])
        self.generator.set_state(torch.from_numpy(np.array(state["generator"])))
        self.rng.bit_generator.state = state["rng"]
        self.starts.load_state(state["starts"])
        self.simulator.load_state(state["simulator"])
        self.updates, self.simulated = int(state["updates"]), int(state["simulated"])
        self.trajectories = int(state["trajectories"])
        self.partner_scores = {int(k): float(v) for k, v in state["partner_scores"].items()}
        self.constraint.load_state(state["constraint"])
