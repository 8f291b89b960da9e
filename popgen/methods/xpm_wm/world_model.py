"""The two-player world model of XPM-WM (paper, section 4.1): RSSM, joint encoder, per-player decoders, event head.

    recurrent state   h_t = f(h_{t-1}, z_{t-1}, a^1_{t-1}, a^2_{t-1})
    posterior         z_t ~ q(. | h_t, o^1_t, o^2_t)
    prior             z_t ~ p(. | h_t)
    decoder           o^i_t ~ p(. | h_t, z^i_t),  z^i = (z^joint, z^{p_i})
    events            r_t ~ Bernoulli(. | h_t, z_t), one per event and player
    continue          c_t ~ Bernoulli(. | h_t, z_t)

`LatentFilter` is what acting needs (and what a predecessor leaves behind); `WorldModel` adds what imagining and
learning need. Latents are class-major, see `popgen.methods.xpm_wm.latents`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from popgen.envs.contract import EnvSpec, ViewSpec
from popgen.methods.xpm_wm import latents
from popgen.methods.xpm_wm.config import WorldModelConfig
from popgen.methods.xpm_wm.latents import Latent
from popgen.methods.xpm_wm.world_model_losses import reconstruction
from popgen.nets.blocks import ConvDecoder, ConvEncoder, NormGRUCell, mlp
from popgen.shapes import check


@dataclass(frozen=True)
class Observed:
    """A window of real data seen through the model, time first.

    latent: h (T, B, D), z (T, B, C * G); posterior, prior: probabilities (T, B, C, G).
    """

    latent: Latent
    posterior: Tensor
    prior: Tensor


class JointEncoder(nn.Module):
    """Both players' observations (B, P, *shape) -> embedding (B, units).

    Grid views are centred first (`center`, see `WorldModel.set_outputs`): what never changes would fill the layers.
    """

    center: Tensor

    def __init__(self, config: WorldModelConfig, view: ViewSpec) -> None:
        super().__init__()
        self.conv = None
        inputs = 2 * view.shape[0]
        if len(view.shape) == 3:
            shape = (view.shape[0], view.shape[1], 2 * view.shape[2])
            self.conv = ConvEncoder(
                shape,
                channels=config.cnn_channels,
                kernels=config.cnn_kernels,
                activation=config.activation,
                norm=config.norm,
            )
            inputs = self.conv.features
            self.register_buffer("center", torch.zeros(2, *view.shape))
        self.trunk = mlp(inputs, None, **_layer_style(config), layers=config.encoder_layers)

    def forward(self, obs: Tensor) -> Tensor:
        """(B, P, *shape) -> (B, units)."""
        if self.conv is None:
            return self.trunk(obs.flatten(1))
        obs = obs - self.center
        return self.trunk(self.conv(torch.cat([obs[:, 0], obs[:, 1]], -1)))


class PlayerDecoder(nn.Module):
    """One player's observation from (h, z^i): (B, D + C * G) -> logits or means (B, *shape).

    `output` is the last bias, one number for each of the observation's.
    """

    def __init__(self, config: WorldModelConfig, view: ViewSpec, inputs: int) -> None:
        super().__init__()
        flat = len(view.shape) == 1
        self.trunk = mlp(inputs, view.shape[0] if flat else None, **_layer_style(config), layers=config.decoder_layers)
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


class LatentFilter(nn.Module):
    """Encoder, recurrent state model and posterior: what tracks the latent state of a running episode."""

    maxima: Tensor | None

    def __init__(self, config: WorldModelConfig, spec: EnvSpec) -> None:
        super().__init__()
        self.config = config
        self.view: ViewSpec = spec.views[config.view]
        maxima = None if self.view.maxima is None else torch.tensor(self.view.maxima)
        self.register_buffer("maxima", maxima, persistent=False)
        self.num_actions = spec.num_actions
        self.latent_size = config.classes * config.groups
        self.encoder = JointEncoder(config, self.view)
        step_inputs = self.latent_size + 2 * self.num_actions
        self.step_net = None
        if config.recurrent_units:
            style: dict[str, Any] = {**_layer_style(config), "units": config.recurrent_units}
            self.step_net = mlp(step_inputs + config.deter, None, **style, layers=1)
            step_inputs = config.recurrent_units
        self.gru = NormGRUCell(step_inputs, config.deter)
        inputs = config.deter + config.units
        self.posterior_net = mlp(inputs, self.latent_size, **_layer_style(config), layers=config.posterior_layers)

    def initial(self, batch: int) -> Latent:
        """The state before the first observation: zeros."""
        device, dtype = self.gru.gates.weight.device, self.gru.gates.weight.dtype
        return Latent(
            torch.zeros(batch, self.config.deter, device=device, dtype=dtype),
            torch.zeros(batch, self.latent_size, device=device, dtype=dtype),
        )

    def transition(self, latent: Latent, actions: Int[Tensor, "B P"]) -> Float[Tensor, "B D"]:
        """h_t from the state and joint actions (B, P) int64 of step t - 1; actions < 0 count as none."""
        classes = torch.arange(self.num_actions, device=actions.device)
        one_hot = (actions.unsqueeze(-1) == classes).flatten(1).to(latent.h.dtype)
        inputs = torch.cat([latent.z, one_hot], -1)
        if self.step_net is not None:
            inputs = self.step_net(torch.cat([inputs, latent.h], -1))
        return self.gru(inputs, latent.h)

    def posterior(
        self, h: Float[Tensor, "*batch D"], embedding: Float[Tensor, "*batch U"]
    ) -> Float[Tensor, "*batch C G"]:
        """q(z | h, o) as probabilities (..., C, G)."""
        logits = self.posterior_net(torch.cat([h, embedding], -1))
        return latents.probabilities(self.grouped(logits), self.config.unimix)

    def grouped(self, flat: Float[Tensor, "*batch CG"]) -> Float[Tensor, "*batch C G"]:
        """(..., C * G) -> (..., C, G)."""
        return flat.unflatten(-1, (self.config.classes, self.config.groups))

    def scaled(self, obs: Tensor) -> Tensor:
        """Observations as floats in the range that networks see and decoders predict."""
        obs = obs.to(self.gru.gates.weight.dtype)
        if self.maxima is not None:
            return obs / self.maxima
        return obs if self.view.scale == 1.0 else obs / self.view.scale

    def before(
        self, latent: Latent, actions: Int[Tensor, "B P"], is_first: Bool[Tensor, " B"]
    ) -> tuple[Latent, Int[Tensor, "B P"]]:
        """State and actions of the previous step, blanked where an episode (or window) begins."""
        keep = (~is_first).to(latent.h.dtype).unsqueeze(-1)
        blanked = torch.where(is_first.unsqueeze(-1), torch.full_like(actions, -1), actions)
        return Latent(latent.h * keep, latent.z * keep), blanked

    @torch.no_grad()
    def filter(
        self,
        latent: Latent,
        obs: Shaped[Tensor, "B P *shape"],
        actions: Int[Tensor, "B P"],
        is_first: Bool[Tensor, " B"],
        generator: torch.Generator | None = None,
    ) -> Latent:
        """One step of acting: the state after seeing obs (B, P, *shape), actions (B, P) having led to it."""
        h = self.transition(*self.before(latent, actions, is_first))
        probs = self.posterior(h, self.encoder(self.scaled(obs)))
        return Latent(h, self.drawn(probs, generator))

    def drawn(
        self, probs: Float[Tensor, "*batch C G"], generator: torch.Generator | None = None
    ) -> Float[Tensor, "*batch CG"]:
        """Latents for acting and imagining, (..., C, G) -> (..., C * G).

        `imagination=mode` takes the most likely class: where the task itself is deterministic, a sampled latent
        only adds errors, and a policy learns to farm the rare ones that pay. `sample` is the paper's.
        """
        if self.config.imagination == "mode":
            return latents.mode_one_hot(probs).to(probs.dtype).flatten(-2)
        return latents.sample_one_hot(probs, generator).flatten(-2)

    def observe_posterior(
        self,
        obs: Float[Tensor, "T B P *shape"],
        actions: Int[Tensor, "T B P"],
        is_first: Bool[Tensor, "T B"],
        generator: torch.Generator | None = None,
    ) -> tuple[Latent, Float[Tensor, "T B C G"]]:
        """Filter a window, time first, with gradients: states (T, B, .) and posteriors (T, B, C, G).

        Args:
            obs: (T, B, P, *shape) scaled floats.
            actions: (T, B, P) int64, the joint action *before* each step.
            is_first: (T, B) bool.
        """
        steps, batch = is_first.shape
        check(actions, (steps, batch, 2), "actions")
        embedding = self.encoder(obs.flatten(0, 1)).unflatten(0, (steps, batch))
        state = self.initial(batch)
        hs, zs, posteriors = [], [], []
        for t in range(steps):
            h = self.transition(*self.before(state, actions[t], is_first[t]))
            posterior = self.posterior(h, embedding[t])
            state = Latent(h, latents.straight_through(posterior, generator).flatten(-2))
            hs.append(h)
            zs.append(state.z)
            posteriors.append(posterior)
        return Latent(torch.stack(hs), torch.stack(zs)), torch.stack(posteriors)


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
        style = _layer_style(config)
        self.prior_net = mlp(config.deter, size, **style, layers=config.prior_layers)
        self.decoders = nn.ModuleList(PlayerDecoder(config, self.filter.view, inputs) for _ in range(2))
        outputs = spec.num_events * spec.num_players
        self.event_head = mlp(inputs, outputs, **style, layers=config.head_layers)
        self.continue_head = mlp(inputs, 1, **style, layers=config.head_layers)
        masks = latents.player_masks(config.groups, config.joint_groups, config.classes)
        self.register_buffer("masks", masks, persistent=False)
        weights = torch.tensor(spec.event_weights).repeat(spec.num_players)
        self.register_buffer("event_weights", weights, persistent=False)
        self.logits = self.filter.view.binary or self.filter.maxima is not None

    def prior(self, h: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch C G"]:
        """p(z | h) as probabilities (..., C, G)."""
        return latents.probabilities(self.filter.grouped(self.prior_net(h)), self.config.unimix)

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
        return reconstruction(decoded, obs, binary=self.logits, largest=self.filter.maxima)

    def event_logits(self, latent: Latent) -> Float[Tensor, "*batch PE"]:
        """(..., P * E), player-major."""
        return self.event_head(latent.flat())

    def event_probs(self, latent: Latent) -> Float[Tensor, "*batch PE"]:
        """p(r | h, z), player-major; with `imagination=mode` an event less likely than not counts for nothing."""
        probs = torch.sigmoid(self.event_logits(latent))
        return probs * (probs > 0.5) if self.config.imagination == "mode" else probs

    def reward(self, latent: Latent) -> Float[Tensor, "*batch"]:
        """Joint reward (...): w . p(r | h, z), summed over players (paper, "event-based rewards")."""
        return (self.event_probs(latent) * self.event_weights).sum(-1)

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
        _last_bias(self.event_head).copy_(torch.logit(event_mean, eps=1e-3))
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


def _layer_style(config: WorldModelConfig) -> dict[str, Any]:
    return {"units": config.units, "activation": config.activation, "norm": config.norm}
