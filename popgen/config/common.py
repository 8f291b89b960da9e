"""Sections that every method has: environment, population, evaluation, where it runs, how it is tracked."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, StrictBool, model_validator

from popgen.config.base import Batch, Positive, Schema, Text, Weight, _Int
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
