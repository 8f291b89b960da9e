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
    Rate,
    Schema,
    Text,
    Weight,
    Width,
    _Int,
)
from popgen.errors import UserError

_Steps = Annotated[_Int, Field(ge=1, le=100_000)]  # of one rollout, sequence or decision


class EgoConfig(Schema):
    """Whom an ego is trained with, its network and PPO.

    partners: folders of populations, each with `:1,3` behind it for some members only; `popgen ego train` fills it in.
    pinned: the digests of these populations' manifests, in their order, which `popgen ego train` fills in: a run is
        resumed with the same partners or not at all.
    sampling: `uniform` gives every partner the same number of episodes in each seat; `prioritised` draws partner and
        seat in proportion to rank(1 / return) ** priority, over a running mean of the returns that forgets 5 % of
        itself with each episode.
    network: `features_gru`, two linear layers and a GRU of `units` on the seat's features; `conv_lstm`, three
        convolutions of `channels`, two linear layers and an LSTM on the seat's lossless view. Both see the seat and the
        previous actions of both players.
    head_units: of the actor's hidden layer. critic_units: of the critic's two, which sees the seat and the partner.
    steps: of training. envs: stepped together. unroll: steps of each between two updates. sequence: steps through
        which gradients flow back; the memory's state at their beginning is kept from the rollout.
    learning_rate falls evenly to the share `learning_rate_end` of itself, entropy to `entropy_end`.
    """

    partners: tuple[Text, ...] = ()
    pinned: tuple[str, ...] = ()
    sampling: Literal["uniform", "prioritised"] = "uniform"
    priority: Weight = 0.5
    network: Literal["features_gru", "conv_lstm"] = "features_gru"
    units: Width = 128
    channels: Width = 26
    head_units: Width = 64
    critic_units: Width = 128
    steps: Positive = 4_000_000
    envs: Batch = 128
    unroll: _Steps = 100
    sequence: _Steps = 50
    epochs: Annotated[_Int, Field(ge=1, le=1000)] = 4
    minibatches: Annotated[_Int, Field(ge=1, le=10_000)] = 4
    clip: Rate = 0.2
    discount: Fraction = 0.99
    lam: Fraction = 0.95
    learning_rate: Rate = 1e-3
    learning_rate_end: Fraction = 0.1
    entropy: Weight = 0.01
    entropy_end: Fraction = 1.0
    value_weight: Weight = 0.5
    value_decay: Fraction = 0.95
    grad_clip: Weight = 0.5

    @model_validator(mode="after")
    def _batches_fit(self) -> EgoConfig:
        if self.unroll % self.sequence:
            raise UserError("sequence", f"does not divide unroll ({self.unroll})", "choose a divisor of it")
        sequences = self.envs * (self.unroll // self.sequence)
        if self.minibatches > sequences:
            raise UserError("minibatches", f"exceeds the {sequences} sequences of an update", "lower it")
        return self


class HiptConfig(Schema):
    """The two levels of HiPT (Loo, Gong and Meghjani 2023).

    skills: the high level chooses one of so many z. duration_least, duration_most: a z is kept for a number of steps
        drawn evenly from these, both included.
    influence: the high level is paid the mean over a segment's steps of reward + (1 - f) (influence - 1) u, where u is
        the influence of z on the action, and f is 1 at the beginning and 0 at the end of training.
    first_segment: `mean`, or `published`: the sum for the first segment of each episode, as the published code has it.
    discount, lam: over decisions.
    entropy: of the high level.
    """

    skills: Annotated[_Int, Field(ge=2, le=64)] = 4
    duration_least: _Steps = 20
    duration_most: _Steps = 39
    influence: Annotated[Number, Field(ge=1.0)] = 100.0
    first_segment: Literal["mean", "published"] = "mean"
    discount: Fraction = 0.99
    lam: Fraction = 0.98
    entropy: Weight = 0.01

    @model_validator(mode="after")
    def _durations_in_order(self) -> HiptConfig:
        if self.duration_least > self.duration_most:
            raise UserError("duration_least", f"is above duration_most ({self.duration_most})", "lower it")
        return self


class AugmentConfig(Schema):
    """Start states of self-play beside the environment's own.

    share: of the episodes that begin in a state of earlier play of this training, moved on by random joint actions.
    random_steps: at most so many of them, drawn evenly from 0.
    kept: states that are kept to start from, drawn evenly from all play so far.
    """

    share: Fraction = 0.5
    random_steps: NonNegative = 20
    kept: Positive = 4096


class EgoRun(RunConfig):
    """What runs of all ego agents share."""

    ego: EgoConfig = EgoConfig()

    @property
    def plays_itself(self) -> bool:
        """The ego has no partner but itself."""
        return False


class HiptRun(EgoRun):
    """A run of HiPT."""

    method: Literal["hipt"] = "hipt"
    hipt: HiptConfig = HiptConfig()


class FcpRun(EgoRun):
    """A flat ego beside many partners."""

    method: Literal["fcp"] = "fcp"


class BrRun(EgoRun):
    """A best response to one partner."""

    method: Literal["br"] = "br"


class SpRun(EgoRun):
    """Self-play."""

    method: Literal["sp"] = "sp"

    @property
    def plays_itself(self) -> bool:
        """See `EgoRun`."""
        return True


class SpAugRun(EgoRun):
    """Self-play from augmented start states."""

    method: Literal["sp_aug"] = "sp_aug"
    augment: AugmentConfig = AugmentConfig()

    @property
    def plays_itself(self) -> bool:
        """See `EgoRun`."""
        return True
