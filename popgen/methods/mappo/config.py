"""The baselines on RLlib's MAPPO: networks, rollouts and objective. The defaults are the laptop's recipe."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from popgen.config.cross_play_options import PaidCrossPlayOptions
from popgen.config.run_config import RunConfig
from popgen.config.schema import (
    AddedLater,
    Batch,
    Fraction,
    Layers,
    NonNegative,
    Positive,
    Rate,
    Schema,
    Weight,
    Width,
    _Int,
)
from popgen.config.sections import PpoSection
from popgen.errors import UserError

_Kernel = Annotated[_Int, Field(ge=1, le=31)]


class PpoConfig(PpoSection):
    """MAPPO (Yu et al. 2022): decentralised actors, a centralised critic, the clipped surrogate.

    Actors and critics have the same sizes and weights of their own. A member's training ends with an iteration.
    """

    view: Literal["features", "lossless"] = "features"
    """What actors and critics see: a flat vector of features, or the lossless grid (which needs `cnn_kernels`)."""
    units: Width = 128
    """Width of the hidden layers."""
    layers: Layers = 2
    """Hidden layers of each network."""
    activation: Literal["tanh", "leaky_relu"] = "tanh"
    """Nonlinearity of the hidden layers."""
    cnn_kernels: Annotated[tuple[_Kernel, ...], Field(max_length=16)] = ()
    """Sizes of the convolutions' kernels, odd, one a layer; only for the lossless view."""
    cnn_channels: Width = 32
    """Channels of each convolution."""
    envs: Batch = 64
    """Self-play environments of each member."""
    steps: Annotated[_Int, Field(ge=1, le=100_000)] = 100
    """Steps of each environment in every iteration."""
    runners: Annotated[_Int, Field(ge=0, le=10_000)] = 0
    """Remote processes that share the environments; 0: the learner's process steps them."""
    epochs: Annotated[_Int, Field(ge=1, le=1000)] = 4
    """Passes over an iteration's samples."""
    learning_rate_end: Fraction = 1.0
    """Share of `learning_rate` that is left at `max_steps`; it falls in a straight line."""
    grad_clip: Weight = 0.5
    """Largest norm of a gradient, to which longer ones are scaled down; 0: as they are."""
    value_weight: Weight = 1.0
    """Weight of the critic's loss beside the policy's."""
    value_decay: Fraction = 0.9
    """Decay per iteration of the moving mean and variance that normalise the returns."""
    max_steps: Positive = 800_000
    """Self-play environment steps that end a member's training."""
    target_score: Weight = 10.5
    """Mean self-play score that ends it earlier; with partners `diversity.target_xp` must hold too."""
    window: Positive = 64
    """Latest self-play episodes behind that mean."""

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


class DiversityConfig(PaidCrossPlayOptions):
    """Cross-play and mixed play of LIPO and CoMeDi (paper, equations LIPO and CoMeDi)."""

    order: Literal["concurrent", "sequential"] = "concurrent"
    """`concurrent`: all members at once, each the others' partner; `sequential`: against frozen predecessors."""
    lambda_xp: Weight = 0.25
    """Weight of cross-play with the strongest partner beside self-play's 1 (lambda_XP, eq. LIPO and CoMeDi)."""
    lambda_mp: Weight = 0.25
    """Weight of mixed play beside self-play's 1 (lambda_MP, eq. CoMeDi); 0 samples none."""
    warmup: NonNegative = 10
    """Iterations over which lambda_XP rises in a straight line from 0; 0: full weight at once."""
    xp_envs: Annotated[_Int, Field(ge=2, le=100_000, multiple_of=2)] = 32
    """Cross-play environments with each partner, half of them in each seating."""
    mp_envs: Annotated[_Int, Field(ge=2, le=100_000, multiple_of=2)] = 32
    """Mixed-play environments with each partner, half of them in each seating."""
    xp_loss: Literal["signed", "negated"] = "signed"
    """`signed` negates the advantage before the clipped surrogate; `negated` the surrogate after it."""
    partner_random: Fraction = 0.15
    """Share of iterations with a random partner in the strongest one's place: no critic is forgotten."""
    window: Positive = 32
    """Latest cross-play episodes with a partner, both seatings, behind its return (LIPO)."""
    select_every: Positive = 5
    """Iterations between two choices of the strongest partner by fresh episodes (CoMeDi)."""
    select_episodes: Batch = 2
    """Fresh episodes with each partner in each seating behind such a choice (CoMeDi)."""
    target_xp: Weight = 2.0
    """Largest mean cross-play score, with any partner, at which `ppo.target_score` may end the training."""


class BaselineRun(RunConfig):
    """What the runs of all baselines have."""

    ppo: PpoConfig = PpoConfig()
    """Networks, rollouts and updates of MAPPO."""


class MappoRun(BaselineRun):
    """A run of MAPPO: self-play alone."""

    method: Literal["mappo"] = "mappo"
    """Self-play alone."""


class FcpRun(BaselineRun):
    """A run of FCP: three members a seed."""

    method: Literal["fcp"] = "fcp"
    """Self-play by several seeds, each kept at three skills."""


class MepConfig(Schema):
    """The population entropy of MEP (Zhao et al. 2023)."""

    alpha: Weight = 0.01
    """Reward for each nat of surprise and seat, where the training reward of a dish is 18 or more (the paper's alpha);
    0 is MAPPO, but several members have other first weights than its."""
    floor: Rate = 1e-5
    """Least probability that counts: it bounds what one step can earn."""


