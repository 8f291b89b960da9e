"""Where a run's numbers come from: the code that each of its attempts ran, and the command that repeats it.

runs/RUN_ID/
  provenance.jsonl   one line an attempt: began (ISO time), popgen, python, torch, numpy, commit, changed,
                     machine
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import popgen
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.envs.env_registry import env_names
from popgen.errors import UserError
from popgen.jsonable import jsonable
from popgen.methods.registry import recipe
from popgen.population.manifest import Versions
from popgen.runs.machine import describe_machine

PROVENANCE = "provenance.jsonl"
_PLACES = ("run", "cluster", "tracking")
"""Sections that do not decide the result, seed and schedule aside."""

_CUSTOM = "overcooked/custom"
"""Option of the group `env` for layouts that have none of their own."""

_SHORT = {"run.seed": "seed"}


def read_commit() -> dict[str, Any]:
    """`commit` of the checkout that popgen runs from and whether files of it are `changed`; None without a checkout."""
    root = Path(popgen.__file__).resolve().parent.parent
    unknown: dict[str, Any] = {"commit": None, "changed": None}
    if not (root / ".git").exists():
        return unknown
    try:
        commit = _ask_git(root, "rev-parse", "HEAD")
        return {"commit": commit, "changed": bool(_ask_git(root, "status", "--porcelain", "--untracked-files=no"))}
    except (OSError, subprocess.SubprocessError):
        return unknown


def _ask_git(root: Path, *words: str) -> str:
    told = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, timeout=10, check=True)
    return told.stdout.strip()


def note_attempt(folder: Path) -> None:
    """Add a line for the attempt that begins."""
    began = datetime.now(UTC).isoformat(timespec="seconds")
    origin = {**Versions.current().model_dump(), **read_commit(), "machine": describe_machine()}
    line = {"began": began, **origin}
    with (folder / PROVENANCE).open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def read_attempts(folder: Path) -> list[dict[str, Any]]:
    """The lines of `provenance.jsonl`; none for a run of a version without it, or where they cannot be read."""
    try:
        lines = (folder / PROVENANCE).read_text(encoding="utf-8").splitlines()
        found = [json.loads(line) for line in lines]
    except (OSError, ValueError):
        return []
    return [line for line in found if isinstance(line, dict)]


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted name -> value of nested dictionaries; an empty dictionary stays a value."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        deeper = isinstance(value, Mapping) and bool(value)
        found |= flatten(value, f"{prefix}{name}.") if deeper else {f"{prefix}{name}": value}
    return found


def recipe_differences(config: RunConfig) -> dict[str, tuple[Any, Any]]:
    """Dotted field -> (the recipe's value, the run's) of all that decides the result and is not the recipe's."""
    try:
        base = flatten(recipe(config.method, config.env.name, config.scale).as_dict())
    except UserError:  # a recipe of another version, or a layout that is not here any more
        return {}
    if config.env.name in env_names():
        base |= flatten({"env": {"params": jsonable(make_env(config.env.name, 1).spec.params)}})
    own = flatten(config.as_dict())
    decisive = [name for name in own if name.partition(".")[0] not in _PLACES or name in ("run.seed", "run.schedule")]
    return {name: (base.get(name), own[name]) for name in decisive if own[name] != base.get(name)}


def repeat_command(config: RunConfig) -> str:
    """`popgen run ...` with the settings that make the same run again."""
    known = config.env.name in env_names()
    words = [f"method={config.method}", f"env={config.env.name if known else _CUSTOM}", f"scale={config.scale}"]
    words += [] if known else [f"env.name={_quote_text(config.env.name)}"]
    for name, (_, value) in recipe_differences(config).items():
        text = "null" if value is None else _quote_text(value) if isinstance(value, str) else json.dumps(value)
        words.append(f"{_SHORT.get(name, name)}={text}")
    return " ".join(["popgen run", *(shlex.quote(word) for word in words)])


def _quote_text(text: str) -> str:
    """As Hydra reads it."""
    return text if re.fullmatch(r"[\w./-]+", text) else "'" + text.replace("'", "\\'") + "'"
