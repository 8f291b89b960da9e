"""XPM-WM: the world model, the agents on it, and the two phases. The laptop's recipe says what differs from here."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StrictBool, model_validator

from popgen.config.cross_play_options import CrossPlayOptions
from popgen.config.run_config import RunConfig
from popgen.config.schema import (
    AddedLater,
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
    """What the model sees and reconstructs: a flat vector of features, or the lossless grid."""
    encoder_layers: Layers = 2
    """Hidden layers of the encoder, after any convolutions."""
    decoder_layers: Layers = 2
    """Hidden layers of the decoder, before any convolutions."""
    cnn_kernels: Annotated[tuple[Annotated[_Int, Field(ge=1, le=31)], ...], Field(min_length=1, max_length=16)] = (
        5,
        3,
        3,
    )
    """Sizes of the convolutions' kernels, odd, one a layer; used by the lossless view alone."""
    cnn_channels: Width = 32
    """Channels of each convolution."""
    units: Width = 128
    """Width of the hidden layers."""
    deter: Width = 128
    """Width of the recurrent state h."""
    recurrent_units: Annotated[_Int, Field(ge=0, le=16_384)] = 256
    """Width of the layer before the GRU; 0 leaves it out."""
    prior_layers: Layers = 1
    """Hidden layers of the prior p(z | h)."""
    posterior_layers: Layers = 1
    """Hidden layers of the posterior q(z | h, o)."""
    head_layers: Layers = 2
    """Hidden layers of the event (reward) and continue predictors."""
    groups: Annotated[_Int, Field(ge=1, le=1024)] = 32
    """Categorical variables of the latent z in all (the paper's N)."""
    joint_groups: Positive = 16
    """Those of them that both players share (the paper's K); each player has half of the others."""
    classes: Annotated[_Int, Field(ge=2, le=256)] = 8
    """Values of each categorical variable."""
    unimix: UniformShare = 0.01
    """Share of the uniform distribution that is mixed into every categorical variable."""
    activation: Literal["silu", "leaky_relu"] = "silu"
    """Nonlinearity of the hidden layers."""
    norm: StrictBool = True
    """Whether each hidden layer has a layer norm before its nonlinearity."""
    learning_rate: Rate = 2e-3
    """Adam's step size in phase 1."""
    grad_clip: Weight = 100.0
    """Largest norm of a gradient, to which longer ones are scaled down; 0: as they are."""
    batch: Batch = 64
    """Windows in one update."""
    length: Annotated[_Int, Field(ge=2, le=1024)] = 8
    """States in a window."""
    kl_dyn: Weight = 1.0
    """Weight of the KL that draws the prior to the posterior (eq. WM, KL balancing)."""
    kl_rep: Weight = 0.03
    """Weight of the KL that draws the posterior to the prior (eq. WM, KL balancing)."""
    free_nats: Weight = 1.0
    """KL in nats below which neither of the two is reduced."""
    reward_head: Literal["events", "scalar"] = "events"
    """What is predicted of a reward: `events`, the probability of each; `scalar`, the joint reward itself, as the mean
    of a Gaussian (the paper's ablation)."""
    event_scale: Weight = 3.0
    """Weight of the events' (reward's) loss beside the observation's 1."""
    continue_scale: Weight = 1.0
    """Weight of the continue flag's loss beside the observation's 1."""
    kl_predecessors: Weight = 0.0
    """Weight of the KL to earlier members' archived posteriors on cross-play (eq. WM+, gamma)."""
    predecessors: Literal["partner", "latest", "all"] = "partner"
    """Whose posteriors: of the partner in the window, of the latest member, or of all."""
    imagination: Literal["mode", "sample"] = "mode"
    """How z is taken from the prior in imagination: its most likely value, or a sample."""

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


