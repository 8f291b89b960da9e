"""The latent state of a running episode: grouped categorical latents, and the filter that tracks them.

    recurrent state   h_t = f(h_{t-1}, z_{t-1}, a^1_{t-1}, a^2_{t-1})
    posterior         z_t ~ q(. | h_t, o^1_t, o^2_t)

Latents are class-major, (..., C, G): softmax and sampling over a last dimension of eight classes waste the vector units
of a CPU; with the classes second to last, every operation runs over the G groups contiguously (about ten times faster).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Integer, Shaped, UInt8
from torch import Tensor, nn

from popgen.envs.contract import EnvSpec, ViewSpec
from popgen.methods.xpm_wm.config import WorldModelConfig
from popgen.nets.blocks import ConvEncoder, linear, mlp
from popgen.policies.portable_program import ProgramWriter
from popgen.types import check


@dataclass(frozen=True)
class Latent:
    """Model state: h (..., D) deterministic, z (..., C * G) flat one-hot sample."""

    h: Tensor
    z: Tensor

    def flat(self) -> Tensor:
        """(..., D + C * G), the input of every head and critic."""
        return torch.cat([self.h, self.z], -1)

    def expand_players(self) -> Latent:
        """Each state once for each of the two players: (..., P, .)."""
        h, z = self.h.unsqueeze(-2), self.z.unsqueeze(-2)
        return Latent(h.expand(*h.shape[:-2], 2, h.shape[-1]), z.expand(*z.shape[:-2], 2, z.shape[-1]))

    def __getitem__(self, index: Any) -> Latent:
        return Latent(self.h[index], self.z[index])


def probabilities(logits: Float[Tensor, "*batch C G"], unimix: float) -> Float[Tensor, "*batch C G"]:
    """Softmax over the classes, mixed with a uniform share (DreamerV3). logits (..., C, G) -> same."""
    probs = torch.softmax(logits, dim=-2)
    return probs * (1.0 - unimix) + unimix / logits.shape[-2]


def sample_one_hot(
    probs: Float[Tensor, "*batch C G"], generator: torch.Generator | None = None
) -> Float[Tensor, "*batch C G"]:
    """One-hot samples (..., C, G) by inverting the cumulative distribution; no gradient."""
    cumulative = probs.detach().float().cumsum(dim=-2)
    total = cumulative[..., -1:, :]
    uniform = torch.rand(total.shape, generator=generator, device=probs.device)
    passed = (cumulative >= uniform * total).to(probs.dtype)
    one_hot = passed.clone()
    one_hot[..., 1:, :] -= passed[..., :-1, :]
    return one_hot


def mode_one_hot(probs: Float[Tensor, "*batch C G"]) -> Float[Tensor, "*batch C G"]:
    """The most likely class of every group, the first of equals: one-hot (..., C, G); no gradient.

    Comparing with the maximum is twenty times faster than `argmax` over a dimension that is not the last.
    """
    probs = probs.detach().float()
    best = (probs >= probs.amax(dim=-2, keepdim=True)).float()
    return best * (best.cumsum(dim=-2) <= 1.0)


def straight_through(
    probs: Float[Tensor, "*batch C G"], generator: torch.Generator | None = None
) -> Float[Tensor, "*batch C G"]:
    """One-hot samples whose gradient is that of the probabilities."""
    return sample_one_hot(probs, generator) + probs - probs.detach()


def kl_divergence(p: Float[Tensor, "*batch C G"], q: Float[Tensor, "*batch C G"]) -> Float[Tensor, "*batch"]:
    """KL[p || q] summed over groups; probabilities (..., C, G) -> (...)."""
    return (p * (p.log() - q.log())).sum(dim=(-2, -1))


def player_masks(groups: int, joint_groups: int, classes: int) -> Tensor:
    """(P, C * G) masks that keep the joint groups and player p's own (paper: z^i = (z^joint, z^{p_i})).

    The first `joint_groups` groups are joint, the rest is halved between the two players.
    """
    private = (groups - joint_groups) // 2
    mask = torch.zeros(2, groups)
    mask[:, :joint_groups] = 1.0
    mask[0, joint_groups : joint_groups + private] = 1.0
    mask[1, joint_groups + private :] = 1.0
    return mask[:, None, :].expand(2, classes, groups).reshape(2, classes * groups).contiguous()


def to_indices(one_hot: Float[Tensor, "*batch C G"]) -> UInt8[Tensor, "*batch G"]:
    """(..., C, G) one-hot -> (..., G) uint8 class indices, 1 / C of the memory."""
    return one_hot.argmax(dim=-2).to(torch.uint8)


def from_indices(indices: Integer[Tensor, "*batch G"], classes: int) -> Float[Tensor, "*batch {classes} G"]:
    """(..., G) class indices -> (..., C, G) float one-hot."""
    grid = torch.arange(classes, device=indices.device).unsqueeze(-1)
    return (indices.unsqueeze(-2) == grid).float()


# ---- the filter ------------------------------------------------------------------------------------------------------


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
        self.trunk = mlp(inputs, None, **layer_style(config), layers=config.encoder_layers)

    def forward(self, obs: Tensor) -> Tensor:
        """(B, P, *shape) -> (B, units)."""
        if self.conv is None:
            return self.trunk(obs.flatten(1))
        obs = obs - self.center
        return self.trunk(self.conv(torch.cat([obs[:, 0], obs[:, 1]], -1)))


class NormGRUCell(nn.Module):
    """GRU cell with one layer norm over its three gates (DreamerV2/V3); starts out slow to forget."""

    def __init__(self, inputs: int, units: int) -> None:
        super().__init__()
        self.units = units
        self.gates = linear(inputs + units, 3 * units)
        self.norm = nn.LayerNorm(3 * units, eps=1e-3)

    def forward(self, inputs: Tensor, hidden: Tensor) -> Tensor:
        """inputs (B, I), hidden (B, D) -> (B, D)."""
        reset, candidate, update = self.norm(self.gates(torch.cat([inputs, hidden], -1))).chunk(3, -1)
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        update = torch.sigmoid(update - 1.0)
        return hidden + update * (candidate - hidden)


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
            style: dict[str, Any] = {**layer_style(config), "units": config.recurrent_units}
            self.step_net = mlp(step_inputs + config.deter, None, **style, layers=1)
            step_inputs = config.recurrent_units
        self.gru = NormGRUCell(step_inputs, config.deter)
        inputs = config.deter + config.units
        self.posterior_net = mlp(inputs, self.latent_size, **layer_style(config), layers=config.posterior_layers)

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
        return probabilities(self.grouped(logits), self.config.unimix)

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

    def write_program(self, writer: ProgramWriter) -> tuple[str, str]:
        """One step of acting on flat views of 0 and 1; the names of h and z."""
        h, z = writer.add_memory("h", self.config.deter), writer.add_memory("z", self.latent_size)
        inputs = writer.add_operation("join", (z, "joint"))
        if self.step_net is not None:
            inputs = writer.add_layers(self.step_net, writer.add_operation("join", (inputs, h)))
        joined = writer.add_operation("join", (inputs, h))
        writer.add_operation("norm_gru", writer.add_layers((self.gru.gates, self.gru.norm), joined), into=h)
        embedding = writer.add_layers(self.encoder.trunk, "both")
        logits = writer.add_layers(self.posterior_net, writer.add_operation("join", (h, embedding)))
        writer.add_operation("modes", logits, into=z, classes=self.config.classes)
        return h, z

    def drawn(
        self, probs: Float[Tensor, "*batch C G"], generator: torch.Generator | None = None
    ) -> Float[Tensor, "*batch CG"]:
        """Latents for acting and imagining, (..., C, G) -> (..., C * G).

        `imagination=mode` takes the most likely class: where the task itself is deterministic, a sampled latent
        only adds errors, and a policy learns to farm the rare ones that pay. `sample` is the paper's.
        """
        if self.config.imagination == "mode":
            return mode_one_hot(probs).to(probs.dtype).flatten(-2)
        return sample_one_hot(probs, generator).flatten(-2)

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
            state = Latent(h, straight_through(posterior, generator).flatten(-2))
            hs.append(h)
            zs.append(state.z)
            posteriors.append(posterior)
        return Latent(torch.stack(hs), torch.stack(zs)), torch.stack(posteriors)


def layer_style(config: WorldModelConfig) -> dict[str, Any]:
    """What all layers of the world model share."""
    return {"units": config.units, "activation": config.activation, "norm": config.norm}
