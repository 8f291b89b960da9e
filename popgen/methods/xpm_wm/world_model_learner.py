"""World-model learning: one update of equation WM+ and the posteriors from which imagination starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from popgen.envs.contract import EnvSpec
from popgen.methods.xpm_wm.config import WorldModelConfig
from popgen.methods.xpm_wm.imagination import Starts
from popgen.methods.xpm_wm.latent_filter import to_indices
from popgen.methods.xpm_wm.replay import KIND_CODE, Windows
from popgen.methods.xpm_wm.world_model import (
    LatentFilter,
    Observed,
    WorldModel,
    balanced_kl,
    bernoulli_loss,
    masked_mean,
    predecessor_kl,
)
from popgen.nets import weights as w
from popgen.types import Kind


@dataclass(frozen=True)
class WindowBatch:
    """Windows as tensors, time first; see `popgen.methods.xpm_wm.replay.Windows`."""

    obs: Tensor
    actions: Tensor
    events: Tensor
    is_first: Tensor
    terminal: Tensor
    partner: Tensor
    cross: Tensor

    @staticmethod
    def from_windows(windows: Windows, model: WorldModel) -> WindowBatch:
        """Batch-first arrays -> time-first tensors on the model's device, observations scaled."""
        device = next(model.parameters()).device

        def tensor(array: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).to(device).transpose(0, 1)

        cross = torch.from_numpy(windows.kind == KIND_CODE[Kind.XP]).to(device)
        return WindowBatch(
            obs=model.filter.scaled(tensor(windows.obs)),
            actions=tensor(windows.actions),
            events=tensor(windows.events).float(),
            is_first=tensor(windows.is_first),
            terminal=tensor(windows.terminal).float(),
            partner=torch.from_numpy(windows.partner).to(device),
            cross=cross,
        )


class ModelLosses(NamedTuple):
    """Unweighted loss terms, averaged over (T, B); the observed window; tensors worth logging."""

    terms: dict[str, Tensor]
    seen: Observed
    extras: dict[str, Tensor]