class AgentConfig(CrossPlayOptions):
    """Actor, centralised critics and the XPM-Sim objective (paper, equation XPM-Sim)."""

    units: Width = 128
    """Width of the hidden layers of actor and critics."""
    layers: Layers = 2
    """Hidden layers of actor and critics."""
    activation: Literal["silu", "leaky_relu"] = "silu"
    """Nonlinearity of the hidden layers."""
    norm: StrictBool = True
    """Whether each hidden layer has a layer norm before its nonlinearity."""
    actor_input: Literal["model", "latent"] = "model"
    """What the actor sees: `model`, h with the joint and its own latent; `latent`, its own z^i alone."""
    horizon: Annotated[_Int, Field(ge=1, le=1000)] = 15
    """Steps of an imagined trajectory (the paper's simulation horizon)."""
    starts_sp: Batch = 256
    """Imagined self-play trajectories in an update."""
    starts_xp: Batch = 128
    """Imagined cross-play trajectories in an update, half of them in each seat."""
    discount: Fraction = 0.99
    """Discount of rewards per step (gamma)."""
    lam: Fraction = 0.95
    """Lambda of the lambda-returns: 0 trusts the critic, 1 the imagined rewards."""
    surrogate: Literal["ppo", "reinforce"] = "ppo"
    """Policy objective: `ppo`, clipped, over several passes; `reinforce`, one step a batch, as in the paper."""
    epochs: Annotated[_Int, Field(ge=1, le=1000)] = 2
    """Passes over an imagined batch; 1 with `reinforce`."""
    minibatches: Annotated[_Int, Field(ge=1, le=10_000)] = 12
    """Parts into which each pass divides the batch, a gradient step each; 1 with `reinforce`."""
    clip: Rate = 0.2
    """Largest change of the probability ratio that the surrogate rewards (PPO's epsilon)."""
    advantage_unit: Literal["spread", "returns"] = "spread"
    """Unit of all advantages: their spread in self-play, or the range of self-play's returns."""
    advantage_clip: Weight = 0.0
    """Self-play's advantages are cut at so many times their mean magnitude before their spread is taken, so that a few
    rare rewards do not set the unit of all others; 0: not cut."""
    actor_lr: Rate = 1e-3
    """Adam's step size of the actor."""
    critic_lr: Rate = 1e-3
    """Adam's step size of the critics."""
    adam_eps: Rate = 1e-5
    """Adam's epsilon, of actor and critics."""
    entropy: Weight = 0.02
    """Weight of the policy's entropy at the start (the paper's entropy coef.)."""
    entropy_end: Weight = 0.02
    """Weight of the entropy after the ramp."""
    entropy_after: Fraction = 0.5
    """Share of a phase's target_score in real self-play at which the entropy's ramp begins."""
    entropy_ramp: NonNegative = 50
    """Updates over which the entropy's weight goes to `entropy_end`; 0: the same throughout."""
    grad_clip: Weight = 0.5
    """Largest norm of a gradient, to which longer ones are scaled down; 0: as they are."""
    unimix: UniformShare = 0.01
    """Share of the uniform distribution that is mixed into the policy."""
    bins: Annotated[_Int, Field(ge=3, le=10_001)] = 65
    """Bins of the critics' two-hot distribution over returns."""
    slow_critic: Fraction = 0.0
    """Decay per update of the critics' moving copy that gives the targets; 0: the critics themselves."""
    return_percentiles: tuple[Number, Number] = (5.0, 95.0)
    """Percentiles of self-play's returns between which their moving range is taken, in [0, 100]."""
    lambda_xp: Weight = 0.35
    """Weight of cross-play with the strongest partner, subtracted from self-play (lambda_XP, eq. XPM-Sim)."""
    lambda_start: Weight = 0.25
    """lambda_XP of a member's first update, if it is less than `lambda_xp`."""
    lambda_ramp: NonNegative = 100
    """Updates over which lambda_XP rises in a straight line; 0: `lambda_xp` at once."""
    sp_from_xp: Fraction = 0.5
    """Of the self-play starts in a member's own data, the share in cross-play states (B_XP)."""
    xp_starts: Literal["partner", "any"] = "partner"
    """Cross-play starts in states recorded with that partner, or with any."""
    partner: Literal["max_window", "max_buffer"] = "max_window"
    """Strongest partner by real cross-play returns: of its latest round, or of all its episodes."""
    partner_random: Fraction = 0.3
    """Share of updates with a random partner in the strongest one's place: no critic is forgotten."""
    surprise: Weight = 0.0
    """Reward in a later member's imagined self-play, for each nat of the population's surprise and seat, where the
    training reward of a dish is 18 or more (MEP's alpha); 0: none."""
    surprise_floor: Rate = 1e-5
    """Least probability that counts for it: it bounds what one step can earn."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Number format of imagination; `auto`: bfloat16 where the device multiplies it natively."""

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
    "world_model": (*_FILTER, "decoder_layers", "prior_layers", "head_layers", "reward_head"),
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
    """Steps that each of the buffers B_SP and B_XP holds (the paper's buffer size)."""
    event_fraction: Fraction = 0.4
    """Share of a model batch's windows that are drawn for an event in them, the kinds in turn."""


