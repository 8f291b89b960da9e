"""Centralised critics of one member: one of its self-play, and of its cross-play one shared or one for each partner."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from popgen.envs.contract import EnvSpec
from popgen.methods.xpm_sim.advantages import batch_advantages
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_sim.shared_encoder import SharedEncoder
from popgen.methods.xpm_sim.simulation import SimulatedBatch
from popgen.methods.xpm_sim.vae import latent_view
from popgen.nets.feed_forward import Sizes, ValueNet, joint

SELF, SHARED = "self", "cross"
"""Keys of the self-play critic and of the one shared by all partners; separate ones are keyed by the partner."""


class CriticInputs(NamedTuple):
    """What a critic sees: an observation (R, *shape) and further numbers (R, X)."""

    obs: Tensor
    extras: Tensor


InputsOf = Callable[[Tensor, Tensor], CriticInputs]
"""What all seats see (R, P, *view.shape) in some columns (R,) -> what the critic of these columns sees."""


@dataclass(frozen=True)
class CriticBatch:
    """What one critic learns from a batch: obs (R, *shape) and extras (R, X) that it sees, returns (R,)."""

    key: str
    obs: Tensor
    extras: Tensor
    returns: Tensor

    def __getitem__(self, rows: Tensor) -> CriticBatch:
        return CriticBatch(self.key, self.obs[rows], self.extras[rows], self.returns[rows])


class Evaluation(NamedTuple):
    """Advantages (T, n) of some columns, and what their critic learns from them."""

    advantage: Tensor
    lesson: CriticBatch


class MemberCritics:
    """The critics of a member beside `partners`.

    Args:
        encoder: whose latent the critics see instead of the observation, if there is one.
        seed: of the initial weights.
    """

    def __init__(
        self, config: XpmSimConfig, spec: EnvSpec, partners: Iterable[int], encoder: SharedEncoder | None, seed: int
    ) -> None:
        self.config, self.encoder, self.partners = config, encoder, sorted(partners)
        self.observed, self.players = spec.views["features"], spec.num_players
        view = self.observed if encoder is None else latent_view(config.latent)
        generator = torch.Generator().manual_seed(seed)
        sizes = Sizes(config.units, config.layers, config.activation)
        self.shared, count = config.xp_critic == "shared", len(self.partners)
        self.nets = torch.nn.ModuleDict({SELF: ValueNet(view, 0, sizes, generator)})
        if count and self.shared:
            self.nets[SHARED] = ValueNet(view, self.players + count, sizes, generator)
        elif count:
            self.nets.update({str(k): ValueNet(view, self.players, sizes, generator) for k in self.partners})

    def net(self, key: str) -> ValueNet:
        """The critic of a key."""
        net = self.nets[key]
        assert isinstance(net, ValueNet)
        return net

    def evaluate_self_play(self, batch: SimulatedBatch) -> Evaluation:
        """All self-play columns."""

        def inputs(obs: Tensor, columns: Tensor) -> CriticInputs:
            return CriticInputs(self._join_players(obs), torch.zeros(len(obs), 0))

        return self._evaluate_columns(batch, batch.columns.self_play, SELF, inputs)

    def evaluate_cross_play(self, batch: SimulatedBatch, partner: int) -> Evaluation:
        """The cross-play columns: the critic sees the member's own view first, its seat, and which partner it is."""
        seats, eye = torch.from_numpy(batch.columns.seats), torch.eye(self.players)
        which = torch.eye(len(self.partners))[self.partners.index(partner)] if self.shared else torch.zeros(0)

        def inputs(obs: Tensor, columns: Tensor) -> CriticInputs:
            seat = seats[columns]
            both = torch.stack([obs[torch.arange(len(obs)), seat], obs[torch.arange(len(obs)), 1 - seat]], 1)
            return CriticInputs(self._join_players(both), torch.cat([eye[seat], which.expand(len(obs), -1)], -1))

        return self._evaluate_columns(batch, batch.columns.cross_play, SHARED if self.shared else str(partner), inputs)

    def _join_players(self, obs: Tensor) -> Tensor:
        """What critics see of all players' observations (R, P, *view.shape), the first player's first."""
        return joint(obs, self.observed) if self.encoder is None else self.encoder.latent(obs[:, 0])

    def _evaluate_columns(self, batch: SimulatedBatch, columns: slice, key: str, inputs: InputsOf) -> Evaluation:
        critic, config = self.net(key), self.config

        def value(obs: Tensor, column: Tensor) -> Tensor:
            return critic.value(*inputs(obs, column))

        advantage, returns = batch_advantages(batch, columns, value, discount=config.discount, lam=config.lam)
        time, count = returns.shape
        seen = inputs(batch.obs[:-1, columns].flatten(0, 1), torch.arange(count).repeat(time))
        valid = batch.valid[:, columns].flatten()
        return Evaluation(advantage, CriticBatch(key, seen.obs, seen.extras, returns.flatten())[valid])

    def update_statistics(self, lessons: Iterable[CriticBatch]) -> None:
        """Take the returns into the critics' moving statistics."""
        for lesson in lessons:
            self.net(lesson.key).see(lesson.returns, self.config.value_decay)

    def losses(self, lessons: Iterable[CriticBatch]) -> dict[str, Tensor]:
        """Mean squared errors of normalised returns, by the figure's name."""
        losses = {}
        for lesson in lessons:
            critic = self.net(lesson.key)
            error = critic(lesson.obs, lesson.extras).squeeze(-1) - critic.normalised(lesson.returns)
            losses["critic_loss_sp" if lesson.key == SELF else "critic_loss_xp"] = error.square().mean()
        return losses
