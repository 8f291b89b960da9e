"""XPM-WM: the world model, the agents on it, and the two phases. The defaults are the laptop's recipe."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StrictBool, model_validator

from popgen.config.run_config import RunConfig
from popgen.config.schema import (
    Batch,
    Fraction,
    Layers,
    NonNegative,
    Number,
    Positive,
    Rate,
    Schema,
    UniformShare,
    Weight,
    Width,
    _Int,
)
from popgen.errors import UserError

PREFILL_CHUNK = 400
"""Steps of each environment in one segment of random play."""

OPEN_LOOP = 4
"""Steps without observations at which the world model's open-loop figures are taken."""


class WorldModelConfig(Schema):
    """The two-player RSSM (paper, section 4.1 and the table of XPM-WM hyper-parameters)."""

    view: Literal["features", "lossless"] = "features"
    encoder_layers: Layers = 2
    decoder_layers: Layers = 2
    cnn_kernels: Annotated[tuple[Annotated[_Int, Field(ge=1, le=31)], ...], Field(min_length=1, max_length=16)] = (
        5,
        3,
        3,
    )
    cnn_channels: Width = 32
    units: Width = 128
    deter: Width = 128
    recurrent_units: Annotated[_Int, Field(ge=0, le=16_384)] = 256
    prior_layers: Layers = 1
    posterior_layers: Layers = 1
    head_layers: Layers = 2
    groups: Annotated[_Int, Field(ge=1, le=1024)] = 32
    joint_groups: Positive = 16
    classes: Annotated[_Int, Field(ge=2, le=256)] = 8
    unimix: UniformShare = 0.01
    activation: Literal["silu", "leaky_relu"] = "silu"
    norm: StrictBool = True
    learning_rate: Rate = 2e-3
    grad_clip: Weight = 100.0
    batch: Batch = 64
    length: Annotated[_Int, Field(ge=2, le=1024)] = 8
    kl_dyn: Weight = 1.0
    kl_rep: Weight = 0.03
    free_nats: Weight = 1.0
    event_scale: Weight = 3.0
    continue_scale: Weight = 1.0
    kl_predecessors: Weight = 0.0
    predecessors: Literal["partner", "latest", "all"] = "partner"
    imagination: Literal["mode", "sample"] = "mode"

    @model_validator(mode="after")
    def _groups_divide(self) -> WorldModelConfig:
        if self.joint_groups >= self.groups or (self.groups - self.joint_groups) % 2:
            problem = f"must leave an even, positive number of the {self.groups} groups for the two players"
            raise UserError("joint_groups", problem, "lower it")
        return self

    @model_validator(mode="after")
    def _kernels_keep_the_grid(self) -> WorldModelConfig:
        if any(kernel % 2 == 0 for kernel in self.cnn_kernels):
            raise UserError("cnn_kernels", "must be odd, so that a convolution keeps the grid's size", "choose 3 or 5")
        return self


class AgentConfig(Schema):
    """Actor, centralised critics and the XPM-Sim objective (paper, equation XPM-Sim).

    Every imagined batch is learned from in `epochs` passes of `minibatches`, with the `surrogate` `ppo` (clipped) or,
    in one step, `reinforce`. Advantages are in units of their own standard deviation in self-play (`spread`) or of
    the moving range of `return_percentiles` of self-play's `returns`.
    """

    units: Width = 128
    layers: Layers = 2
    activation: Literal["silu", "leaky_relu"] = "silu"
    norm: StrictBool = True
    actor_input: Literal["model", "latent"] = "model"
    horizon: Annotated[_Int, Field(ge=1, le=1000)] = 15
    starts_sp: Batch = 256
    starts_xp: Batch = 128
    discount: Fraction = 0.99
    lam: Fraction = 0.95
    surrogate: Literal["ppo", "reinforce"] = "ppo"
    epochs: Annotated[_Int, Field(ge=1, le=1000)] = 2
    minibatches: Annotated[_Int, Field(ge=1, le=10_000)] = 12
    clip: Rate = 0.2
    advantage_unit: Literal["spread", "returns"] = "spread"
    actor_lr: Rate = 1e-3
    critic_lr: Rate = 1e-3
    adam_eps: Rate = 1e-5
    entropy: Weight = 0.02
    entropy_end: Weight = 0.02
    entropy_after: Fraction = 0.5  # of a phase's target_score: the self-play at which the ramp begins
    entropy_ramp: NonNegative = 50
    grad_clip: Weight = 0.5
    unimix: UniformShare = 0.01
    bins: Annotated[_Int, Field(ge=3, le=10_001)] = 65
    slow_critic: Fraction = 0.0
    return_percentiles: tuple[Number, Number] = (5.0, 95.0)
    lambda_xp: Weight = 0.35
    lambda_start: Weight = 0.25
    lambda_ramp: NonNegative = 100
    sp_from_xp: Fraction = 0.5
    xp_starts: Literal["partner", "any"] = "partner"
    partner: Literal["max_window", "max_buffer"] = "max_window"
    partner_random: Fraction = 0.3
    precision: Literal["auto", "float32", "bfloat16"] = "auto"

    @model_validator(mode="after")
    def _percentiles_are_a_range(self) -> AgentConfig:
        low, high = self.return_percentiles
        if not 0.0 <= low < high <= 100.0:
            problem = f"must be two ascending numbers within [0, 100] (got {low:g} and {high:g})"
            raise UserError("return_percentiles", problem, "choose 5 and 95")
        return self

    @model_validator(mode="after")
    def _on_policy(self) -> AgentConfig:
        if self.surrogate == "reinforce" and (self.epochs, self.minibatches) != (1, 1):
            problem = "reinforce takes one step per batch: the second would no longer be on policy"
            raise UserError("surrogate", problem, "set agent.epochs=1 and agent.minibatches=1")
        if self.minibatches > self.horizon * min(self.starts_sp, self.starts_xp):
            raise UserError("minibatches", "exceeds the samples of a batch", "lower it")
        return self