class Phase1Config(Schema):
    """Member 1: self-play together with the world model."""

    envs: Batch = 64
    """Environments that random play and self-play step at once."""
    prefill_steps: Positive = 256_000
    """Environment steps of random play before anything is learned (the paper's K episodes)."""
    prefill_interact: Fraction = 0.3
    """Probability of `interact` in random play; 0: all actions alike."""
    pretrain_updates: Positive = 1500
    """World-model updates on random play alone, before self-play begins."""
    steps_per_iteration: Positive = 100
    """Steps of each environment in a round (the paper's update interval)."""
    model_updates: Positive = 25
    """World-model updates in a round (the paper's C)."""
    agent_updates: Positive = 5
    """Updates of actor and critic in a round."""
    event_starts: Literal["playing", "always"] = "playing"
    """Imagination starts in windows drawn for an event: once self-play plays, or always."""
    recent_fraction: Fraction = 0.5
    """Share of a model batch that is drawn from the `recent_rows` latest steps."""
    recent_rows: Positive = 50_000
    """Latest steps of B_SP that count as recent."""
    max_steps: Positive = 680_000
    """Environment steps, random play included, that end phase 1."""
    restart_after: NonNegative = 0
    """Environment steps after which actor and critics start again, once."""
    restart_updates: NonNegative = 0
    """Updates of the fresh actor and critics before they play; 0: no such restart."""
    check_every: Positive = 5
    """Rounds between two reports on the world model's predictions."""
    target_score: Number = 10.5
    """Mean self-play score of the latest episodes that ends phase 1 earlier."""
    patience: Positive = 1000
    """Rounds without a better mean score that end phase 1 earlier."""
    plateau: NonNegative = 0
    """Once self-play has begun, the phase ends after so many rounds without a gain of `least_gain`, not at the target;
    0: it ends at the target."""
    least_gain: Fraction = 0.02
    """Share by which a window must exceed the last that counted as a gain."""


