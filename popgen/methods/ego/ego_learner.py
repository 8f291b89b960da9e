"""PPO of a recurrent ego, of one level or two, beside critics that see seat and partner.

The objective is `popgen.losses.policy_losses`. One optimiser, one summed loss: both levels learn in the same unroll of
the memory through each sequence, whose state at the beginning is the rollout's.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from popgen.envs.contract import BatchedEnv, EnvSpec
from popgen.losses.policy_losses import clipped_loss, gae, linear_schedule
from popgen.methods.ego.augmented_starts import AugmentedStarts
from popgen.methods.ego.config import AugmentConfig, EgoConfig, EgoRun, HiptConfig
from popgen.methods.ego.ego_networks import EgoNet, EgoSizes
from popgen.methods.ego.ego_policy import EgoPolicy, HierarchicalEgoPolicy
from popgen.methods.ego.ego_rollout import Choices, Company, EgoSampler, EndedEpisode, Rollout
from popgen.methods.ego.partner_seats import PartnerSeats
from popgen.methods.ego.two_levels import advantages_of_decisions, cut_segments, information_of_skill, pay_segments
from popgen.nets.feed_forward import Sizes, ValueNet
from popgen.nets.weights import clip_gradients, load_optimiser_state, load_weights, optimiser_state, weights_of
from popgen.play.policy import Policy
from popgen.play.stacked_partners import PartnerPool
from popgen.types import Weights


@dataclass(frozen=True)
class EgoSetup:
    """What a run asks of its learner.

    Attributes:
        ego: network and PPO. levels: of HiPT, None for one level. augment: of start states, None for none.
        self_play: the ego plays with itself.
    """

    ego: EgoConfig
    levels: HiptConfig | None = None
    augment: AugmentConfig | None = None
    self_play: bool = False

    @staticmethod
    def of_run(config: EgoRun) -> EgoSetup:
        """Of a run's method."""
        levels, augment = getattr(config, "hipt", None), getattr(config, "augment", None)
        if config.ego.other_starts and not config.plays_itself:
            augment = AugmentConfig(share=config.ego.other_starts)
        return EgoSetup(config.ego, levels, augment, config.plays_itself)

    @property
    def sizes(self) -> EgoSizes:
        """Of the ego's networks."""
        ego = self.ego
        skills = 0 if self.levels is None else self.levels.skills
        return EgoSizes(ego.network, ego.units, ego.channels, ego.head_units, skills)


def make_policy(setup: EgoSetup, spec: EnvSpec, seed: int = 0) -> EgoPolicy:
    """The ego as it acts, with initial weights of a seed."""
    if setup.levels is None:
        return EgoPolicy(setup.sizes, spec, seed)
    least, most = setup.levels.duration_least, setup.levels.duration_most
    return HierarchicalEgoPolicy(setup.sizes, spec, seed, duration_least=least, duration_most=most)


class Level(NamedTuple):
    """What a level's loss is made of: `low` or `high`, its critic, clipping, weights of entropy and critic's error."""

    name: str
    critic: ValueNet
    clip: float
    entropy: float
    value: float


def lose_level(
    level: Level, batch: dict[str, Tensor], logits: Tensor, taken: Tensor, old_log_prob: Tensor
) -> dict[str, Tensor]:
    """The loss of one level and its figures: clipped surrogate, entropy, and the critic's error on its own scale.

    Args:
        level: which.
        batch: judged, who, and the level's advantages and returns, with the rows of `taken`.
        logits: (..., A), of what the level can take.
        taken, old_log_prob: (...), what it took, and with which log-probability.
    """
    if not len(taken):
        return {"loss": logits.sum()}
    log_probs = torch.log_softmax(logits, -1)
    log_prob = log_probs.gather(-1, taken.unsqueeze(-1)).squeeze(-1)
    entropy = -(log_probs.exp() * log_probs).sum(-1)
    advantage = batch[f"{level.name}_advantage"]
    policy = clipped_loss(
        log_prob,
        old_log_prob,
        advantage,
        entropy,
        torch.ones_like(advantage),
        clip=level.clip,
        entropy_scale=level.entropy,
    )
    last = taken.dim() - 1
    guess = level.critic(batch["judged"].flatten(0, last), batch["who"].flatten(0, last)).squeeze(-1)
    error = 0.5 * (guess - batch[f"{level.name}_returns"].flatten()).square().mean()
    with torch.no_grad():
        change = log_prob - old_log_prob
        kl = (change.exp() - 1.0 - change).mean()
    figures = {"policy_loss": policy, "value_loss": error, "entropy": entropy.mean(), "kl": kl}
    prefix = "" if level.name == "low" else f"{level.name}_"
    return {"loss": policy + level.value * error} | {prefix + name: value for name, value in figures.items()}


