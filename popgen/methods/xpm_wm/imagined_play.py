"""One batch of imagination: self-play of a member and, beside it, cross-play with a frozen partner."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from popgen.methods.xpm_wm.actor_critic import Actor
from popgen.methods.xpm_wm.config import AgentConfig
from popgen.methods.xpm_wm.imagination import Imagined, JointActor
from popgen.methods.xpm_wm.latents import Latent, from_indices
from popgen.methods.xpm_wm.start_states import Starts, draw_cross_play, draw_self_play


class ImaginedPlay(NamedTuple):
    """Self-play columns and, after them, cross-play columns; in the latter, the agent's seat (C,) int64."""

    imagined: Imagined
    seats: Tensor


def draw_start_rows(
    config: AgentConfig, starts: Starts, new_share: float, partner: int | None, rng: np.random.Generator
) -> np.ndarray:
    """Rows of `starts` for a batch: `starts_sp` of self-play and, with a partner, `starts_xp` of cross-play."""
    rows = draw_self_play(starts, config.starts_sp, new_share, config.sp_from_xp, rng)
    if partner is None or not config.starts_xp:
        return rows
    only = partner if config.xp_starts == "partner" else None
    return np.concatenate([rows, draw_cross_play(starts, config.starts_xp, new_share, only, rng)])


def start_latents(starts: Starts, rows: np.ndarray, classes: int, device: torch.device, dtype: torch.dtype) -> Latent:
    """The stored model states of `rows`."""
    z = from_indices(torch.from_numpy(starts.z[rows]).to(device), classes).flatten(-2)
    return Latent(torch.from_numpy(starts.h[rows]).to(device, dtype), z.to(dtype))


def cross_play_seats(count: int, device: torch.device) -> Tensor:
    """(count,) the agent's seat: 0 in the first half, 1 in the second."""
    return (torch.arange(count, device=device) >= count // 2).long()


def joint_actor(own: Actor, partner: Actor | None, first: int, seats: Tensor, generator: torch.Generator) -> JointActor:
    """Both seats by `own`, but for the other seat than `seats` in the columns from `first` on, which is `partner`'s."""
    both = torch.tensor([0, 1], device=seats.device)
    columns = first + torch.arange(len(seats), device=seats.device)

    def act(latent: Latent) -> Tensor:
        pair = latent.expand_players()
        actions = own.sample(pair, both.expand(pair.h.shape[:-1]), generator)
        if partner is not None:
            actions[columns, 1 - seats] = partner.sample(latent[first:], 1 - seats, generator)
        return actions

    return act
