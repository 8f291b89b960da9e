"""RLlib's PPO learner on pooled batches: every kind of trajectory enters one weighted loss per member."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core.columns import Columns
from ray.rllib.core.learner.training_data import TrainingData
from torch import Tensor

from popgen.losses.policy_losses import annealed, clipped_surrogate, negated_surrogate
from popgen.methods.mappo.pooling import Plan, PooledBatch, pool
from popgen.methods.mappo.population_bonus import joint_log_probs
from popgen.methods.mappo.rl_module import CRITICS, MemberModule, module_id
from popgen.methods.mappo.slots import Rollout
from popgen.nets.weights import load_optimiser_state, load_weights, optimiser_state, weights_of
from popgen.play.trajectories import Trajectories
from popgen.types import Weights

NETWORKS = ("actor", CRITICS)
"""Parts of a module, each with an optimiser and a gradient norm of its own."""


class PooledLearner(PPOTorchLearner):
    """`update(episodes=[Rollout, ...], plans={member: Plan}, progress=share of the budget)`.

    RLlib's own batching would go through each kind on its own, and GAE through every critic; here the members' batches
    are pooled before (`popgen.methods.mappo.pooling`). Everything else of the update is RLlib's.
    """

    config: Any  # a MappoConfig
    module: Any  # a MultiRLModule

    def __init__(self, **keywords: Any) -> None:
        super().__init__(**keywords)
        job = self.config.job
        self._order = torch.Generator().manual_seed(job.seed)  # of the minibatches
        self._view = self.config.env_spec.views[job.ppo.view]
        self._sums: dict[str, dict[str, list[Tensor]]] = {}
        self._figures: dict[int, dict[str, float]] = {}
        self._entropy = job.ppo.entropy
        self.seconds: dict[str, float] = {}

    def configure_optimizers_for_module(self, module_id: str, config: Any = None) -> None:
        """Adam for the actor and for the critics."""
        module = self.module[module_id]
        for name in NETWORKS:
            params = list(getattr(module, name).parameters())
            optimiser = torch.optim.Adam(params, lr=self.config.job.ppo.learning_rate, eps=1e-5)
            self.register_optimizer(
                module_id=module_id, optimizer_name=name, optimizer=optimiser, params=params, lr_or_lr_schedule=None
            )

    def _create_iterator_if_necessary(
        self,
        *,
        training_data: TrainingData,
        plans: Mapping[int, Plan],
        progress: float,
        **kwargs: Any,
    ) -> Iterator[_Minibatch]:
        """Pool the rollouts, then epochs of minibatches in which every member has its part."""
        ppo = self.config.job.ppo
        self._anneal_rates(progress)
        self._sums, self._figures = defaultdict(lambda: defaultdict(list)), {}
        self.seconds, began = {"pooling": 0.0, "gradients": 0.0}, time.perf_counter()
        batches: dict[int, PooledBatch] = {}
        rollouts = cast("Sequence[Rollout]", training_data.episodes)
        for member, plan in plans.items():
            batch = pool(
                rollouts,
                member,
                plan,
                self._module_of(member).critics,
                self._view,
                discount=ppo.discount,
                lam=ppo.lam,
                value_decay=ppo.value_decay,
                bonus=self._bonus_of(member),
                utility=self.config.job.utilities.get(member),
            )
            if batch is not None:
                batches[member] = batch.to(self._device)
                self._figures[member] = dict(batch.figures)
        # With a runner lost there may be fewer rows than minibatches.
        count = min([ppo.minibatches, *(len(batch.action) for batch in batches.values())])
        steps = sum(rollout.steps for rollout in rollouts) // count
        self.seconds["pooling"] = time.perf_counter() - began
        for _ in range(ppo.epochs):
            parts = {m: batch.minibatches(count, self._order) for m, batch in batches.items()}
            for _ in range(count):
                yield _Minibatch({module_id(m): _Rows(next(rows)) for m, rows in parts.items()}, max(1, steps))

    def _update(self, batch: dict[str, Any], **kwargs: Any) -> Any:
        """Forward, backward and optimiser step of one minibatch."""
        began = time.perf_counter()
        result = super()._update(batch, **kwargs)
        self.seconds["gradients"] += time.perf_counter() - began
        return result

    def compute_loss_for_module(
        self, *, module_id: str, config: Any, batch: dict[str, Any], fwd_out: dict[str, Any]
    ) -> Tensor:
        """Surrogate - entropy bonus + value losses of one minibatch; the rows' weights make it a sum of means."""
        job = self.config.job
        log_probs = torch.log_softmax(fwd_out[Columns.ACTION_DIST_INPUTS], -1)
        log_prob = log_probs.gather(-1, batch["action"].unsqueeze(-1)).squeeze(-1)
        advantage, clip = batch["advantage"], job.ppo.clip
        surrogate = clipped_surrogate(log_prob, batch["log_prob"], advantage, clip=clip)
        if job.diversity is not None and job.diversity.xp_loss == "negated":
            negated = negated_surrogate(log_prob, batch["log_prob"], -advantage, clip=clip)
            surrogate = torch.where(batch["cross"], negated, surrogate)
        policy = (batch["weight"] * surrogate).sum()
        entropy = -(log_probs.exp() * log_probs).sum(-1).mean()
        values = fwd_out[Columns.VF_PREDS]
        errors = [0.5 * (values[name] - rows.target).square().mean() for name, rows in batch[CRITICS].items()]
        value = torch.stack(errors).sum() if errors else policy.new_zeros(())
        with torch.no_grad():
            ratio = log_prob - batch["log_prob"]
            figures = {
                "policy_loss": policy,
                "value_loss": value,
                "entropy": entropy,
                "kl": (ratio.exp() - 1.0 - ratio).mean(),
                "clipped": (ratio.exp() - 1.0).abs().gt(clip).float().mean(),
            }
        for name, figure in figures.items():
            self._sums[module_id][name].append(figure.detach())
        return policy - self._entropy * entropy + job.ppo.value_weight * value

    def _log_steps_trained_metrics(self, batch: Any) -> None:
        """Nothing: the algorithm counts environment steps, and RLlib's counters cost a tenth of an update."""

    def _anneal_rates(self, progress: float) -> None:
        ppo = self.config.job.ppo
        self._entropy = annealed(ppo.entropy, ppo.entropy_end, progress)
        rate = annealed(ppo.learning_rate, ppo.learning_rate_end, progress)
        for optimiser in self._named_optimizers.values():
            self._set_optimizer_lr(optimiser, rate)

    def _bonus_of(self, member: int) -> Callable[[Trajectories], Tensor] | None:
        """What a member's self-play is paid by the job's bonus, with all members' present actors."""
        job = self.config.job
        if job.bonus is None:
            return None
        actors = {other: self._module_of(other).actor for other in job.learning}
        return lambda steps: job.bonus(joint_log_probs(steps, member, actors))

    def _module_of(self, member: int) -> MemberModule:
        return self.module[module_id(member)].unwrapped()

    # ---- what the algorithm asks for -----------------------------------------------------------------------------

    def actors(self) -> dict[int, Weights]:
        """Member -> weights of its actor."""
        return {member: weights_of(self._module_of(member).actor) for member in self.config.job.learning}

    def critics(self, member: int) -> Weights:
        """Weights of a member's critics."""
        return weights_of(self._module_of(member).critics)

    def figures(self) -> dict[int, dict[str, float]]:
        """Member -> means over the last update."""
        return {
            member: figures
            | {name: float(torch.stack(values).mean()) for name, values in self._sums[module_id(member)].items()}
            for member, figures in self._figures.items()
        }

    def snapshot(self) -> dict[str, Any]:
        """Everything to continue from exactly here."""
        optimisers = {name: optimiser_state(optimiser) for name, optimiser in self._named_optimizers.items()}
        modules = {str(member): weights_of(self._module_of(member)) for member in self.config.job.learning}
        return {"modules": modules, "optimisers": optimisers, "order": self._order.get_state().numpy().copy()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from `snapshot()` of a learner of the same job."""
        for member, weights in state["modules"].items():
            load_weights(self._module_of(int(member)), weights)
        for name, saved in state["optimisers"].items():
            load_optimiser_state(self._named_optimizers[name], saved)
        self._order.set_state(torch.from_numpy(np.array(state["order"])))


class _Rows(dict[str, Any]):
    """One member's rows of a minibatch."""

    def __len__(self) -> int:
        return len(self["action"])


@dataclass(frozen=True)
class _Minibatch:
    """What RLlib's update loop asks of a MultiAgentBatch."""

    policy_batches: dict[str, _Rows]
    steps: int

    def env_steps(self) -> int:
        """Environment steps behind the rows."""
        return self.steps
