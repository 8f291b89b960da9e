"""XPM-Sim with the exact simulator as dynamics model F. The defaults are the laptop's recipe for the cramped room."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from popgen.config.cross_play_options import PaidCrossPlayOptions
from popgen.config.run_config import RunConfig
from popgen.config.schema import (
    Batch,
    Fraction,
    Layers,
    NonNegative,
    Positive,
    Rate,
    Weight,
    Width,
    _Float,
    _Int,
)
from popgen.errors import UserError

_Steps = Annotated[_Int, Field(ge=1, le=100_000)]  # of one simulated trajectory
_Some = Annotated[_Int, Field(ge=0, le=100_000)]  # of what may be left out


class XpmSimConfig(PaidCrossPlayOptions):
    """Buffers, simulated trajectories and the objective (paper, section 3 and the table of MPPMR agents).

    The means over three groups of trajectories enter the objective: self-play from B_SP (`sims_sp`) and from B_XP
    (`sims_restart`), and, subtracted, cross-play with one partner (`sims_xp`). Advantages are in units of self-play's
    spread.
    """

    units: Width = 128
    """Width of the hidden layers of actor and critics."""
    layers: Layers = 2
    """Hidden layers of actor and critics."""
    activation: Literal["tanh", "leaky_relu"] = "leaky_relu"
    """Nonlinearity of the hidden layers."""
    xp_critic: Literal["shared", "separate"] = "shared"
    """`shared`: one network that is told its partner; `separate`: one for each partner, as in the paper."""
    capacity: Positive = 200_000
    """Steps that each of the buffers B_SP and B_XP holds (the paper's buffer size)."""
    recent: Positive = 16
    """Episodes' worth of latest steps of a buffer from which start states are drawn."""
    episodes_sp: Batch = 4
    """Real self-play episodes in every round."""
    episodes_xp: Batch = 8
    """Real cross-play episodes in every round, shared by the partners in turn."""
    updates_per_round: Positive = 5
    """Updates between two rounds of real episodes."""
    updates: Positive = 75
    """Updates of each member's actor and critics in all."""
    horizon: _Steps = 400
    """Steps of a simulated self-play trajectory (the paper's simulation horizon)."""
    restart_horizon: _Steps = 50
    """Steps of a simulated self-play trajectory from a state of B_XP; at most `unroll`."""
    xp_horizon: _Steps = 100
    """Steps of a simulated cross-play trajectory; at most `unroll`."""
    unroll: _Steps = 100
    """Steps of every trajectory in one update's batch."""
    sims_sp: Batch = 64
    """Simulated self-play trajectories of an update, from start states and B_SP."""
    sims_restart: _Some = 32
    """Simulated self-play trajectories of an update, from B_XP; 0 leaves this term out."""
    sims_xp: _Some = 48
    """Simulated cross-play trajectories of an update, with one partner; 0 leaves cross-play out."""
    starts_initial: Fraction = 1.0
    """Share of `sims_sp` that starts in the environment's start distribution, the others in B_SP."""
    xp_initial: Fraction = 0.25
    """Share of `sims_xp` that starts in the environment's start distribution, the others in B_XP."""
    surrogate: Literal["ppo", "reinforce"] = "ppo"
    """Policy objective: `ppo`, clipped, over several passes; `reinforce`, one step a batch, as in the paper."""
    epochs: Annotated[_Int, Field(ge=1, le=1000)] = 2
    """Passes over an update's batch; 1 with `reinforce`."""
    minibatches: Annotated[_Int, Field(ge=1, le=10_000)] = 12
    """Parts into which each pass divides the batch, a gradient step each; 1 with `reinforce`."""
    clip: Rate = 0.2
    """Largest change of the probability ratio that the surrogate rewards (PPO's epsilon)."""
    discount: Fraction = 0.99
    """Discount of rewards per step (gamma)."""
    lam: Fraction = 0.95
    """Lambda of the generalised advantage estimate: 0 trusts the critic, 1 the returns."""
    value_decay: Fraction = 0.95
    """Decay per update of the moving scale that normalises the returns."""
    learning_rate: Rate = 2e-3
    """Adam's step size, of actor and critics."""
    entropy: Weight = 0.01
    """Weight of the policy's entropy (the paper's entropy coef.)."""
    grad_clip: Weight = 0.5
    """Largest norm of a gradient, to which longer ones are scaled down; 0: as they are."""
    lambda_xp: Weight = 0.75
    """Weight of cross-play with the strongest partner, subtracted from self-play (lambda_XP, eq. XPM-Sim)."""
    lambda_ramp: NonNegative = 10
    """Updates over which lambda_XP rises in a straight line; 0: full weight at once."""
    lambda_until: Fraction = 1.0
    """Share of `updates` after which lambda_XP is 0; 1: never."""
    sp_weight: Weight = 1.0
    """Weight of self-play from start states and B_SP in the objective."""
    restart_weight: Weight = 1.0
    """Weight of self-play from B_XP in the objective."""
    partner: Literal["max_window", "max_buffer"] = "max_window"
    """Strongest partner by real cross-play returns: of its latest round, or of all its episodes."""
    partner_random: Fraction = 0.15
    """Share of updates with a random partner in the strongest one's place: no critic is forgotten."""
    check_pairs: Batch = 64
    """Pairs of starts, from B_SP and B_XP, in a finished member's check for self-sabotage."""
    encoder: Literal["none", "shared"] = "none"
    """Ablation: `shared` lets all members act on the latent of one autoencoder; `none`: on observations."""
    latent: Width = 32
    """Numbers in the shared encoder's latent."""
    encoder_units: Width = 128
    """Width of the shared encoder's hidden layers."""
    encoder_layers: Layers = 2
    """Hidden layers of the shared encoder and of its decoder."""
    encoder_updates: Positive = 10
    """Updates of the shared encoder in every round."""
    encoder_batch: Batch = 256
    """Buffered states in one update of the shared encoder."""
    encoder_lr: Rate = 1e-3
    """Adam's step size of the shared encoder beside member 1."""
    encoder_lr_later: Annotated[_Float, Field(ge=0.0, le=1.0)] = 1e-3
    """Adam's step size of the shared encoder beside later members; 0 freezes it."""
    encoder_kl: Weight = 1e-3
    """Weight of the latent's KL to a standard normal in the shared encoder's loss."""

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
    """Cross-play minimisation on trajectories of the exact simulator."""
    xpm_sim: XpmSimConfig = XpmSimConfig()
    """Buffers, simulated trajectories and objective."""
