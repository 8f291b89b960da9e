"""Sections that every method has: environment, population, evaluation, where it runs, how it is tracked."""

from __future__ import annotations

import os
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, StrictBool, model_validator

from popgen.config.schema import Batch, Fraction, Positive, Rate, Schema, Text, Weight, _Int
from popgen.errors import UserError

Place = Annotated[str, AfterValidator(os.path.expanduser)]
"""A path, whose `~` is the home folder."""


class EnvConfig(Schema):
    """An environment of the registry; `params` go to its constructor."""

    name: str = "overcooked/cramped_room"
    """Family and variant, such as overcooked/cramped_room; a path to a .layout file may follow `overcooked/`."""
    params: dict[str, Any] = {}
    """Arguments of the environment's constructor, by name; {} leaves its own defaults."""

    @model_validator(mode="after")
    def _seed_is_the_runs(self) -> EnvConfig:
        if "seed" in self.params:
            raise UserError("params.seed", "environments take the run's seed", "set run.seed")
        if "num_envs" in self.params:
            raise UserError("params.num_envs", "is no parameter of an environment", "leave it out")
        return self


class PopulationConfig(Schema):
    """Size of the population and, for continuing one, the run whose members it starts from."""

    size: Annotated[_Int, Field(ge=1, le=1000)] = 3
    """Members of the population (the paper's M)."""
    init_from: Place | None = None
    """Folder of a run whose first members this population takes over and goes on from; null trains all."""
    init_members: Positive = 1
    """How many members to take over from `init_from`."""


class EvaluationConfig(Schema):
    """Episodes behind each figure of the SP/XP matrix (per seating)."""

    episodes: Batch = 20
    """Episodes behind each figure of the SP/XP matrix, for each pair of members in each seating."""
    weak_share: Fraction = 0.25
    """A member does not play if its self-play is below this share of its target (1000 and more are none) or of the
    other members' median, or no better than beside a random partner; 0 names nobody."""


class ClusterConfig(Schema):
    """Ray: the cluster, and the cores, cards and memory of actors."""

    address: str | None = None
    """Ray cluster to join (`auto` finds the one that runs here); null starts a local Ray."""
    num_cpus: Annotated[_Int, Field(ge=1, le=100_000)] | None = None
    """Cores that a local Ray may use; null: all of this machine."""
    samplers: Annotated[_Int, Field(ge=1, le=10_000)] = 1
    """Actors that step environments."""
    sampler_cpus: Weight = 0.1
    """Cores that each sampler asks Ray for."""
    replay_cpus: Weight = 0.0
    """Cores that each replay buffer asks Ray for."""
    model_cpus: Weight = 0.9
    """Cores that the world model's learner asks Ray for."""
    agent_cpus: Weight = 0.9
    """Cores that each member's learner asks Ray for."""
    model_gpus: Weight = 0.0
    """GPUs that the world model's learner asks Ray for; 0 computes on the processor."""
    agent_gpus: Weight = 0.0
    """GPUs that each member's learner asks Ray for; 0 computes on the processor."""
    threads: Annotated[_Int, Field(ge=1, le=1024)] = 1
    """Threads that each learner computes with."""
    resources: dict[str, Weight] = {}
    """Ray's custom resources that every actor asks for, by name, to bind a run to certain nodes."""
    retries: Annotated[_Int, Field(ge=0, le=1000)] = 5
    """Deaths of actors or nodes in a row, without progress between them, that a run survives."""
    wait_seconds: Weight = 600.0
    """Seconds to wait for nodes of a running cluster that are not up (again)."""
    object_store_bytes: Annotated[_Int, Field(ge=80 * 2**20, le=2**50)] | None = None
    """Bytes of each node's object store; null leaves it to Ray (3/10 of the memory)."""


class TrackingConfig(Schema):
    """Where curves and figures go beside the run's folder."""

    enabled: StrictBool = True
    """Whether anything follows the run."""
    writer: Literal["mlflow", "tensorboard", "wandb"] = "mlflow"
    """What follows it: MLflow, TensorBoard's event files in the run's folder, or Weights & Biases."""
    uri: str | None = None
    """MLflow's tracking URI; null: a sqlite store in `run.root`, of all runs there."""
    experiment: str = "popgen"
    """Name of MLflow's experiment, or of the project of Weights & Biases."""
    system_metrics: StrictBool = False
    """Log processor, memory, disk and network of the tracker's machine to MLflow every 10 s."""

    @model_validator(mode="after")
    def _address_is_mlflows(self) -> TrackingConfig:
        if self.enabled and self.writer != "mlflow" and self.uri is not None:
            raise UserError("uri", f"is an address of MLflow, tracking.writer is {self.writer}", "leave one out")
        return self


class RunSection(Schema):
    """What is not of the method but of this one run."""

    id: Text | None = None
    """Name of the run and of its folder; the same name goes on where an interrupted run was; null makes one."""
    root: Place = "runs"
    """Folder that holds the runs' folders."""
    seed: Annotated[_Int, Field(ge=0, lt=2**31)] = 0
    """Seed of all randomness of the run."""
    schedule: Literal["sync", "async"] = "sync"
    """`sync` waits for all workers in every round (same seed, same weights); `async` lets them overlap."""
    transport: Literal["ray", "inline"] = "ray"
    """Where workers live: Ray's actors, or objects of the driver's process (`inline`: notebook, debugger)."""
    overlap: Annotated[_Int, Field(ge=1, le=1000)] = 4
    """With schedule=async, tasks that a learner may do for each one of the samplers."""
    checkpoint_seconds: Weight = 0.0
    """Least seconds between two checkpoints; 0 makes one after every round."""
    disk_reserve: Annotated[_Int, Field(ge=0, le=2**50)] = 64 * 2**20
    """Bytes to leave free: with less room on the disk the run stops by itself, its checkpoints whole."""
    storage: str | None = None
    """Second place for all that resuming needs, such as s3://bucket/path (docs/reliability.md); null: none."""


class PpoSection(Schema):
    """What every learner by PPO's clipped surrogate has, egos and baselines alike."""

    minibatches: Annotated[_Int, Field(ge=1, le=10_000)] = 4
    """Parts into which each pass divides the samples, a gradient step each."""
    clip: Rate = 0.2
    """Largest change of the probability ratio that the surrogate rewards (PPO's epsilon)."""
    discount: Fraction = 0.99
    """Discount of rewards per step (gamma)."""
    lam: Fraction = 0.95
    """Lambda of the generalised advantage estimate: 0 trusts the critic, 1 the returns."""
    learning_rate: Rate = 1e-3
    """Adam's step size at the start, of actors and critics."""
    entropy: Weight = 0.01
    """Weight of the policy's entropy at the start (the paper's entropy coef.)."""
    entropy_end: Fraction = 1.0
    """Share of `entropy` that is left at the end of training; it falls in a straight line."""
