"""What stands in a population's JSON files: `manifest.json` and each member's `member.json`."""

from __future__ import annotations

import platform
from importlib.metadata import version
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

import popgen
from popgen.envs.contract import EnvSpec
from popgen.jsonable import jsonable
from popgen.types import TRAINING_KINDS, Kind

FORMAT = "popgen-population"
FORMAT_VERSION = 1

Count = Annotated[int, Field(ge=0)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Record(BaseModel):
    """Immutable, no unknown keys, no conversion between types."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Versions(Record):
    """Of the library and what its numbers depend on, at the time of writing."""

    popgen: str
    python: str
    torch: str
    numpy: str

    @classmethod
    def current(cls) -> Self:
        """Versions of the running interpreter, without importing torch."""
        return cls(
            popgen=popgen.__version__, python=platform.python_version(), torch=version("torch"), numpy=version("numpy")
        )


class EnvironmentInfo(Record):
    """The environment the members were trained in.

    Attributes:
        name, params: make the same environment again through the registry.
        fingerprint: sha256 over its rules; the rebuilt environment must have it too.
        cooking: the mode, where the environment has one.
        horizon, score_name: for readers of the file.
    """

    name: str
    params: dict[str, Any] = {}
    fingerprint: str
    cooking: str | None = None
    horizon: Count
    score_name: str

    @classmethod
    def of(cls, spec: EnvSpec) -> Self:
        """The part of a spec that a population keeps."""
        return cls(
            name=spec.name,
            params=jsonable(spec.params),
            fingerprint=spec.fingerprint,
            cooking=cooking_of(spec),
            horizon=spec.horizon,
            score_name=spec.score_name,
        )


class MemberEntry(Record):
    """A member's place in the manifest; `sha256` is that of its member.json, which holds those of its weights."""

    id: Annotated[int, Field(ge=1)]
    folder: Annotated[str, Field(pattern=r"^member_[0-9]{3,6}$")]
    sha256: Sha256

    @model_validator(mode="after")
    def _folder_of_id(self) -> Self:
        if self.folder != folder_name(self.id):
            raise ValueError(f"member {self.id} must lie in {folder_name(self.id)}, not {self.folder}")
        return self


class Manifest(Record):
    """manifest.json: what the population is and its members in the order they were trained.

    Attributes:
        format, format_version: must be this library's.
        environment: see EnvironmentInfo.
        method, config_digest, seed: which run made it; the digest covers all that decides the result.
        versions: of the library that wrote it.
        members: ids 1..M in order.
    """

    format: Literal["popgen-population"] = FORMAT
    format_version: Literal[1] = FORMAT_VERSION
    environment: EnvironmentInfo
    method: str
    config_digest: str
    seed: Count
    versions: Versions
    members: tuple[MemberEntry, ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _tuple(cls, values: Any) -> Any:
        # JSON knows no tuples, and strict mode takes no list for one.
        if isinstance(values, dict) and isinstance(values.get("members"), list):
            return {**values, "members": tuple(values["members"])}
        return values

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if [member.id for member in self.members] != list(range(1, len(self.members) + 1)):
            raise ValueError("members must be numbered 1, 2, ... in order")
        return self


class MemberInfo(Record):
    """member.json: one member.

    Attributes:
        id: from 1.
        kind, config: policy kind and its settings (`Policy.config`).
        seed: the member's own.
        steps: environment steps spent on it, by ledger kind.
        policy_sha256: of policy.safetensors, all that is needed to act.
        training_sha256: of training.safetensors, None where there is none.
        versions: of the library that wrote it.
        extra: further figures of the method, such as training curves.
    """

    id: Annotated[int, Field(ge=1)]
    kind: str
    config: dict[str, Any]
    seed: Count
    steps: dict[str, Count]
    policy_sha256: Sha256
    training_sha256: Sha256 | None = None
    versions: Versions
    extra: dict[str, Any] = {}

    @model_validator(mode="after")
    def _known_kinds(self) -> Self:
        unknown = set(self.steps) - {str(kind) for kind in Kind}
        if unknown:
            raise ValueError(f"steps of unknown kind {', '.join(sorted(unknown))}")
        return self

    @property
    def total_steps(self) -> int:
        """Environment steps that training took."""
        return sum(self.steps.get(str(kind), 0) for kind in TRAINING_KINDS)


def folder_name(member: int) -> str:
    """Folder of a member inside its population: member_001, member_002, ..."""
    return f"member_{member:03d}"


def cooking_of(spec: EnvSpec) -> str | None:
    """The environment's cooking mode, None where it has none."""
    cooking = spec.params.get("cooking")
    return None if cooking is None else str(cooking)