class Targets(NamedTuple):
    """What a level learns from its samples: normalised advantages, and returns on the critic's scale."""

    advantage: Tensor
    returns: Tensor


class Iterated(NamedTuple):
    """What an iteration gave: figures, environment steps, those of moved starts, and whole episodes."""

    figures: dict[str, float]
    steps: int
    simulated: int
    episodes: list[EndedEpisode]


class EgoLearner:
    """One ego: its networks, critics and running play.

    Args:
        setup: of the run.
        env: as many environments as `ego.envs`.
        partners: policies, with their weights; none in self-play.
        seed: of everything.
    """

    def __init__(self, setup: EgoSetup, env: BatchedEnv, partners: Sequence[Policy], seed: int) -> None:
        self.setup, self.config, self.spec = setup, setup.ego, env.spec
        seeds = [int(part >> 1) for part in np.random.SeedSequence(seed).generate_state(6)]
        self.policy = make_policy(setup, env.spec, seeds[0])
        self.net: EgoNet = self.policy.net
        generator = torch.Generator().manual_seed(seeds[1])
        sizes, who = Sizes(self.config.critic_units, 2, "leaky_relu"), env.spec.num_players + len(partners)
        levels = ["low"] if setup.levels is None else ["low", "high"]
        view = env.spec.views["features"]
        self.critics = nn.ModuleDict({level: ValueNet(view, who, sizes, generator) for level in levels})
        self._learned = [*self.net.parameters(), *self.critics.parameters()]
        self.optimiser = torch.optim.Adam(self._learned, self.config.learning_rate, eps=1e-5, fused=True)
        self.sampler = EgoSampler(
            env,
            self.net,
            _find_company(setup, env, partners, seeds[2:5]),
            setup.levels,
            unroll=self.config.unroll,
            sequence=self.config.sequence,
            seed=seeds[5],
        )
        self._shuffler = torch.Generator().manual_seed(seeds[1] + 1)
        self.steps = 0

    @property
    def progress(self) -> float:
        """Share of the steps that are done, at most 1."""
        return min(1.0, self.steps / self.config.steps)

    def iterate(self) -> Iterated:
        """A rollout, and the updates on it.

        Returns:
            Figures of the updates' losses and of both levels, and of the play.
        """
        self.net.eval()
        rollout = self.sampler.play()
        figures = self.learn(rollout)
        return Iterated(figures, rollout.steps, rollout.simulated, rollout.episodes)

    # ---- targets -------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def _aim_low(self, rollout: Rollout) -> Targets:
        """Advantages over steps; what was cut bootstraps, what terminated does not."""
        config, critic = self.config, self._critic("low")
        time, rows = rollout.reward.shape
        value = critic.value(rollout.judged.flatten(0, 1), rollout.who.flatten(0, 1)).view(time + 1, rows)
        reward = rollout.reward.clone()
        if len(rollout.cut_at):
            step, row = rollout.cut_at.unbind(-1)
            reward[step, row] += config.discount * critic.value(rollout.cut_judged, rollout.cut_who)
        advantage = gae(reward, value, config.discount * (~rollout.done).float(), config.lam)
        returns = advantage + value[:-1]
        critic.see(returns, config.value_decay)
        return Targets(_normalise(advantage), critic.normalised(returns))

    @torch.no_grad()
    def _aim_high(self, rollout: Rollout, choices: Choices, figures: dict[str, float]) -> Targets:
        """Advantages over decisions, at their places in (T, R); elsewhere 0."""
        levels, critic = self.setup.levels, self._critic("high")
        assert levels is not None
        segments = cut_segments(choices.decides.numpy(), rollout.is_first.numpy(), rollout.done.numpy())
        weight = self.progress * (levels.influence - 1.0)
        paid = pay_segments(
            segments,
            rollout.reward.numpy(),
            choices.influence.numpy(),
            weight=weight,
            sum_first=levels.first_segment == "published",
        )
        step, row = torch.from_numpy(segments.step), torch.from_numpy(segments.row)
        value = critic.value(rollout.judged[step, row], rollout.who[step, row]).numpy().astype(np.float64)
        last = critic.value(rollout.judged[-1], rollout.who[-1]).numpy()
        advantage = advantages_of_decisions(segments, paid, value, last, discount=levels.discount, lam=levels.lam)
        returns = torch.from_numpy((advantage + value).astype(np.float32))
        critic.see(returns, self.config.value_decay)
        placed = [torch.zeros(rollout.reward.shape) for _ in range(2)]
        placed[0][step, row] = _normalise(torch.from_numpy(advantage.astype(np.float32)))
        placed[1][step, row] = critic.normalised(returns)
        figures |= _describe_choices(choices, levels.skills, weight, float(np.mean(paid)))
        return Targets(*placed)

    def _critic(self, level: str) -> ValueNet:
        critic = self.critics[level]
        assert isinstance(critic, ValueNet)
        return critic

    # ---- updates -------------------------------------------------------------------------------------------------

    def learn(self, rollout: Rollout) -> dict[str, float]:
        """Several epochs of minibatches of whole sequences; their mean figures."""
        config, figures = self.config, {}
        low = self._aim_low(rollout)
        high = None if rollout.choices is None else self._aim_high(rollout, rollout.choices, figures)
        batch = _make_sequences(rollout, low, high, config.sequence)
        rate = linear_schedule(
            config.learning_rate, config.learning_rate * config.learning_rate_end, self.progress, 1.0
        )
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        count = batch["state"].shape[1]
        totals: defaultdict[str, list[float]] = defaultdict(list)
        for _ in range(config.epochs):
            for index in torch.randperm(count, generator=self._shuffler).tensor_split(config.minibatches):
                for name, value in self._update_networks(
                    {name: part[:, index] for name, part in batch.items()}
                ).items():
                    totals[name].append(value)
        figures |= {name: float(np.mean(values)) for name, values in totals.items()}
        self.steps += rollout.steps
        return figures | {"learning_rate": rate}

    def _update_networks(self, batch: dict[str, Tensor]) -> dict[str, float]:
        """One step of the optimiser on sequences (L, B, ...)."""
        config, net = self.config, self.net
        encoded = net.encode(batch["seen"].flatten(0, 1), batch["extras"].flatten(0, 1))
        encoded = encoded.unflatten(0, batch["reward_rows"].shape)
        memory = net.remember(encoded, batch["state"][0], batch["is_first"]).outputs
        logits = net.action_logits(memory, batch.get("skill"))
        entropy_scale = linear_schedule(config.entropy, config.entropy * config.entropy_end, self.progress, 1.0)
        low = Level("low", self._critic("low"), config.clip, entropy_scale, config.value_weight)
        terms = lose_level(low, batch, logits, batch["actions"], batch["log_prob"])
        if self.setup.levels is not None:
            chosen = {name: part[batch["decides"]] for name, part in batch.items() if name != "state"}
            high = Level("high", self._critic("high"), config.clip, self.setup.levels.entropy, config.value_weight)
            choice = net.skill_logits(memory[batch["decides"]])
            lost = lose_level(high, chosen, choice, chosen["skill"], chosen["skill_log_prob"])
            levels = self.setup.levels
            known = information_of_skill(net.skill_logits(memory).detach(), net.logits_by_skill(memory)).mean()
            paid = levels.low_influence * known.clamp(max=levels.low_influence_most)
            terms |= lost | {"loss": terms["loss"] + levels.high_weight * lost["loss"] - paid, "information": known}
        self.optimiser.zero_grad(set_to_none=True)
        terms["loss"].backward()
        norm = clip_gradients(self._learned, config.grad_clip)
        self.optimiser.step()
        return {name: float(value.detach()) for name, value in terms.items()} | {"grad_norm": float(norm)}

    # ---- checkpoints ---------------------------------------------------------------------------------------------

    def training_weights(self) -> Weights:
        """The critics'."""
        return weights_of(self.critics)

    def state(self) -> dict[str, Any]:
        """Everything to continue from exactly here."""
        return {
            "net": weights_of(self.net),
            "critics": weights_of(self.critics),
            "optimiser": optimiser_state(self.optimiser),
            "shuffler": self._shuffler.get_state().numpy(),
            "sampler": self.sampler.state(),
            "steps": self.steps,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()` of a learner of the same run."""
        load_weights(self.net, state["net"])
        load_weights(self.critics, state["critics"])
        load_optimiser_state(self.optimiser, state["optimiser"])
        self._shuffler.set_state(torch.from_numpy(np.array(state["shuffler"])))
        self.sampler.load_state(state["sampler"])
        self.steps = int(state["steps"])


def _find_company(setup: EgoSetup, env: BatchedEnv, partners: Sequence[Policy], seeds: Sequence[int]) -> Company:
    """Partners in their seats, and augmented starts, where there are any."""
    count, config = env.num_envs, setup.ego
    starts = None if setup.augment is None else AugmentedStarts(setup.augment, env, config.unroll, seeds[2])
    if setup.self_play:
        return Company(starts=starts)
    priority = config.priority if config.sampling == "prioritised" else None
    seats = PartnerSeats(len(partners), count, env.spec.num_players, priority, seeds[1])
    return Company(PartnerPool(partners, count, seeds[0]), seats, starts)


def _normalise(advantage: Tensor) -> Tensor:
    return (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-8)


def _describe_choices(choices: Choices, skills: int, weight: float, paid: float) -> dict[str, float]:
    """I(z; a), how often each of all z is chosen, and how much of the high level's reward is influence."""
    drawn = choices.skill[choices.decides]
    share = torch.bincount(drawn, minlength=skills).float() / len(drawn)
    influence = float(choices.influence.mean())
    return {
        "influence": influence,
        "influence_reward": weight * influence,
        "segment_reward": paid,
        "skill_least": float(share.min()),
        "skill_most": float(share.max()),
    }


def _make_sequences(rollout: Rollout, low: Targets, high: Targets | None, length: int) -> dict[str, Tensor]:
    """All that an update needs as (L, T / L * R, ...), and the memory before each sequence as (1, T / L * R, S)."""
    time = len(rollout.reward)
    parts: dict[str, Tensor] = {
        "seen": rollout.seen,
        "extras": rollout.extras,
        "judged": rollout.judged[:time],
        "who": rollout.who[:time],
        "is_first": rollout.is_first,
        "actions": rollout.actions,
        "log_prob": rollout.log_prob,
        "reward_rows": rollout.reward,
        "low_advantage": low.advantage,
        "low_returns": low.returns,
    }
    if high is not None and (choices := rollout.choices) is not None:
        parts |= {"skill": choices.skill, "decides": choices.decides, "skill_log_prob": choices.log_prob}
        parts |= {"high_advantage": high.advantage, "high_returns": high.returns}
    sequences = {
        name: part.unflatten(0, (time // length, length)).transpose(0, 1).flatten(1, 2) for name, part in parts.items()
    }
    return sequences | {"state": rollout.state.flatten(0, 1).unsqueeze(0)}