_TRUNKS = "units", "activation", "norm"
_FILTER = (
    *("view", "encoder_layers", "cnn_kernels", "cnn_channels", "deter", "recurrent_units", "posterior_layers"),
    *("groups", "joint_groups", "classes", *_TRUNKS),
)
SHAPES: dict[str, tuple[str, ...]] = {
    "world_model": (*_FILTER, "decoder_layers", "prior_layers", "head_layers"),
    "agent": (*_TRUNKS, "layers", "actor_input"),
}
"""Fields that decide the shapes of the weights which a continued run takes over."""

ACTING: dict[str, tuple[str, ...]] = {
    "world_model": (*_FILTER, "unimix", "imagination"),
    "agent": (*SHAPES["agent"], "unimix"),
}
"""Fields that decide how a saved member acts; all others concern training and may change between versions."""


class ReplayConfig(Schema):
    """B_SP and B_XP."""

    capacity: Positive = 2_000_000
    event_fraction: Fraction = 0.4


class Phase1Config(Schema):
    """Member 1: self-play together with the world model.

    event_starts: when imagination also starts from windows that were drawn for an event: once real self-play has passed
        `agent.entropy_after` of the target, or always.
    """

    envs: Batch = 64
    prefill_steps: Positive = 256_000
    prefill_interact: Fraction = 0.3
    pretrain_updates: Positive = 1500
    steps_per_iteration: Positive = 100
    model_updates: Positive = 25
    agent_updates: Positive = 5
    event_starts: Literal["playing", "always"] = "playing"
    recent_fraction: Fraction = 0.5
    recent_rows: Positive = 50_000
    max_steps: Positive = 680_000
    restart_after: NonNegative = 0
    restart_updates: NonNegative = 0
    check_every: Positive = 5
    target_score: Number = 10.5
    patience: Positive = 1000


class Phase2Config(Schema):
    """Members 2..M: mostly imagination, few real episodes."""

    first_updates: Positive = 100
    updates_per_round: Positive = 60
    model_updates: NonNegative = 300
    model_lr: Rate = 1e-3
    episodes_sp: Batch = 8
    episodes_xp: Batch = 8
    rounds: Positive = 8
    max_rounds: Positive = 9  # for a member whose best self-play is below the target
    target_score: Number = 8.0
    max_steps: Positive | None = None  # SP and XP training steps of one member; whichever of the two ends first
    cache: Positive = 8192
    starts_random: Fraction = 0.6
    starts_event: Fraction = 0.2
    starts_new: Fraction = 0.5
    event_reach: Positive = 10
    new_fraction: Fraction = 0.5

    @model_validator(mode="after")
    def _shares_of_starts(self) -> Phase2Config:
        if self.starts_random + self.starts_event > 1.0 + 1e-9:
            raise UserError("starts_random", "exceeds 1 together with starts_event", "lower one of them")
        return self


class XpmWmRun(RunConfig):
    """A run of XPM-WM."""

    method: Literal["xpm_wm"] = "xpm_wm"
    world_model: WorldModelConfig = WorldModelConfig()
    agent: AgentConfig = AgentConfig()
    replay: ReplayConfig = ReplayConfig()
    phase1: Phase1Config = Phase1Config()
    phase2: Phase2Config = Phase2Config()

    @model_validator(mode="after")
    def _check_windows(self) -> XpmWmRun:
        """Every segment must hold a window of the reports, the caches some windows, the replays a segment."""
        phase, window = self.phase1, self.world_model.length + OPEN_LOOP
        prefill = min(PREFILL_CHUNK, phase.prefill_steps // phase.envs)
        if prefill < window:
            problem = f"gives each environment {prefill} steps, a window of the reports is {window}"
            raise UserError("phase1.prefill_steps", problem, f"make it at least {window * phase.envs}")
        if phase.steps_per_iteration < window:
            problem = f"is less than world_model.length + {OPEN_LOOP}, a window of the reports"
            raise UserError("phase1.steps_per_iteration", problem, f"make it at least {window}")
        segment = phase.envs * max(prefill, phase.steps_per_iteration)
        if self.replay.capacity < segment:
            problem = f"cannot hold the {segment:,} steps that phase1 adds at once"
            raise UserError("replay.capacity", problem, "raise it or lower phase1.envs")
        if self.phase2.cache < 4 * self.world_model.length:
            raise UserError("phase2.cache", "is less than four times world_model.length", "raise it")
        return self
