"""The two-player world model of XPM-WM (paper, section 4.1): RSSM, joint encoder, per-player decoders, event head.

    prior             z_t ~ p(. | h_t)
    decoder           o^i_t ~ p(. | h_t, z^i_t),  z^i = (z^joint, z^{p_i})
    events            r_t ~ Bernoulli(. | h_t, z_t), one per event and player; or a scalar reward, a Gaussian
    continue          c_t ~ Bernoulli(. | h_t, z_t)

`popgen.methods.xpm_wm.latent_filter` has recurrent state and posterior, which is what acting needs and a predecessor
leaves behind; `WorldModel` adds what imagining and learning need. `ModelLearner` updates it by equation WM+ and gives
the posteriors from which imagination starts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from popgen.envs.contract import EnvSpec, ViewSpec
from popgen.methods.xpm_wm.actor_critic import Actor, Fit, fit_actor
from popgen.methods.xpm_wm.config import WorldModelConfig
from popgen.methods.xpm_wm.latent_filter import (
    Latent,
    LatentFilter,
    kl_divergence,
    layer_style,
    player_masks,
    probabilities,
    to_indices,
)
from popgen.methods.xpm_wm.replay import KIND_CODE, Windows
from popgen.nets import weights as w
from popgen.nets.blocks import ConvDecoder, mlp
from popgen.types import Kind


@dataclass(frozen=True)
class Observed:
    """A window of real data seen through the model, time first.

    latent: h (T, B, D), z (T, B, C * G); posterior, prior: probabilities (T, B, C, G).
    """

    latent: Latent
    posterior: Tensor
    prior: Tensor


class PlayerDecoder(nn.Module):
    """One player's observation from (h, z^i): (B, D + C * G) -> logits or means (B, *shape).

    `output` is the last bias, one number for each of the observation's.
    """

    def __init__(self, config: WorldModelConfig, view: ViewSpec, inputs: int) -> None:
        super().__init__()
        flat = len(view.shape) == 1
        self.trunk = mlp(inputs, view.shape[0] if flat else None, **layer_style(config), layers=config.decoder_layers)
        self.conv = None
        if not flat:
            self.conv = ConvDecoder(
                config.units,
                view.shape,
                channels=config.cnn_channels,
                kernels=config.cnn_kernels,
                activation=config.activation,
                norm=config.norm,
            )

    @property
    def output(self) -> nn.Parameter:
        """The last bias, one number for each of the observation's."""
        return _last_bias(self.trunk) if self.conv is None else self.conv.bias

    def entries(self, inputs: Tensor, columns: Tensor) -> Tensor:
        """Some entries (..., N) of a flat observation, of inputs (..., D + C * G)."""
        last = self.trunk[-1]
        assert isinstance(last, nn.Linear)
        return F.linear(self.trunk[:-1](inputs), last.weight[columns], last.bias[columns])

    def forward(self, inputs: Tensor) -> Tensor:
        """(B, D + C * G) -> (B, *shape)."""
        hidden = self.trunk(inputs)
        return hidden if self.conv is None else self.conv(hidden)