class MepRun(BaselineRun):
    """A run of MEP."""

    method: Literal["mep"] = "mep"
    """Self-play of all members together, paid for the population's entropy."""
    mep: MepConfig = MepConfig()
    """The population's entropy."""


class TrajediConfig(Schema):
    """The trajectory divergence of TrajeDi (Lupu et al. 2021)."""

    alpha: Weight = 0.1
    """Reward for each nat of divergence of a step, as of the action that makes it (the paper's alpha); 0 is MAPPO, but
    several members have other first weights than its."""
    full_score: Annotated[Weight, AddedLater] = 0.0
    """Mean self-play score at which alpha has its full weight; it rises with a member's score in a straight line from
    0; 0: full weight from the beginning."""
    kernel: Fraction = 0.5
    """Weight of a step's neighbour beside the step's own (the paper's gamma): 0 compares single actions, 1 all that an
    iteration has of an episode (`ppo.steps` at most)."""


class TrajediRun(BaselineRun):
    """A run of TrajeDi."""

    method: Literal["trajedi"] = "trajedi"
    """Self-play of all members together, paid for diverging trajectories."""
    trajedi: TrajediConfig = TrajediConfig()
    """The divergence of trajectories."""


class E3tConfig(Schema):
    """The partner of E3T (Yan et al. 2023): the member's own policy, mixed with chance."""

    epsilon: Fraction = 0.25
    """Share of uniformly random actions among the partner's (the paper's epsilon); 0 is MAPPO. A quarter of `ppo.envs`
    is without them: plain self-play tells the score, and is not learned from."""


class E3tRun(BaselineRun):
    """A run of E3T."""

    method: Literal["e3t"] = "e3t"
    """Play beside the own policy, which takes random actions now and then."""
    e3t: E3tConfig = E3tConfig()
    """The partner in training."""


class HspConfig(Schema):
    """Hidden-utility self-play (Yu et al. 2023): pairs of a biased agent and its partner."""

    pool: Positive = 12
    """Pairs that are trained together; the population is chosen from them, the others are counted and dropped."""
    members: Literal["both", "biased", "partners"] = "both"
    """Who of a chosen pair becomes a member; `both`: the biased agent, then its partner, two members a pair."""
    select: Literal["events", "responses"] = "events"
    """Pairs are chosen for the distance of the biased agents' events (HSP), or for the BR-Div of their partners', who
    are their best responses (ZSC-Eval)."""
    spread: Weight = 10.0
    """Largest weight of an event, either sign, where a dish is worth 18 or more; a fiftieth of it for events that can
    happen at every step. 0 leaves the true reward: one policy in both seats, which is MAPPO, but several
    pairs have other first weights than its members."""
    biases: Positive = 3
    """Events with a weight in each biased agent's utility, drawn from HSP's list."""
    reward: Weight = 1.0
    """Weight of the true reward in every utility."""
    least_score: Weight | None = 0.1
    """Pairs whose own score, in their latest `ppo.window` episodes, is no higher are not chosen as long as others are
    left; None chooses from all."""


class HspRun(BaselineRun):
    """A run of HSP."""

    method: Literal["hsp"] = "hsp"
    """Pairs of a biased agent and its partner, the most different of a pool."""
    hsp: HspConfig = HspConfig()
    """Utilities, pool and choice."""


class BpRun(BaselineRun):
    """A run that makes ZSC-Eval's behaviour-preferring partners."""

    method: Literal["bp"] = "bp"
    """The same pairs, chosen for what their partners, the best responses, have to do."""
    hsp: HspConfig = HspConfig()
    """Utilities, pool and choice."""


class BrdivConfig(Schema):
    """Best-response diversity (Rahman et al. 2023): pairs of a confederate and its best response."""

    alpha: Weight = 1.0
    """Weight of every difference between a pair's own return and its cross-play with another pair (eq. BRDiv); 0 leaves
    the pairs' own returns: no cross-play is sampled."""
    members: Literal["both", "confederates"] = "both"
    """Who of a pair becomes a member; `both`: the confederate, then its best response, two members a pair."""
    warmup: NonNegative = 10
    """Iterations over which cross-play's weight rises in a straight line from 0; 0: full weight at once."""
    xp_envs: Annotated[_Int, Field(ge=2, le=100_000, multiple_of=2)] = 32
    """Environments of a confederate with another's best response, half of them in each seating."""
    xp_clip: Weight = 0.0
    """Cross-play's advantages are bounded at so many spreads of self-play's; 0: not bounded."""
    target_xp: Weight = 2.0
    """Largest mean cross-play score, of any two pairs, at which `ppo.target_score` may end the training."""


class BrdivRun(BaselineRun):
    """A run of BRDiv."""

    method: Literal["brdiv"] = "brdiv"
    """Pairs of a confederate and its best response, good together and bad across."""
    brdiv: BrdivConfig = BrdivConfig()
    """Objective, cross-play and members."""


class PartnerRun(BaselineRun):
    """What the runs of baselines that meet partners have."""

    diversity: DiversityConfig = DiversityConfig()
    """Cross-play and mixed play with other members."""


class LipoRun(PartnerRun):
    """A run of LIPO."""

    method: Literal["lipo"] = "lipo"
    """Self-play less cross-play with the strongest partner."""


class ComediRun(PartnerRun):
    """A run of CoMeDi."""

    method: Literal["comedi"] = "comedi"
    """The same, with mixed play, against frozen predecessors."""
