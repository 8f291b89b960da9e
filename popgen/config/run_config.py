"""The whole of one run: which sections a method has, and how mistakes in them are told."""

from __future__ import annotations

import difflib
import hashlib
import json
from collections.abc import Iterator
from typing import Any, Literal

from pydantic import BaseModel, ValidationError, model_validator

from popgen.config.schema import Schema
from popgen.config.sections import (
    ClusterConfig,
    EnvConfig,
    EvaluationConfig,
    PopulationConfig,
    RunSection,
    TrackingConfig,
)
from popgen.errors import UserError
from popgen.methods.mappo.config import DiversityConfig, PpoConfig
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_wm.config import (
    OPEN_LOOP,
    PREFILL_CHUNK,
    AgentConfig,
    Phase1Config,
    Phase2Config,
    ReplayConfig,
    WorldModelConfig,
)

SECTIONS: dict[str, tuple[str, ...]] = {
    "xpm_wm": ("world_model", "agent", "replay", "phase1", "phase2"),
    "xpm_sim": ("xpm_sim",),
    "mappo": ("ppo",),
    "lipo": ("ppo", "diversity"),
    "comedi": ("ppo", "diversity"),
}
"""Method -> its own sections of the config, beside those that all methods have."""


class RunConfig(Schema):
    """The whole of one run."""

    method: Literal["xpm_wm", "xpm_sim", "mappo", "lipo", "comedi"] = "xpm_wm"
    scale: str = "laptop"
    env: EnvConfig = EnvConfig()
    population: PopulationConfig = PopulationConfig()
    world_model: WorldModelConfig = WorldModelConfig()
    agent: AgentConfig = AgentConfig()
    replay: ReplayConfig = ReplayConfig()
    phase1: Phase1Config = Phase1Config()
    phase2: Phase2Config = Phase2Config()
    xpm_sim: XpmSimConfig = XpmSimConfig()
    ppo: PpoConfig = PpoConfig()
    diversity: DiversityConfig = DiversityConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    cluster: ClusterConfig = ClusterConfig()
    tracking: TrackingConfig = TrackingConfig()
    run: RunSection = RunSection()

    @model_validator(mode="after")
    def _windows_fit(self) -> RunConfig:
        """Every segment must hold a window of the reports, the caches some windows, the replays a segment."""
        if self.method != "xpm_wm":
            return self
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

    def relevant(self) -> dict[str, Any]:
        """The JSON-able config without the sections of other methods."""
        others = {name for names in SECTIONS.values() for name in names} - set(SECTIONS[self.method])
        return self.model_dump(mode="json", exclude=others)

    def digest(self) -> str:
        """sha256 of everything that decides the result (not of where it runs or is tracked)."""
        kept = {k: v for k, v in self.relevant().items() if k not in ("cluster", "tracking", "run")}
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
