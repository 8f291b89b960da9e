"""Frozen schemas, one per group of conf/, checked before anything starts.

Every number that a method uses stands here with its range; `conf/` holds the values. The schemas know
nothing of Hydra: the command line composes a plain dictionary and calls `RunConfig.parse`.
"""

from __future__ import annotations

import difflib
import hashlib
import json
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StrictBool, ValidationError, model_validator

from popgen.errors import UserError


def _a_number(value: Any) -> Any:
    if isinstance(value, bool | str):
        raise ValueError("should be a number")
    return value


_Int = Annotated[int, BeforeValidator(_a_number)]
_Float = Annotated[float, BeforeValidator(_a_number), Field(allow_inf_nan=False)]
Positive = Annotated[_Int, Field(ge=1, le=10**12)]
NonNegative = Annotated[_Int, Field(ge=0, le=10**12)]
Layers = Annotated[_Int, Field(ge=1, le=64)]
Width = Annotated[_Int, Field(ge=1, le=16_384)]  # of a layer
Batch = Annotated[_Int, Field(ge=1, le=100_000)]  # what is held in memory or stepped at once
Number = Annotated[_Float, Field(ge=-1e12, le=1e12)]
Rate = Annotated[_Float, Field(gt=0.0, le=1.0)]
Fraction = Annotated[_Float, Field(ge=0.0, le=1.0)]
Weight = Annotated[_Float, Field(ge=0.0, le=1e9)]
UniformShare = Annotated[_Float, Field(ge=1e-6, le=1.0)]  # mixed into probabilities, whose logarithms are taken
PREFILL_CHUNK = 400
"""Steps of each environment in one segment of random play."""

OPEN_LOOP = 4
"""Steps without observations at which the world model's open-loop figures are taken."""

Text = Annotated[str, BeforeValidator(lambda value: str(value) if type(value) is int else value)]


class Schema(BaseModel):
    """Immutable, no unknown keys, no silent conversion of text to numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)


class EnvConfig(Schema):
    """An environment of the registry; `params` go to its constructor."""

    name: str = "overcooked/cramped_room"
    params: dict[str, Any] = {}

    @model_validator(mode="after")
    def _seed_is_the_runs(self) -> EnvConfig:
        if "seed" in self.params:
            raise UserError("params.seed", "environments take the run's seed", "set run.seed")
        return self


class PopulationConfig(Schema):
    """Size of the population and, for continuing one, the run whose members it starts from."""

    size: Annotated[_Int, Field(ge=1, le=1000)] = 3
    init_from: str | None = None
    init_members: Positive = 1


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
    """Actor, centralised critics and the XPM-Sim objective (paper, equation XPM-Sim)."""

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
    actor_lr: Rate = 1e-3
    critic_lr: Rate = 1e-3
    entropy: Weight = 3e-3
    grad_clip: Weight = 100.0
    unimix: UniformShare = 0.01
    bins: Annotated[_Int, Field(ge=3, le=10_001)] = 65
    slow_critic: Fraction = 0.98
    return_percentiles: tuple[Number, Number] = (5.0, 95.0)
    lambda_xp: Weight = 0.35
    lambda_start: Weight = 0.25
    lambda_ramp: NonNegative = 2000
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
    """Member 1: self-play together with the world model."""

    envs: Batch = 64
    prefill_steps: Positive = 256_000
    prefill_interact: Fraction = 0.3
    pretrain_updates: Positive = 1500
    steps_per_iteration: Positive = 100
    model_updates: Positive = 25
    agent_updates: Positive = 25
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

    first_updates: Positive = 600
    updates_per_round: Positive = 350
    model_updates: NonNegative = 100
    model_lr: Rate = 5e-4
    episodes_sp: Batch = 8
    episodes_xp: Batch = 8
    rounds: Positive = 8
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


class EvaluationConfig(Schema):
    """Episodes behind each figure of the SP/XP matrix (per seating)."""

    episodes: Batch = 20


class ClusterConfig(Schema):
    """Where actors run; `address=None` starts a local Ray."""

    address: str | None = None
    num_cpus: Annotated[_Int, Field(ge=1, le=100_000)] | None = None
    samplers: Annotated[_Int, Field(ge=1, le=10_000)] = 1
    sampler_cpus: Weight = 0.1
    replay_cpus: Weight = 0.0
    model_cpus: Weight = 0.9
    agent_cpus: Weight = 0.9
    model_gpus: Weight = 0.0
    agent_gpus: Weight = 0.0
    threads: Annotated[_Int, Field(ge=1, le=1024)] = 1
    resources: dict[str, Weight] = {}

    @property
    def cpus(self) -> float:
        """What all actors together ask for."""
        return self.samplers * self.sampler_cpus + 2 * self.replay_cpus + self.model_cpus + self.agent_cpus


class TrackingConfig(Schema):
    """MLflow; without a URI a sqlite store in the run's folder."""

    enabled: StrictBool = True
    uri: str | None = None
    experiment: str = "popgen"


