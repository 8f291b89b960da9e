"""Sections that every method has: environment, population, evaluation, where it runs, how it is tracked."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, StrictBool, model_validator

from popgen.config.schema import Batch, Positive, Schema, Text, Weight, _Int
from popgen.errors import UserError


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


class EvaluationConfig(Schema):
    """Episodes behind each figure of the SP/XP matrix (per seating)."""

    episodes: Batch = 20


class ClusterConfig(Schema):
    """Where actors run; `address=None` starts a local Ray.

    retries: deaths of actors or nodes in a row, without progress between them, after which a run gives up.
    wait_seconds: for nodes of a running cluster that are not up (again).
    object_store_bytes: of each node's object store; None leaves it to Ray (3/10 of the memory).
    """

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
    retries: Annotated[_Int, Field(ge=0, le=1000)] = 5
    wait_seconds: Weight = 600.0
    object_store_bytes: Annotated[_Int, Field(ge=80 * 2**20, le=2**50)] | None = None


class TrackingConfig(Schema):
    """MLflow; without a URI a sqlite store in the run's folder.

    system_metrics: processor, memory, disk and network of the machine that holds the tracker, every 10 s.
    """

    enabled: StrictBool = True
    uri: str | None = None
    experiment: str = "popgen"
    system_metrics: StrictBool = False


class RunSection(Schema):
    """Identity and place of the run.

    transport: where workers are: Ray's actors, or objects of the driver's process (`inline`: a notebook, a debugger).
    overlap: with schedule=async, rounds that a learner may do for each of the samplers'.
    checkpoint_seconds: least time between two checkpoints; 0: after every iteration.
    disk_reserve: bytes; with less room left the run stops by itself, its checkpoints whole.
    storage: a second place for everything that resuming needs, such as s3://bucket/path (docs/reliability.md).
    """

    id: Text | None = None
    root: str = "runs"
    seed: Annotated[_Int, Field(ge=0, lt=2**31)] = 0
    schedule: Literal["sync", "async"] = "sync"
    transport: Literal["ray", "inline"] = "ray"
    overlap: Annotated[_Int, Field(ge=1, le=1000)] = 4
    checkpoint_seconds: Weight = 0.0
    disk_reserve: Annotated[_Int, Field(ge=0, le=2**50)] = 64 * 2**20
    storage: str | None = None
