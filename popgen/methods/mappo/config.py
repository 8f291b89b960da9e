"""The baselines on RLlib's MAPPO: networks, rollouts and objective. The defaults are the laptop's recipe."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from popgen.config.run_config import RunConfig
from popgen.config.schema import Batch, Fraction, Layers, NonNegative, Positive, Rate, Schema, Weight, Width, _Int
from popgen.errors import UserError

_Kernel = Annotated[_Int, Field(ge=1, le=31)]


class PpoConfig(Schema):
    """MAPPO (Yu et al. 2022): decentralised actors, a centralised critic, the clipped surrogate.

    Networks: of actors and critics alike, each with weights of its own; `cnn_kernels` for a grid view only.
    Rollouts: `envs` self-play environments per member, `steps` of each in every iteration, shared by `runners` remote
        processes (0: none, this process steps them).
    Updates: the learning rate and the entropy bonus go in a straight line to `..._end` times their value at
        `max_steps`. `value_decay` is of the moving statistics that normalise the returns, per iteration.
    End: a member's training ends with the iteration in which its self-play has taken `max_steps`; or earlier, once the
        mean score of its last `window` self-play episodes has reached `target_score` (and, in a method with
        cross-play, the strongest partner's is at most `diversity.target_xp`).
    """

    view: Literal["features", "lossless"] = "features"
    units: Width = 128
    layers: Layers = 2
    activation: Literal["tanh", "leaky_relu"] = "tanh"
    cnn_kernels: Annotated[tuple[_Kernel, ...], Field(max_length=16)] = ()
    cnn_channels: Width = 32
    envs: Batch = 64
    steps: Annotated[_Int, Field(ge=1, le=100_000)] = 100
    runners: Annotated[_Int, Field(ge=0, le=10_000)] = 0
    epochs: Annotated[_Int, Field(ge=1, le=1000)] = 4
    minibatches: Annotated[_Int, Field(ge=1, le=10_000)] = 4
    clip: Rate = 0.2
    discount: Fraction = 0.99
    lam: Fraction = 0.95
    learning_rate: Rate = 1e-3
    learning_rate_end: Fraction = 1.0
    entropy: Weight = 0.01
    entropy_end: Fraction = 1.0
    grad_clip: Weight = 0.5
    value_weight: Weight = 1.0
    value_decay: Fraction = 0.9
    max_steps: Positive = 800_000
    target_score: Weight = 10.5
    window: Positive = 64

    @model_validator(mode="after")
    def _fits(self) -> PpoConfig:
        if self.minibatches > self.envs * self.steps:
            raise UserError("minibatches", f"exceeds the {self.envs * self.steps:,} steps of an iteration", "lower it")
        if self.runners > self.envs:
            raise UserError("runners", f"{self.runners} cannot share {self.envs} environments", "lower it")
        if (self.view == "lossless") != bool(self.cnn_kernels):
            problem = f"is {list(self.cnn_kernels)} with view={self.view}"
            raise UserError("cnn_kernels", problem, "give odd kernels for lossless, none for features")
        if any(kernel % 2 == 0 for kernel in self.cnn_kernels):
            raise UserError("cnn_kernels", "must be odd, so that a convolution keeps the grid's size", "choose 3 or 5")
        return self


class DiversityConfig(Schema):
    """Cross-play and mixed play of LIPO and CoMeDi (paper, equations LIPO and CoMeDi).

    order: `concurrent` trains all members together, each the others' partner; `sequential` one after the other against
        frozen predecessors. CoMeDi is sequential.
    lambda_xp, lambda_mp: weights of cross-play and mixed play beside self-play's 1; lambda_xp rises in a straight line
        over the first `warmup` iterations. With lambda_mp=0 no mixed play is sampled.
    xp_envs, mp_envs: environments with each partner, half of them in each seating.
    xp_loss: `signed` negates the advantage before the clipped surrogate, `negated` the surrogate after it, as two
        published code bases do.
    partner_random: share of iterations in which a random partner takes the strongest one's place, so that the critics
        of the others are not forgotten.
    window: episodes with a partner (both seatings) behind its return. CoMeDi instead plays `select_episodes` fresh
        episodes with each partner in each seating, every `select_every` iterations, and goes by all of these.
    target_xp: see `ppo.target_score`.
    """

    order: Literal["concurrent", "sequential"] = "concurrent"
    lambda_xp: Weight = 0.25
    lambda_mp: Weight = 0.25
    warmup: NonNegative = 10
    xp_envs: Annotated[_Int, Field(ge=2, le=100_000, multiple_of=2)] = 32
    mp_envs: Annotated[_Int, Field(ge=2, le=100_000, multiple_of=2)] = 32
    xp_loss: Literal["signed", "negated"] = "signed"
    partner_random: Fraction = 0.15
    window: Positive = 32
    select_every: Positive = 5
    select_episodes: Batch = 2
    target_xp: Weight = 2.0


class BaselineRun(RunConfig):
    """What the runs of all baselines have."""

    ppo: PpoConfig = PpoConfig()


class MappoRun(BaselineRun):
    """A run of MAPPO: self-play alone."""

    method: Literal["mappo"] = "mappo"


class PartnerRun(BaselineRun):
    """What the runs of baselines that meet partners have."""

    diversity: DiversityConfig = DiversityConfig()


class LipoRun(PartnerRun):
    """A run of LIPO."""

    method: Literal["lipo"] = "lipo"


class ComediRun(PartnerRun):
    """A run of CoMeDi."""

    method: Literal["comedi"] = "comedi"
