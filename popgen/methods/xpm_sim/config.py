"""XPM-Sim with the exact simulator as dynamics model F. The defaults are the laptop's recipe for the cramped room."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from popgen.config.run_config import RunConfig
from popgen.config.schema import (
    Batch,
    Fraction,
    Layers,
    NonNegative,
    Positive,
    Rate,
    Schema,
    Weight,
    Width,
    _Float,
    _Int,
)
from popgen.errors import UserError

_Steps = Annotated[_Int, Field(ge=1, le=100_000)]  # of one simulated trajectory
_Some = Annotated[_Int, Field(ge=0, le=100_000)]  # of what may be left out


class XpmSimConfig(Schema):
    """Buffers, simulated trajectories and the objective (paper, section 3 and the table of MPPMR agents).

    Networks: units, layers, activation, of actor and critics alike; xp_critic `shared` tells one network its partner,
        `separate` has one for each partner, as in the paper.
    Real episodes: every `updates_per_round` of a member's `updates`, `episodes_sp` and `episodes_xp` whole episodes by
        the present policy; the latter are shared by the partners in turn. Starts are drawn from the last `recent`.
    Simulated trajectories (horizons in steps; `unroll` is the length of an update's batch):
        sims_sp: self-play, `starts_initial` of them from the environment's start, the others from B_SP;
        sims_restart: self-play from B_XP;
        sims_xp: cross-play with one partner, `xp_initial` of them from the start, the others from B_XP.
    Objective: the three groups' means enter with `sp_weight`, `restart_weight` and -`lambda_xp`, which rises over
        `lambda_ramp` updates and is 0 after the share `lambda_until` of them. Advantages are in units of self-play's
        spread; those of cross-play are bounded by `xp_clip` of them (0: not at all), so that a large loss for the team,
        such as the penalty of leaving, is no larger gain than holding to another convention. Surrogate `ppo`
        (clipped, several epochs) or `reinforce`.
    Ablation: with encoder `shared` all members act on the latent of one variational autoencoder of the joint
        observation, trained on buffered states beside member 1 and on, at `encoder_lr_later` (0: frozen).
    """

    units: Width = 128
    layers: Layers = 2
    activation: Literal["tanh", "leaky_relu"] = "leaky_relu"
    xp_critic: Literal["shared", "separate"] = "shared"
    capacity: Positive = 200_000
    recent: Positive = 16
    episodes_sp: Batch = 4
    episodes_xp: Batch = 8
    updates_per_round: Positive = 5
    updates: Positive = 75
    horizon: _Steps = 400
    restart_horizon: _Steps = 50
    xp_horizon: _Steps = 100
    unroll: _Steps = 100
    sims_sp: Batch = 64
    sims_restart: _Some = 32
    sims_xp: _Some = 48
    starts_initial: Fraction = 1.0
    xp_initial: Fraction = 0.25
    surrogate: Literal["ppo", "reinforce"] = "ppo"
    epochs: Annotated[_Int, Field(ge=1, le=1000)] = 2
    minibatches: Annotated[_Int, Field(ge=1, le=10_000)] = 12
    clip: Rate = 0.2
    discount: Fraction = 0.99
    lam: Fraction = 0.95
    value_decay: Fraction = 0.95
    learning_rate: Rate = 2e-3
    entropy: Weight = 0.01
    grad_clip: Weight = 0.5
    lambda_xp: Weight = 0.75
    lambda_ramp: NonNegative = 10
    lambda_until: Fraction = 1.0
    xp_clip: Weight = 0.0
    sp_weight: Weight = 1.0
    restart_weight: Weight = 1.0
    partner: Literal["max_window", "max_buffer"] = "max_window"
    partner_random: Fraction = 0.15
    check_pairs: Batch = 64
    encoder: Literal["none", "shared"] = "none"
    latent: Width = 32
    encoder_units: Width = 128
    encoder_layers: Layers = 2
    encoder_updates: Positive = 10
    encoder_batch: Batch = 256
    encoder_lr: Rate = 1e-3
    encoder_lr_later: Annotated[_Float, Field(ge=0.0, le=1.0)] = 1e-3
    encoder_kl: Weight = 1e-3

    @model_validator(mode="after")
    def _trajectories_fit(self) -> XpmSimConfig:
        """Those with a new partner or from B_XP begin with each update, so that they cannot outlast it."""
        for name in ("restart_horizon", "xp_horizon"):
            if getattr(self, name) > self.unroll:
                raise UserError(name, f"is longer than unroll ({self.unroll})", "lower it or raise xpm_sim.unroll")
        if self.surrogate == "reinforce" and (self.epochs, self.minibatches) != (1, 1):
            problem = "takes one step per batch: the second would no longer be on policy"
            raise UserError("surrogate", f"reinforce {problem}", "set xpm_sim.epochs=1 and xpm_sim.minibatches=1")
        if self.minibatches > self.sims_sp * self.unroll:
            raise UserError("minibatches", "exceeds the samples of a batch", "lower it")
        return self


class XpmSimRun(RunConfig):
    """A run of XPM-Sim."""

    method: Literal["xpm_sim"] = "xpm_sim"
    xpm_sim: XpmSimConfig = XpmSimConfig()
