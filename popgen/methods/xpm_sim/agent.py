"""One member's learner: XPM-Sim on trajectories of the exact dynamics F (paper, section 3, eq. XPM-Sim).

    J(j) = u J_SP(j | starts in SP states) + w J_SP(j | starts in XP states) - lambda_XP max_k J_XP(j, k | XP states)

The paper's one J_SP draws its starts from both buffers (u = w = 1/2 if evenly); here each kind of start is a group with
a mean of its own, so that its weight against lambda_XP does not depend on how many trajectories each kind has.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from popgen.envs.contract import BatchedEnv, EnvSpec
from popgen.losses.diversity import signed_advantage
from popgen.losses.ppo import clipped_loss
from popgen.losses.reinforce import reinforce
from popgen.methods.xpm_sim.advantages import Actions, advantages
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_sim.shared_encoder import SharedEncoder
from popgen.methods.xpm_sim.simulation import Batch, Layout, Simulator
from popgen.methods.xpm_sim.simulation_starts import StartStates
from popgen.methods.xpm_sim.vae import latent_view
from popgen.nets import weights as w
from popgen.nets.feed_forward import Sizes, ValueNet, joint, orthogonal
from popgen.policies.policy_registry import policy_class
from popgen.types import Kind

SELF, SHARED = "self", "cross"
"""Keys of the self-play critic and of the one shared by all partners; separate ones are keyed by the partner."""

Group = tuple[Actions, float]
"""Actions, and the weight of their mean in the policy loss."""

Inputs = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""What all seats see (R, P, *view.shape) in a group's columns (R,) -> a critic's observation and extras."""


@dataclass(frozen=True)
class Lesson:
    """What one critic learns from a batch: obs (R, *shape) and extras (R, X) that it sees, returns (R,)."""

    key: str
    obs: Tensor
    extras: Tensor
    returns: Tensor

    def __getitem__(self, rows: Tensor) -> Lesson:
        return Lesson(self.key, self.obs[rows], self.extras[rows], self.returns[rows])


