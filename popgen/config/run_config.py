"""The whole of one run: which sections a method has, and how mistakes in them are told."""

from __future__ import annotations

import difflib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from functools import reduce
from importlib import import_module
from typing import Any

from pydantic import BaseModel, ValidationError

from popgen.config.schema import AddedLater, Schema
from popgen.config.sections import (
    ClusterConfig,
    EnvConfig,
    EvaluationConfig,
    PopulationConfig,
    RunSection,
    TrackingConfig,
)
from popgen.errors import UserError, mask_credentials

LAYOUT_FILE = ".layout"
"""End of an environment's name that is a file's path."""

_REGISTRY = "popgen.methods.registry"
"""Module that knows each method's schema; imported by its name, since methods stand above this package."""


class RunConfig(Schema):
    """The sections that every run has; each method's own class adds its sections (`popgen/methods/*/config.py`)."""

    method: str
    """How the population is generated: a name of `popgen.methods.registry.METHODS`."""
    scale: str = "laptop"
    """Recipe that gives the numbers: laptop, demo, paper, smoke, or a preset of yours."""
    env: EnvConfig = EnvConfig()
    """What is played."""
    population: PopulationConfig = PopulationConfig()
    """How many members there are, and which of them come from an earlier run."""
    evaluation: EvaluationConfig = EvaluationConfig()
    """How the finished population is measured."""
    cluster: ClusterConfig = ClusterConfig()
    """Where actors run, and what each asks of its node."""
    tracking: TrackingConfig = TrackingConfig()
    """How MLflow follows the run."""
    run: RunSection = RunSection()
    """Identity, place, seed and schedule of the run."""

    @classmethod
    def parse(cls, values: dict[str, Any]) -> RunConfig:
        """Check a plain dictionary by the schema of the method that it names.

        Raises:
            UserError: for the first bad field, by its dotted name.
        """
        schema = schema_of(values)
        try:
            return schema.model_validate(values)
        except ValidationError as error:
            raise as_user_error(error, schema=schema) from None

    @classmethod
    def method_override(cls) -> str:
        """The override that chooses the method of this schema."""
        return f"method={cls.model_fields['method'].default}"

    def as_dict(self) -> dict[str, Any]:
        """JSON-able, without credentials that addresses hold."""
        return _mask_values(self.model_dump(mode="json"))

    def unused_fields(self) -> list[str]:
        """Dotted names of fields that came later (`AddedLater`) and are at their defaults: they decide nothing."""
        return list(_find_unused(self))

    def digest(self) -> str:
        """sha256 of everything that decides the result (not of where it runs or is tracked).

        Nor of where files lie: a layout's file is known by the rules in it, which the population's manifest holds, and
        the run that this one begins from by its id.
        """
        kept = {k: v for k, v in self.as_dict().items() if k not in ("cluster", "tracking", "run")}
        for name in self.unused_fields():
            *sections, field = name.split(".")
            del reduce(lambda values, section: values[section], sections, kept)[field]
        if (name := self.env.name).endswith(LAYOUT_FILE):
            kept["env"]["name"] = f"{name.partition('/')[0]}/*{LAYOUT_FILE}"
        if self.population.init_from is not None:
            kept["population"]["init_from"] = os.path.basename(os.path.abspath(self.population.init_from))
        kept["seed"], kept["schedule"] = self.run.seed, self.run.schedule
        return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()


def _find_unused(section: BaseModel, prefix: str = "") -> Iterator[str]:
    for name, info in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            yield from _find_unused(value, f"{prefix}{name}.")
        elif value == info.default and any(mark is AddedLater for mark in info.metadata):
            yield prefix + name


def _mask_values(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _mask_values(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_mask_values(item) for item in value]
    return mask_credentials(value) if isinstance(value, str) else value


def schema_of(values: Mapping[str, Any]) -> type[RunConfig]:
    """The schema of the method that a plain dictionary names, or of the default method.

    Raises:
        UserError: there is no such method.
    """
    registry = import_module(_REGISTRY)
    name = values.get("method", registry.DEFAULT) if isinstance(values, Mapping) else registry.DEFAULT
    return registry.find_method(name).config


def field_names(schema: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Dotted names of all fields, sections included."""
    for name, info in schema.model_fields.items():
        yield prefix + name
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            yield from field_names(info.annotation, f"{prefix}{name}.")


def closest_field(key: str, schema: type[RunConfig]) -> str | None:
    """The field that a mistaken dotted key most likely means, by section, by last part, or by spelling."""
    names = list(field_names(schema))
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


def unknown_field(key: str, schema: type[RunConfig]) -> UserError:
    """The error for a key that the schema of the run's method does not have."""
    meant = closest_field(key, schema)
    method = schema.model_fields["method"].default
    fix = f"did you mean {meant}?" if meant else f"see `popgen config {method}`"
    owners = import_module(_REGISTRY).methods_with(key)
    if owners and method not in owners:
        return UserError(key, f"is a setting of {' and '.join(owners)}, which {method} does not have", fix)
    return UserError(key, "there is no such field", fix)


def as_user_error(error: ValidationError, section: str = "", schema: type[RunConfig] | None = None) -> UserError:
    """The first complaint of a schema in one line; `section` is the dotted name of where it stands, `schema` the whole
    that names the field which an unknown one may mean."""
    first = error.errors()[0]
    parts = [section] * bool(section) + [str(part) for part in first["loc"]]
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, UserError):
        return UserError(".".join([*parts, cause.field]), cause.problem, cause.fix)
    where = ".".join(parts) or "config"
    if first["type"] == "extra_forbidden":
        return UserError(where, "there is no such field") if schema is None else unknown_field(where, schema)
    got = first.get("input")
    shown = "" if isinstance(got, BaseModel | dict) else f" (got {got!r})"
    fix = "give it a value" if first["type"] == "missing" else "correct the value"
    return UserError(where, first["msg"].removeprefix("Value error, ").replace("Input should", "should") + shown, fix)