class Phase2Config(Schema):
    """Members 2..M: mostly imagination, few real episodes."""

    first_updates: Positive = 100
    """Updates of actor and critics before a member's first real episodes."""
    updates_per_round: Positive = 60
    """Updates of actor and critics before each further round of real episodes."""
    model_updates: NonNegative = 300
    """World-model updates in each round after the first."""
    partner_fits: NonNegative = 0
    """Gradient steps by which each partner's actor is fitted anew, before imagination, to act on the present world
    model's latents as it does on its own; 0: it acts on them as it is. Nothing is fitted where members meet nobody and
    `agent.surprise` is 0."""
    model_lag: Annotated[_Int, Field(ge=0, le=1)] = 0
    """1: the world model learns beside the agent, which imagines with that of the round before; 0: before the agent
    does. Where imagination starts from is up to date in both."""
    model_lr: Rate = 1e-3
    """Adam's step size of the world model in phase 2."""
    episodes_sp: Batch = 8
    """Real self-play episodes in a round."""
    episodes_xp: Annotated[_Int, Field(ge=0, le=100_000)] = 8
    """Real cross-play episodes in a round, over all partners, at least one in each seating with each; 0: members meet
    nobody, which needs `agent.lambda_xp=0`."""
    rounds: Positive = 8
    """Rounds of real episodes of each member."""
    max_rounds: Positive = 9
    """Rounds of a member whose best self-play score stays below `target_score`, if that is more than `rounds`."""
    entropy: Weight | None = None
    """Weight of a later member's entropy at the start; null: `agent.entropy`."""
    discount: Fraction | None = None
    """Discount of a later member's rewards per step; null: `agent.discount`. Its critics know real play of its own for
    fewer steps: the longer they look ahead, the more they overrate what imagination drifts to."""
    target_score: Number = 8.0
    """Self-play score below which a member gets further rounds, up to `max_rounds`."""
    max_steps: Positive | None = None
    """Environment steps, SP and XP, of each member, if they end before its rounds, of which they must hold one; null:
    no such bound."""
    plateau: NonNegative = 0
    """A member goes on after `rounds`, until so many rounds were no better than its best, to `max_rounds` at most;
    0: it goes on only while its self-play is below the target."""
    pay_limit: Annotated[Weight, AddedLater] = 0.0
    """An imagined trajectory ends, unpaid, with a step after which its last 1, 2, ... steps would have earned more than
    so many times the most that as many steps of real play have; 0: with none. What no play has shown is worth nothing
    then, and values cannot run away with what the world model makes up."""
    cache: Positive = 8192
    """States from which one round's imagination starts, before those of the member's own data."""
    starts_random: Fraction = 0.6
    """Share of the kept starts in states of random play."""
    starts_event: Fraction = 0.2
    """Share of the kept starts shortly before a major event, such as a delivery."""
    starts_new: Fraction = 0.5
    """Share of imagination that starts in a member's own data, after its first round."""
    event_reach: Positive = 10
    """Steps before a major event within which such a start lies."""
    new_fraction: Fraction = 0.5
    """Share of a model batch from a member's own data, half self-play, half cross-play."""

    def cross_play_episodes(self, partners: int) -> int:
        """Of one round: at least one in each seating with each partner, since every partner's cross-play must be known
        to tell the strongest; none where members meet nobody."""
        return max(self.episodes_xp, 2 * partners) if self.episodes_xp else 0

    @model_validator(mode="after")
    def _shares_of_starts(self) -> Phase2Config:
        if self.starts_random + self.starts_event > 1.0 + 1e-9:
            raise UserError("starts_random", "exceeds 1 together with starts_event", "lower one of them")
        return self


class DiscoveryConfig(Schema):
    """What finds rewards that chance hardly ever meets, and keeps the actor from those that the model makes up.

    All of it is off where the numbers are 0.
    """

    count_bonus: Weight = 0.0
    """In imagined self-play each player also earns this / sqrt(1 + n), n the real steps in which a player's own state
    (a view's `own` entries) was the same. Half of it once the highest-paying event is found, none once self-play has
    begun."""
    found_events: NonNegative = 0
    """So often must the highest-paying event have been seen in real play to count as found; 0: it never does."""
    found_entropy: Weight = 0.03
    """Scale to which the entropy bonus falls, within `agent.entropy_ramp` updates, once the highest-paying event is
    found; it falls further, to `agent.entropy_end`, once self-play has begun."""
    rare_events: NonNegative = 0
    """An imagined event that real play has shown fewer times is paid and ends its trajectory, and imagination does not
    start from what follows it in a window: the model knows too little of that."""
    trust: Weight = 0.0
    """An imagined event counts for this times its real rate over its imagined one, at most in full; 0: in full.
    Imagined rates are taken with the present policy from unchosen states of the member's own latest play."""
    trust_starts: Batch = 512
    """Imagined trajectories behind a comparison of the rates."""
    event_factors: dict[str, Weight] = {}
    """By name, what the weights of events are multiplied with in imagination: pick-ups that pay as much as the steps
    which they are for are made for their own sake."""
    scaffolds: Annotated[dict[str, str], AddedLater] = {}
    """By name, an event -> the one that it is for. The nearer the real rate of that one comes to `scaffold_until`, the
    less the first pays in imagination: paid in full for ever, it is made where nothing can follow from it."""
    scaffold_until: Annotated[Weight, AddedLater] = 0.005
    """Real events a step, of both players together, from which on what leads to them pays nothing; needs `trust`,
    which takes the rates."""