def make_actor(config: XpmSimConfig, spec: EnvSpec, seed: int = 0) -> Any:
    """A fresh policy that serves all seats: feed-forward, on the observation or on the shared encoder's latent."""
    shape: dict[str, Any] = {"units": config.units, "layers": config.layers, "activation": config.activation}
    kind = "feed_forward"
    if config.encoder == "shared":
        kind = "encoded"
        shape |= {name: getattr(config, name) for name in ("latent", "encoder_units", "encoder_layers")}
    make = policy_class(kind)
    return make(spec.views["features"], spec.num_actions, spec.num_players, **shape, seed=seed)  # type: ignore[call-arg]


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
        partners: dict[int, w.Weights],
        encoder: dict[str, Any] | None = None,
    ) -> None:
        self.config, self.env, self.member = config, env, member
        self.starts = StartStates(config, env, member, seed + 1)
        self.simulator = Simulator(config, self.starts, seed + 4)
        self.generator = torch.Generator().manual_seed(seed + 5)
        self.rng = np.random.default_rng(seed + 6)
        self.actor = make_actor(config, env.spec, seed)
        self.encoder = None if config.encoder == "none" else SharedEncoder(config, env.spec, member, seed + 8)
        if self.encoder is not None:
            if encoder is not None:
                self.encoder.load_state(encoder)
            self.actor.net.encoder = self.encoder.vae.encoder
        head = self.actor.net if self.encoder is None else self.actor.net.head
        orthogonal(head, 0.01, torch.Generator().manual_seed(seed))
        self.partners: dict[int, Any] = {}
        for partner, weights in sorted(partners.items()):
            self.partners[partner] = make_actor(config, env.spec)
            w.load_weights(self.partners[partner].net, weights)
            self.partners[partner].net.requires_grad_(False)
        self.partner_scores: dict[int, float] = {}
        self.updates = self.simulated = self.trajectories = 0
        self._make_critics(seed + 7)
        rate = config.learning_rate
        self.trained = list(head.parameters())
        self.actor_optimiser = torch.optim.Adam(self.trained, lr=rate, eps=1e-5)
        self.critic_optimiser = torch.optim.Adam(self.critics.parameters(), lr=rate, eps=1e-5)

    def _make_critics(self, seed: int) -> None:
        config = self.config
        view = self.env.spec.views["features"] if self.encoder is None else latent_view(config.latent)
        generator = torch.Generator().manual_seed(seed)
        sizes = Sizes(config.units, config.layers, config.activation)
        players, known = self.env.spec.num_players, len(self.partners)
        self.critics = torch.nn.ModuleDict({SELF: ValueNet(view, 0, sizes, generator)})
        if known and config.xp_critic == "shared":
            self.critics[SHARED] = ValueNet(view, players + known, sizes, generator)
        elif known:
            self.critics.update({str(k): ValueNet(view, players, sizes, generator) for k in self.partners})

    # ---- one update ----------------------------------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """Simulate a batch, compute the objective on it, and step actor and critics; the batch's figures."""
        partner = self.choose_partner()
        layout = self._layout(partner)
        other = None if partner is None else (partner, self.partners[partner].net)
        batch = self.simulator.run(layout, self.actor.net, other)
        self.simulated += batch.steps
        self.trajectories += batch.trajectories
        groups, lessons, metrics = self._self_play(batch)
        if partner is not None:
            cross, lesson, more = self._cross_play(batch, partner, metrics["advantage_sp"])
            groups, lessons, metrics = [*groups, cross], [*lessons, lesson], metrics | more
        metrics |= self._learn(Actions.join(groups), lessons)
        if self.encoder is not None:
            metrics |= self.encoder.update(self.starts)
        self.updates += 1
        return metrics | self._seen(batch)

    def _layout(self, partner: int | None) -> Layout:
        config = self.config
        restart = config.sims_restart if self.partners and config.restart_weight else 0
        return Layout(config.sims_sp, restart, 0 if partner is None else config.sims_xp)

    def choose_partner(self) -> int | None:
        """The strongest by the latest real cross-play, at times a random one; None in pure self-play.

        A partner without real episodes yet comes first. Randomness keeps every partner's critic fresh.
        """
        if not self.partners or self.lambda_now() == 0.0 or not self.config.sims_xp:
            return None
        members = sorted(self.partners)
        if self.rng.random() < self.config.partner_random:
            return int(self.rng.choice(members))
        return max(members, key=lambda k: self.partner_scores.get(k, float("inf")))

    def lambda_now(self) -> float:
        """lambda_XP of this update, rising linearly over the first `lambda_ramp`; 0 after the share `lambda_until`."""
        if self.updates >= self.config.lambda_until * self.config.updates:
            return 0.0
        ramp = self.config.lambda_ramp
        return self.config.lambda_xp * (min(1.0, (self.updates + 1) / ramp) if ramp else 1.0)

    # ---- samples -------------------------------------------------------------------------------------------------

    def _self_play(self, batch: Batch) -> tuple[list[Group], list[Lesson], dict[str, float]]:
        """Groups of actions with their weights, what the self-play critic learns, figures."""
        layout, config = batch.layout, self.config

        def inputs(obs: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
            return self._joint(obs), torch.zeros(len(obs), 0)

        advantage, lesson = self._evaluate(batch, layout.both, SELF, inputs)
        spread = advantage[batch.valid[:, layout.both]].std().clamp(min=1e-6)
        # Centred as usual: a shift of all advantages only adds noise.
        signed = signed_advantage(Kind.SP, advantage - advantage.mean(), weight=1.0, scale=spread)
        groups = []
        for columns, weight in ((layout.start, config.sp_weight), (layout.again, config.restart_weight)):
            for seat in range(players := batch.actions.shape[-1]):  # every seat learns from the joint advantage
                seats = torch.full((columns.stop - columns.start,), seat)
                groups.append((Actions.of_seats(batch, columns, seats, signed[:, columns]), weight / players))
        return groups, [lesson], {"advantage_sp": float(spread), "return_sp": float(lesson.returns.mean())}

    def _cross_play(self, batch: Batch, partner: int, spread: float) -> tuple[Group, Lesson, dict[str, float]]:
        """The same for cross-play, whose advantages enter with -lambda_XP in units of self-play's spread, bounded."""
        shared, layout = self.config.xp_critic == "shared", batch.layout
        seats, eye = torch.from_numpy(layout.seats), torch.eye(self.env.spec.num_players)
        which = torch.eye(len(self.partners))[sorted(self.partners).index(partner)] if shared else torch.zeros(0)

        def inputs(obs: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
            """The member's own view first, its seat, and which partner it is."""
            seat = seats[columns]
            both = torch.stack([obs[torch.arange(len(obs)), seat], obs[torch.arange(len(obs)), 1 - seat]], 1)
            return self._joint(both), torch.cat([eye[seat], which.expand(len(obs), -1)], -1)

        advantage, lesson = self._evaluate(batch, layout.cross, SHARED if shared else str(partner), inputs)
        weight, bound = self.lambda_now(), spread * (self.config.xp_clip or math.inf)
        signed = signed_advantage(Kind.XP, advantage.clamp(-bound, bound), weight=weight, scale=spread)
        figures = {
            "advantage_xp": float(advantage.std()),
            "return_xp": float(lesson.returns.mean()),
            "lambda": weight,
            "partner": float(partner),
        }
        return (Actions.of_seats(batch, layout.cross, seats, signed), 1.0), lesson, figures

    def _joint(self, obs: Tensor) -> Tensor:
        """What critics see of all players' observations (R, P, *view.shape), the first player's first."""
        if self.encoder is None:
            return joint(obs, self.env.spec.views["features"])
        return self.encoder.latent(obs[:, 0])

    def _evaluate(self, batch: Batch, columns: slice, key: str, inputs: Inputs) -> tuple[Tensor, Lesson]:
        """Advantages (T, n) of some columns by their critic, and the lesson that the critic takes from them."""
        critic, config = self.critics[key], self.config

        def value(obs: Tensor, column: Tensor) -> Tensor:
            return critic.value(*inputs(obs, column))

        advantage, returns = advantages(batch, columns, value, discount=config.discount, lam=config.lam)
        time, count = returns.shape
        given = inputs(batch.obs[:, columns].flatten(0, 1), torch.arange(count).repeat(time))
        valid = batch.valid[:, columns].flatten()
        return advantage, Lesson(key, *given, returns.flatten())[valid]

    # ---- losses --------------------------------------------------------------------------------------------------

    def _learn(self, actions: Actions, lessons: list[Lesson]) -> dict[str, float]:
        """`epochs` passes over the batch in `minibatches`; means of the losses and of the policy's figures."""
        for lesson in lessons:
            self.critics[lesson.key].see(lesson.returns, self.config.value_decay)
        totals: list[dict[str, float]] = []
        for _ in range(self.config.epochs):
            parts = self._shuffled(len(actions.action))
            pages = [self._shuffled(len(lesson.returns)) for lesson in lessons]
            for number, part in enumerate(parts):
                figures = self._step_actor(actions[part])
                now = [lesson[page[number]] for lesson, page in zip(lessons, pages, strict=True)]
                totals.append(figures | self._step_critics(now))
        return {name: float(np.mean([figures[name] for figures in totals])) for name in totals[0]}

    def _shuffled(self, count: int) -> tuple[Tensor, ...]:
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
            given = (log_prob, part.log_prob, part.advantage, entropy, part.weight)
            loss = clipped_loss(*given, clip=config.clip, entropy_scale=config.entropy)
        self._step(self.actor_optimiser, loss, self.trained)
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

    def _step_critics(self, lessons: list[Lesson]) -> dict[str, float]:
        losses = {}
        for lesson in lessons:
            critic = self.critics[lesson.key]
            error = critic(lesson.obs, lesson.extras).squeeze(-1) - critic.normalised(lesson.returns)
            losses["critic_loss_sp" if lesson.key == SELF else "critic_loss_xp"] = error.square().mean()
        self._step(self.critic_optimiser, sum(losses.values(), torch.zeros(())), self.critics.parameters())
        return {name: float(loss.detach()) for name, loss in losses.items()}

    def _step(self, optimiser: torch.optim.Optimizer, loss: Tensor, parameters: Any) -> None:
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(list(parameters), self.config.grad_clip)
        optimiser.step()

    def _seen(self, batch: Batch) -> dict[str, float]:
        """Reward and score per simulated step, by group, brought to the length of an episode."""
        layout, horizon = batch.layout, self.env.spec.horizon
        figures = {}
        for name, columns in (("sp", layout.start), ("restart", layout.again), ("xp", layout.cross)):
            if columns.stop > columns.start:
                valid = batch.valid[:, columns]
                figures[f"simulated_reward_{name}"] = float(batch.reward[:, columns][valid].mean()) * horizon
                figures[f"simulated_score_{name}"] = float(batch.score[:, columns][valid].mean()) * horizon
        return figures

    # ---- what is kept --------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Everything to go on from exactly here; partners are given again."""
        return {
            "actor": w.weights_of(self.actor.net),
            "critics": w.weights_of(self.critics),
            "actor_optimiser": w.optimiser_state(self.actor_optimiser),
            "critic_optimiser": w.optimiser_state(self.critic_optimiser),
            "generator": self.generator.get_state().numpy(),
            "rng": self.rng.bit_generator.state,
            "starts": self.starts.state(),
            "simulator": self.simulator.state(),
            "counters": [self.updates, self.simulated, self.trajectories],
            "partner_scores": {str(k): v for k, v in self.partner_scores.items()},
            "encoder": None if self.encoder is None else self.encoder.state(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from `state()` of a learner of the same member and partners."""
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
        self.updates, self.simulated, self.trajectories = map(int, state["counters"])
        self.partner_scores = {int(k): float(v) for k, v in state["partner_scores"].items()}