class ModelLearner:
    """Owns the world model and its optimiser, on `device`; weights and start states come and go as arrays.

    `predecessors` are the filters that earlier members left behind; they do not train.
    """

    def __init__(self, config: WorldModelConfig, spec: EnvSpec, seed: int, device: str | torch.device = "cpu") -> None:
        torch.manual_seed(seed)
        self.config, self.spec, self.device = config, spec, torch.device(device)
        self.model = WorldModel(config, spec).to(self.device)
        self.optimiser = torch.optim.Adam(self.model.parameters(), lr=config.learning_rate, eps=1e-8, fused=True)
        self.generator = torch.Generator(self.device).manual_seed(seed + 1)
        self.rng = np.random.default_rng(seed + 2)
        self.predecessors: dict[int, LatentFilter] = {}
        self.updates = 0

    def set_learning_rate(self, rate: float) -> None:
        """For later members, whose model is only fine-tuned."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate

    def _learning_rate(self) -> float:
        return float(self.optimiser.param_groups[0]["lr"])

    def add_predecessor(self, member: int, filter_weights: w.Weights) -> None:
        """Keep member's archived filter q_{theta^k} for the KL term of equation WM+."""
        archived = LatentFilter(self.config, self.spec).to(self.device)
        w.load_weights(archived, filter_weights)
        self.predecessors[member] = archived.eval().requires_grad_(False)

    def set_biases(self, windows: Windows) -> None:
        """Output biases at the data's means; call once before the first update."""
        batch = WindowBatch.from_windows(windows, self.model)
        self.model.set_outputs(batch.obs, batch.events.flatten(2))

    def losses(self, batch: WindowBatch) -> ModelLosses:
        """The terms of equation WM+ on a batch."""
        model, config = self.model, self.config
        seen = model.observe(batch.obs, batch.actions, batch.is_first, self.generator)
        inner = (~batch.is_first).float()
        decoded = model.decode(seen.latent)
        kl_loss, kl = balanced_kl(
            seen.posterior, seen.prior, dyn=config.kl_dyn, rep=config.kl_rep, free_nats=config.free_nats
        )
        going_on = bernoulli_loss(model.continue_head(seen.latent.flat()).squeeze(-1), 1.0 - batch.terminal)
        terms = {
            "observation": model.observation_loss(decoded, batch.obs).mean(),
            "events": masked_mean(model.reward_loss(seen.latent, batch.events.flatten(2)), inner),
            "continue": going_on.mean(),
            "kl": masked_mean(kl_loss, inner),
            "predecessors": self._predecessor_loss(batch, seen),
        }
        extras = {"kl": masked_mean(kl, inner), "exact": model.exact(decoded.detach(), batch.obs).float().mean()}
        return ModelLosses(terms, seen, extras)

    def _predecessor_loss(self, batch: WindowBatch, seen: Observed) -> Tensor:
        total = torch.zeros((), device=self.device)
        if not self.config.kl_predecessors or not self.predecessors:
            return total
        latest = max(self.predecessors)
        for member, archived in self.predecessors.items():
            reading = self.config.predecessors
            if reading == "latest" and member != latest:
                continue
            rows = batch.cross & (batch.partner == member) if reading == "partner" else batch.cross
            if not rows.any():
                continue
            with torch.no_grad():
                _, theirs = archived.observe_posterior(
                    batch.obs[:, rows], batch.actions[:, rows], batch.is_first[:, rows], self.generator
                )
            share = rows.float().mean()
            total = total + share * predecessor_kl(seen.posterior[:, rows], theirs).mean()
        return total

    def loss_weights(self) -> dict[str, float]:
        """The weight of each loss term; the names are those of `losses`."""
        return {
            "observation": 1.0,
            "events": self.config.event_scale,
            "continue": self.config.continue_scale,
            "kl": 1.0,
            "predecessors": self.config.kl_predecessors,
        }

    def update(self, windows: Windows) -> tuple[dict[str, float], Observed]:
        """One gradient step on a batch of windows; metrics and the posteriors (detached).

        Raises:
            FloatingPointError: the loss or its gradient is not finite; the weights are those of before.
        """
        batch = WindowBatch.from_windows(windows, self.model)
        result = self.losses(batch)
        terms, seen = result.terms, result.seen
        weights = self.loss_weights()
        loss = sum((weights[name] * term for name, term in terms.items()), torch.zeros((), device=self.device))
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.config.grad_clip)
        if not torch.isfinite(loss.detach() + norm):
            bad = [name for name, term in terms.items() if not torch.isfinite(term)] or ["gradient"]
            problem = f"{' and '.join(bad)} not finite in update {self.updates + 1} of the world model"
            raise FloatingPointError(f"{problem}, at a learning rate of {self._learning_rate():g}")
        self.optimiser.step()
        self.updates += 1
        metrics = {f"loss_{name}": float(term.detach()) for name, term in terms.items()}
        return metrics | {name: float(value) for name, value in result.extras.items()}, seen

    @torch.no_grad()
    def posteriors(self, windows: Windows) -> Observed:
        """Windows through the model without learning."""
        batch = WindowBatch.from_windows(windows, self.model)
        return self.model.observe(batch.obs, batch.actions, batch.is_first, self.generator)

    def starts(
        self,
        seen: Observed,
        windows: Windows,
        count: int,
        *,
        pool: int,
        skip: int = 1,
        chosen: bool = True,
        rare: tuple[int, ...] = (),
    ) -> Starts:
        """`count` random states of the windows, neither terminal nor among the first `skip` of their window; with
        `chosen` false, none of a window that was drawn for an event, if there are others, and none that an event of
        `rare` precedes in its window or led to."""
        allowed = ~np.ascontiguousarray(windows.terminal.T)
        allowed[:skip] = False
        if not chosen and not windows.chosen.all():
            allowed[:, windows.chosen] = False
        if rare and (known := allowed & ~before_or_at(windows, rare).T).any():
            allowed = known
        steps, rows = np.nonzero(allowed)
        picked = self.rng.integers(0, len(steps), size=count)
        t, b = steps[picked], rows[picked]
        z = to_indices(self.model.filter.grouped(seen.latent.z[t, b].detach())).cpu()
        partner = windows.partner[b].astype(np.int16)
        h = seen.latent.h[t, b].detach().float().cpu().numpy()
        return Starts(h, z.numpy(), np.full(count, pool, np.uint8), partner)

    def state(self) -> dict[str, Any]:
        """Weights, optimiser and generators, to continue from exactly here."""
        return {
            "model": w.weights_of(self.model),
            "optimiser": w.optimiser_state(self.optimiser),
            "generator": self.generator.get_state().numpy(),
            "rng": self.rng.bit_generator.state,
            "updates": self.updates,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Replace the contents with `state()`."""
        w.load_weights(self.model, state["model"])
        w.load_optimiser_state(self.optimiser, state["optimiser"])
        self.generator.set_state(torch.from_numpy(np.array(state["generator"])))
        self.rng.bit_generator.state = state["rng"]
        self.updates = int(state["updates"])


def before_or_at(windows: Windows, events: tuple[int, ...]) -> np.ndarray:
    """(N, L) bool: one of the events led to this state or to an earlier one of the window; what led to the first is not
    looked at."""
    happened = np.asarray(windows.events[..., list(events)].any((2, 3)))
    happened[:, 0] = False
    return np.maximum.accumulate(happened, axis=1)