class WatchConfig(Schema):
    """When a run says that training goes wrong, and what to do; it changes nothing else."""

    imagined_factor: Weight = 4.0
    """Imagined reward a step may exceed real self-play's so many times; 0: it is not watched."""
    first_rounds: Positive = 50
    """Rounds of member 1 in a row in which it exceeds that before a line is written."""
    later_rounds: Positive = 6
    """The same for rounds of later members."""
    precision_share: Fraction = 0.7
    """Share of the best precision of predicted events below which precision has fallen; 0: it is not watched."""
    precision_reports: Positive = 2
    """Reports in a row with such a precision before a line is written."""


class WorldModelRun(RunConfig):
    """What the runs of all methods that train members in a world model have."""

    world_model: WorldModelConfig = WorldModelConfig()
    """The two-player world model."""
    agent: AgentConfig = AgentConfig()
    """Actor, critics and objective."""
    replay: ReplayConfig = ReplayConfig()
    """The buffers B_SP and B_XP."""
    phase1: Phase1Config = Phase1Config()
    """Member 1, together with the world model."""
    phase2: Phase2Config = Phase2Config()
    """Later members, mostly in imagination."""
    discovery: DiscoveryConfig = DiscoveryConfig()
    """What finds rare rewards and distrusts made-up ones."""
    watch: WatchConfig = WatchConfig()
    """When a run says that training goes wrong."""

    @model_validator(mode="after")
    def _check_reward_head(self) -> WorldModelRun:
        """Discovery judges imagined events, which a scalar head does not tell."""
        discovery = self.discovery
        if self.world_model.reward_head == "scalar" and (
            discovery.trust or discovery.rare_events or discovery.event_factors
        ):
            fix = "set discovery.trust, discovery.rare_events and discovery.event_factors to nothing"
            raise UserError("world_model.reward_head", "is scalar, but discovery asks for imagined events", fix)
        return self

    @model_validator(mode="after")
    def _check_cross_play(self) -> WorldModelRun:
        """Whoever is trained against partners must meet them."""
        if self.phase2.episodes_xp == 0 and self.agent.lambda_xp > 0.0:
            problem = f"is 0, but agent.lambda_xp={self.agent.lambda_xp:g} needs to know the strongest partner"
            raise UserError("phase2.episodes_xp", problem, "raise it, or set agent.lambda_xp=0")
        return self

    def agent_of(self, member: int) -> AgentConfig:
        """How the member's actor and critics learn."""
        own = {"entropy": self.phase2.entropy, "discount": self.phase2.discount}
        changes = {name: value for name, value in own.items() if value is not None}
        return self.agent if member == 1 else self.agent.model_copy(update=changes)

    @property
    def heeds_predecessors(self) -> bool:
        """Does a member's training depend on those before it?"""
        return self.phase2.episodes_xp > 0 or self.agent.surprise > 0.0

    @model_validator(mode="after")
    def _check_windows(self) -> WorldModelRun:
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


class XpmWmRun(WorldModelRun):
    """A run of XPM-WM."""

    method: Literal["xpm_wm"] = "xpm_wm"
    """Cross-play minimisation in a learned world model."""


class FcpWmRun(WorldModelRun):
    """A run of FCP in a world model."""

    method: Literal["fcp_wm"] = "fcp_wm"
    """Self-play in a learned world model, each later seed kept at three skills."""


class MepWmRun(WorldModelRun):
    """A run of MEP in a world model."""

    method: Literal["mep_wm"] = "mep_wm"
    """Self-play in a learned world model, paid for the population's entropy."""