class RunSection(Schema):
    """Identity and place of the run."""

    id: Text | None = None
    root: str = "runs"
    seed: Annotated[_Int, Field(ge=0, lt=2**31)] = 0
    schedule: Literal["sync", "async"] = "sync"
    checkpoint_seconds: Weight = 0.0  # least time between two; 0: after every iteration


class RunConfig(Schema):
    """The whole of one run."""

    method: Literal["xpm_wm"] = "xpm_wm"
    scale: str = "laptop"
    env: EnvConfig = EnvConfig()
    population: PopulationConfig = PopulationConfig()
    world_model: WorldModelConfig = WorldModelConfig()
    agent: AgentConfig = AgentConfig()
    replay: ReplayConfig = ReplayConfig()
    phase1: Phase1Config = Phase1Config()
    phase2: Phase2Config = Phase2Config()
    evaluation: EvaluationConfig = EvaluationConfig()
    cluster: ClusterConfig = ClusterConfig()
    tracking: TrackingConfig = TrackingConfig()
    run: RunSection = RunSection()

    @model_validator(mode="after")
    def _windows_fit(self) -> RunConfig:
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

    @classmethod
    def parse(cls, values: dict[str, Any]) -> RunConfig:
        """Check a plain dictionary.

        Raises:
            UserError: for the first bad field, by its dotted name.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise as_user_error(error) from None

    def digest(self) -> str:
        """sha256 of everything that decides the result (not of where it runs or is tracked)."""
        kept = self.model_dump(mode="json", exclude={"cluster", "tracking", "run"})
        kept["seed"], kept["schedule"] = self.run.seed, self.run.schedule
        return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()


def field_names(schema: type[BaseModel] = RunConfig, prefix: str = "") -> Iterator[str]:
    """Dotted names of all fields, sections included."""
    for name, info in schema.model_fields.items():
        yield prefix + name
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            yield from field_names(info.annotation, f"{prefix}{name}.")


def closest_field(key: str) -> str | None:
    """The field that a mistaken dotted key most likely means, by section, by last part, or by spelling."""
    names = list(field_names())
    leaves = [name for name in names if not any(other.startswith(f"{name}.") for other in names)]
    section, _, last = key.rpartition(".")
    siblings = [name for name in leaves if name.rpartition(".")[0] == section]
    for choices, wanted in ((siblings, last), (leaves, last)):
        parts = {name.rpartition(".")[2]: name for name in reversed(choices)}
        close = difflib.get_close_matches(wanted, parts, n=1, cutoff=0.75)
        if close:
            return parts[close[0]]
    close = difflib.get_close_matches(key, [name for name in names if not key.startswith(f"{name}.")], n=1, cutoff=0.75)
    return close[0] if close else None


def unknown_field(key: str) -> UserError:
    """The error for a key that no schema has."""
    known = closest_field(key)
    return UserError(key, "there is no such field", f"did you mean {known}?" if known else "see `popgen run --dry-run`")


def as_user_error(error: ValidationError, section: str = "") -> UserError:
    """The first complaint of a schema in one line; `section` is the dotted name of where it stands."""
    first = error.errors()[0]
    parts = [section] * bool(section) + [str(part) for part in first["loc"]]
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, UserError):
        return UserError(".".join([*parts, cause.field]), cause.problem, cause.fix)
    where = ".".join(parts) or "config"
    if first["type"] == "extra_forbidden":
        return unknown_field(where)
    got = first.get("input")
    shown = "" if isinstance(got, BaseModel | dict) else f" (got {got!r})"
    fix = "give it a value" if first["type"] == "missing" else "correct the value"
    return UserError(where, first["msg"].removeprefix("Value error, ").replace("Input should", "should") + shown, fix)
