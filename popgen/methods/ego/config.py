"""Settings of ego agents. The defaults are the laptop's recipe for the cramped room."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from popgen.config.run_config import RunConfig
from popgen.config.schema import (
    Batch,
    Fraction,
    NonNegative,
    Number,
    Positive,
    Schema,
    Text,
    Weight,
    Width,
    _Int,
)
from popgen.config.sections import PpoSection
from popgen.errors import UserError

_Steps = Annotated[_Int, Field(ge=1, le=100_000)]  # of one rollout, sequence or decision


class EgoConfig(PpoSection):
    """Whom an ego is trained with, its network and PPO."""

    partners: tuple[Text, ...] = ()
    """Folders of populations, each with `:1,3` behind it for some members only; `popgen ego train` fills it in."""
    pinned: tuple[str, ...] = ()
    """Digests of these populations' manifests, in their order, which `popgen ego train` fills in: a run goes on with
    the same partners or not at all."""
    sampling: Literal["uniform", "prioritised"] = "uniform"
    """`uniform`: every partner has the same number of episodes in each seat; `prioritised`: partner and seat are drawn
    in proportion to rank(1 / return) ** `priority`, by a running mean of which each return replaces 5 %."""
    priority: Weight = 0.5
    """Exponent of prioritised sampling."""
    other_starts: Fraction = 0.0
    """Share of the episodes beside partners that begin in a state of earlier play, moved on by random actions."""
    network: Literal["features_gru", "conv_lstm"] = "features_gru"
    """`features_gru`: two linear layers and a GRU on the seat's features; `conv_lstm`: three convolutions, two linear
    layers and an LSTM on its lossless view. Both see the seat and the previous actions of both players."""
    units: Width = 128
    """Width of the linear layers and the memory."""
    channels: Width = 26
    """Of each convolution."""
    head_units: Width = 64
    """Width of the actor's hidden layer."""
    critic_units: Width = 128
    """Width of the critic's two hidden layers; it sees the joint features, the seat and the partner's number."""
    steps: Positive = 4_000_000
    """Environment steps of training."""
    envs: Batch = 128
    """Environments stepped together."""
    unroll: _Steps = 100
    """Steps of each environment between two updates."""
    sequence: _Steps = 50
    """Steps through which gradients flow back; the memory before them is kept from the rollout."""
    epochs: Annotated[_Int, Field(ge=1, le=1000)] = 3
    """Passes over the data of an update."""
    learning_rate_end: Fraction = 0.1
    """Share of `learning_rate` that is left at the end of training; it falls in a straight line."""
    value_weight: Weight = 0.5
    """Weight of the critic's error, on the scale of normalised returns."""
    value_decay: Fraction = 0.95
    """By which the moving mean and spread of returns forget, per update."""
    grad_clip: Weight = 0.5
    """Largest norm of a gradient, to which longer ones are scaled down; 0: as they are."""

    @model_validator(mode="after")
    def _batches_fit(self) -> EgoConfig:
        if self.unroll % self.sequence:
            raise UserError("sequence", f"does not divide unroll ({self.unroll})", "choose a divisor of it")
        sequences = self.envs * (self.unroll // self.sequence)
        if self.minibatches > sequences:
            raise UserError("minibatches", f"exceeds the {sequences} sequences of an update", "lower it")
        return self


class HiptConfig(Schema):
    """The two levels of HiPT (Loo, Gong and Meghjani 2023)."""

    skills: Annotated[_Int, Field(ge=2, le=64)] = 4
    """Number of z, of which the high level chooses one."""
    duration_least: _Steps = 20
    """Least steps of a z; how many is drawn evenly up to `duration_most`."""
    duration_most: _Steps = 39
    """Most steps of a z."""
    influence: Annotated[Number, Field(ge=1.0)] = 100.0
    """c_k: the high level is paid the mean over a segment's steps of reward + (1 - f) (c_k - 1) u, where u is the
    influence of z on the action, and f falls from 1 to 0 over training."""
    low_influence: Weight = 0.1
    """Weight of I(z; a) in the low level's objective, as that of its entropy; 0: as published. Without it the low
    level has no reason to heed z: whatever the high level is paid, u is not its own to raise."""
    low_influence_most: Weight = 0.1
    """Nats of I(z; a) from which on the low level is paid no more."""
    first_segment: Literal["mean", "published"] = "mean"
    """`published`: the first segment of each episode is paid the sum instead, as in the published code."""
    discount: Fraction = 0.99
    """Of the high level's rewards, by decision."""
    lam: Fraction = 0.98
    """Lambda of its advantages."""
    entropy: Weight = 0.01
    """Weight of the entropy of its choices."""
    high_weight: Weight = 0.1
    """Weight of the high level's loss in the sum; 1: as published. Its few decisions give the memory, which both levels
    share, noisy gradients that take most of what `ego.grad_clip` leaves."""

    @model_validator(mode="after")
    def _durations_in_order(self) -> HiptConfig:
        if self.duration_least > self.duration_most:
            raise UserError("duration_least", f"is above duration_most ({self.duration_most})", "lower it")
        return self


class AugmentConfig(Schema):
    """Start states of self-play beside the environment's own."""

    share: Fraction = 0.5
    """Of the episodes that begin in a state of earlier play of this training, moved on by random joint actions."""
    random_steps: NonNegative = 20
    """Most of these actions; how many is drawn evenly from 0."""
    kept: Positive = 4096
    """States that are kept to start from, drawn evenly from all play so far."""


class EgoRun(RunConfig):
    """What runs of all ego agents share."""

    ego: EgoConfig = EgoConfig()
    """Partners, network and PPO."""

    @property
    def plays_itself(self) -> bool:
        """The ego has no partner but itself."""
        return False


class HiptRun(EgoRun):
    """A run of HiPT."""

    method: Literal["hipt"] = "hipt"
    """Name of the method."""
    hipt: HiptConfig = HiptConfig()
    """The two levels."""


class EgoFcpRun(EgoRun):
    """A flat ego beside many partners."""

    method: Literal["ego_fcp"] = "ego_fcp"
    """Name of the method."""


class BrRun(EgoRun):
    """A best response to one partner."""

    method: Literal["br"] = "br"
    """Name of the method."""


class SpRun(EgoRun):
    """Self-play."""

    method: Literal["sp"] = "sp"
    """Name of the method."""

    @property
    def plays_itself(self) -> bool:
        """See `EgoRun`."""
        return True


class SpAugRun(EgoRun):
    """Self-play from augmented start states."""

    method: Literal["sp_aug"] = "sp_aug"
    """Name of the method."""
    augment: AugmentConfig = AugmentConfig()
    """Start states."""

    @property
    def plays_itself(self) -> bool:
        """See `EgoRun`."""
        return True