class WorldModel(nn.Module):
    """The filter with prior, decoders and heads.

    Raises:
        KeyError: the environment has no view of the configured name.
    """

    masks: Tensor
    event_weights: Tensor

    def __init__(self, config: WorldModelConfig, spec: EnvSpec) -> None:
        super().__init__()
        self.config, self.spec = config, spec
        self.filter = LatentFilter(config, spec)
        size = self.filter.latent_size
        inputs = config.deter + size
        style = layer_style(config)
        self.prior_net = mlp(config.deter, size, **style, layers=config.prior_layers)
        self.decoders = nn.ModuleList(PlayerDecoder(config, self.filter.view, inputs) for _ in range(2))
        self.scalar = config.reward_head == "scalar"
        outputs = 1 if self.scalar else spec.num_events * spec.num_players
        self.event_head = mlp(inputs, outputs, **style, layers=config.head_layers)
        self.continue_head = mlp(inputs, 1, **style, layers=config.head_layers)
        masks = player_masks(config.groups, config.joint_groups, config.classes)
        self.register_buffer("masks", masks, persistent=False)
        weights = torch.tensor(spec.event_weights).repeat(spec.num_players)
        self.register_buffer("event_weights", weights, persistent=False)
        self.logits = self.filter.view.binary or self.filter.maxima is not None

    def prior(self, h: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch C G"]:
        """p(z | h) as probabilities (..., C, G)."""
        return probabilities(self.filter.grouped(self.prior_net(h)), self.config.unimix)

    def observe(
        self,
        obs: Float[Tensor, "T B P *shape"],
        actions: Int[Tensor, "T B P"],
        is_first: Bool[Tensor, "T B"],
        generator: torch.Generator | None = None,
    ) -> Observed:
        """Real windows through the model; arguments as `LatentFilter.observe_posterior`."""
        latent, posterior = self.filter.observe_posterior(obs, actions, is_first, generator)
        return Observed(latent, posterior, self.prior(latent.h))

    def step(self, latent: Latent, actions: Int[Tensor, "B P"], generator: torch.Generator | None = None) -> Latent:
        """One step of imagination: (h, z)_{t+1} from (h, z)_t and joint actions (B, P), z drawn from the prior."""
        h = self.filter.transition(latent, actions)
        return Latent(h, self.filter.drawn(self.prior(h), generator))

    def player_latent(self, latent: Latent, player: int) -> Float[Tensor, "*batch DCG"]:
        """(h, z^i) with the other player's private groups blanked: (..., D + C * G)."""
        return torch.cat([latent.h, latent.z * self.masks[player]], -1)

    def decode(self, latent: Latent) -> Float[Tensor, ...]:
        """Both players' observations, logits for binary views and counts: (..., P, *shape)."""
        lead = latent.h.shape[:-1]
        views = [
            decoder(self.player_latent(latent, player).flatten(0, -2)).unflatten(0, lead)
            for player, decoder in enumerate(self.decoders)
        ]
        return torch.stack(views, dim=len(lead))

    def observation_loss(
        self, decoded: Float[Tensor, "T B P *shape"], obs: Float[Tensor, "T B P *shape"]
    ) -> Float[Tensor, "T B"]:
        """-ln p(o | h, z) of both players (T, B), up to a constant; `decoded` and scaled `obs` (T, B, P, *shape).

        Bernoulli where all is 0 or 1; the same of n / N for counts n of at most N; else Gaussian.
        """
        return reconstruction_loss(decoded, obs, binary=self.logits, largest=self.filter.maxima)

    def event_logits(self, latent: Latent) -> Float[Tensor, "*batch PE"]:
        """(..., P * E), player-major."""
        return self.event_head(latent.flat())

    def event_probs(self, latent: Latent) -> Float[Tensor, "*batch PE"]:
        """p(r | h, z), player-major; with `imagination=mode` an event less likely than not counts for nothing."""
        probs = torch.sigmoid(self.event_logits(latent))
        return probs * (probs > 0.5) if self.config.imagination == "mode" else probs

    def reward(self, latent: Latent) -> Float[Tensor, "*batch"]:
        """Joint reward (...): w . p(r | h, z), summed over players ("event-based rewards"), or of a scalar head."""
        if self.scalar:
            return self.event_head(latent.flat()).squeeze(-1)
        return (self.event_probs(latent) * self.event_weights).sum(-1)

    def reward_loss(self, latent: Latent, events: Float[Tensor, "T B PE"]) -> Float[Tensor, "T B"]:
        """-ln p(r | h, z) of the events that led to states (T, B), or of their joint reward as a Gaussian of variance
        1, up to a constant."""
        if self.scalar:
            return 0.5 * (self.reward(latent) - (events * self.event_weights).sum(-1)).square()
        return event_loss(self.event_logits(latent), events)

    def continuation(self, latent: Latent) -> Float[Tensor, "*batch"]:
        """Probability (...) that the episode continues from this state."""
        return torch.sigmoid(self.continue_head(latent.flat())).squeeze(-1)

    @torch.no_grad()
    def set_outputs(self, obs: Float[Tensor, "T B P *shape"], events: Float[Tensor, "T B PE"]) -> None:
        """Start decoders and event head at the data's means: rare events need not be unlearned first. Centre grids.

        Scaled obs (T, B, P, *shape) and events (T, B, P * E) in [0, 1].
        """
        obs_mean, event_mean = obs.mean((0, 1)), events.mean((0, 1))
        biases = torch.logit(obs_mean, eps=1e-3) if self.logits else obs_mean
        for decoder, bias in zip(self.decoders, biases, strict=True):
            assert isinstance(decoder, PlayerDecoder)
            decoder.output.copy_(bias)
        if self.filter.encoder.conv is not None:
            self.filter.encoder.center.copy_(obs_mean)
        means = (event_mean * self.event_weights).sum(-1, keepdim=True) if self.scalar else None
        _last_bias(self.event_head).copy_(torch.logit(event_mean, eps=1e-3) if means is None else means)
        _last_bias(self.continue_head).fill_(4.0)

    def exact(self, decoded: Tensor, obs: Tensor) -> Tensor:
        """(...,) bool: every number of both players' observations is right after rounding."""
        view, lead = self.filter.view, decoded.dim() - 1 - len(self.filter.view.shape)
        if view.binary:
            right = (decoded > 0.0) == (obs > 0.5)
        else:
            scale = view.scale if self.filter.maxima is None else self.filter.maxima
            means = torch.sigmoid(decoded) if self.logits else decoded
            right = torch.round(means * scale) == torch.round(obs * scale)
        return right.flatten(lead).all(-1)


def bernoulli_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Cross-entropy of one binary variable, same shape."""
    return F.binary_cross_entropy_with_logits(logits, target, reduction="none")


def _last_bias(net: nn.Sequential) -> nn.Parameter:
    last = net[-1]
    assert isinstance(last, nn.Linear) and isinstance(last.bias, nn.Parameter)
    return last.bias


# ---- terms of the loss (paper, equations WM and WM+) -----------------------------------------------------------------


def masked_mean(values: Float[Tensor, "T B"], mask: Float[Tensor, "T B"]) -> Float[Tensor, ""]:
    """Mean of values (T, B) where mask (T, B) is 1; 0 if nowhere."""
    return (values * mask).sum() / mask.sum().clamp(min=1.0)


def reconstruction_loss(
    outputs: Float[Tensor, "T B *shape"],
    target: Float[Tensor, "T B *shape"],
    *,
    binary: bool,
    largest: Tensor | None = None,
) -> Float[Tensor, "T B"]:
    """-ln p(o | h, z), up to a constant. (T, B, ...) -> (T, B).

    Args:
        outputs: logits of Bernoulli variables and counts if `binary`, else means of Gaussians of variance 1.
        target: for counts, their share of the largest count, whose logit is then the output.
        largest: largest counts (1 for a Bernoulli variable), broadcast to the outputs; None if all are 1. A count
            weighs as its root: as a Binomial one of n trials it would weigh n, and drown the variables beside it.
    """
    if binary:
        loss = F.binary_cross_entropy_with_logits(outputs, target, reduction="none")
        loss = loss if largest is None else largest.sqrt() * loss
    else:
        loss = 0.5 * (outputs - target).square()
    return loss.flatten(2).sum(-1)


def event_loss(logits: Float[Tensor, "T B PE"], target: Float[Tensor, "T B PE"]) -> Float[Tensor, "T B"]:
    """-ln p(r | h, z) of the binary event vector. (T, B, P * E) -> (T, B)."""
    return F.binary_cross_entropy_with_logits(logits, target, reduction="none").sum(-1)


def balanced_kl(
    posterior: Float[Tensor, "T B C G"], prior: Float[Tensor, "T B C G"], *, dyn: float, rep: float, free_nats: float
) -> tuple[Float[Tensor, "T B"], Float[Tensor, "T B"]]:
    """KL balancing with free nats (DreamerV2/V3).

        dyn * max(free, KL[sg(q) || p]) + rep * max(free, KL[q || sg(p)])

    Args:
        posterior, prior: probabilities (T, B, C, G).

    Returns:
        The weighted loss (T, B) and the raw KL (T, B) for logging.
    """
    dynamics = kl_divergence(posterior.detach(), prior)
    representation = kl_divergence(posterior, prior.detach())
    loss = dyn * dynamics.clamp(min=free_nats) + rep * representation.clamp(min=free_nats)
    return loss, dynamics.detach()


def predecessor_kl(posterior: Float[Tensor, "T B C G"], predecessor: Float[Tensor, "T B C G"]) -> Float[Tensor, "T B"]:
    """KL[q_j(z | h, o) || q_k(z | h, o)] on cross-play data with k (paper, eq. WM+). (T, B, C, G) -> (T, B)."""
    return kl_divergence(posterior, predecessor.detach())


def event_counts(
    logits: Float[Tensor, "T B P E"], target: Float[Tensor, "T B P E"], mask: Float[Tensor, "T B"]
) -> dict[str, Tensor]:
    """True positives, predicted and actual positives per event at threshold 1/2, over the masked steps.

    logits, target (T, B, P, E); mask (T, B). Each result (E,). Precision = hits / predicted, recall = hits / actual.
    """
    chosen = mask.bool()
    predicted, actual = (logits > 0.0)[chosen].float(), target[chosen]
    total = {"hits": predicted * actual, "predicted": predicted, "actual": actual}
    none = torch.zeros(target.shape[-1], device=target.device)
    return {name: value.sum(dim=(0, 1)) if value.numel() else none for name, value in total.items()}


# ---- learning --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Starts:
    """Posteriors of real states. h (N, D) float32; z (N, G) uint8 class indices; pool (N,) uint8: OLD data of
    earlier members and random play, NEW_SP, NEW_XP; partner (N,) int16 of cross-play rows, 0 elsewhere.
    """

    h: np.ndarray
    z: np.ndarray
    pool: np.ndarray
    partner: np.ndarray

    def __len__(self) -> int:
        return len(self.pool)

    @staticmethod
    def concat(parts: list[Starts]) -> Starts:
        """All parts in order."""
        columns = ("h", "z", "pool", "partner")
        return Starts(*(np.concatenate([getattr(part, name) for part in parts]) for name in columns))


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
        norm = w.clip_gradients(self.model.parameters(), self.config.grad_clip)
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


def fit_partners(learner: ModelLearner, actors: Mapping[int, Actor], windows: Windows, steps: int) -> list[Fit]:
    """Predecessors' actors, by member, learn to act on the present model's latents, of the windows' later half, as
    they do on those of their archived filters: the model has changed since they were trained."""
    batch = WindowBatch.from_windows(windows, learner.model)
    late, obs = len(batch.is_first) // 2, (batch.obs, batch.actions, batch.is_first)
    with torch.no_grad():
        latent = learner.model.observe(*obs, learner.generator).latent[late:]
    latent, fits = Latent(latent.h.flatten(0, 1), latent.z.flatten(0, 1)), []
    both = torch.arange(learner.spec.num_players, device=learner.device).expand(len(latent.h), -1)
    for member, actor in actors.items():
        with torch.no_grad():
            theirs, _ = learner.predecessors[member].observe_posterior(*obs, learner.generator)
            theirs = Latent(theirs.h[late:].flatten(0, 1), theirs.z[late:].flatten(0, 1))
            wanted = actor.to(learner.device).log_probs(theirs.expand_players(), both)
        fits.append(fit_actor(actor, latent, wanted, steps, learner.rng))
    return fits
