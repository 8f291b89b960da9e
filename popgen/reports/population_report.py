"""What a population holds, for people and for machines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd
from rich.table import Table
from rich.text import Text

from popgen.population.manifest import folder_name
from popgen.population.member_pairs import find_mates
from popgen.population.store import Population
from popgen.reports.frames import UNKNOWN, Sheet
from popgen.types import Kind


def describe_population(population: Population) -> dict[str, Any]:
    """A JSON-able account of a population.

    Keys: `path`; `manifest`, as in the file; `bytes`, size of all members' files; `steps`, environment steps by kind,
    and `total_steps`, over all members; `members`, each as in its member.json and with `total_steps`, `bytes`
    (of its folder) and `parameters` (numbers in policy.safetensors).
    """
    members = [_describe_member(population, member) for member in range(1, len(population) + 1)]
    kinds = list_kinds(population)
    return {
        "path": str(population.path),
        "manifest": population.manifest.model_dump(mode="json"),
        "bytes": sum(member["bytes"] for member in members),
        "steps": {kind: sum(member["steps"].get(kind, 0) for member in members) for kind in kinds},
        "total_steps": sum(member["total_steps"] for member in members),
        "members": members,
    }


def _describe_member(population: Population, member: int) -> dict[str, Any]:
    info = population.info(member)
    folder = population.path / folder_name(member)
    return {
        **info.model_dump(mode="json"),
        "total_steps": info.total_steps,
        "bytes": sum(path.stat().st_size for path in folder.iterdir() if path.is_file()),
        "parameters": sum(array.size for array in population[member].weights().values()),
    }


def list_kinds(population: Population) -> list[str]:
    """Kinds of environment steps that some member used, in the order of `Kind`."""
    used = {kind for info in population.members for kind in info.steps}
    return [str(kind) for kind in Kind if str(kind) in used]


def render_population(report: Mapping[str, Any], population: Population) -> Table:
    """What an account says of the whole population, for the terminal; print it with a rich console."""
    info, manifest = population.env_info, population.manifest
    params = ", ".join(f"{name}={value}" for name, value in info.params.items() if name != "grid")
    size, steps = report["bytes"] / 2**20, report["total_steps"]
    facts = {
        "population": report["path"],
        "environment": f"{info.name} ({params})" if params else info.name,
        "rules": info.fingerprint[:12],
        "method": f"{manifest.method}, seed {manifest.seed}, config {manifest.config_digest[:12]}",
        "members": f"{len(population)}, {size:.1f} MiB, {steps:,} environment steps",
        "written by": ", ".join(f"{name} {value}" for name, value in manifest.versions.model_dump().items()),
    }
    grid = Table.grid(padding=(0, 2))
    for name, value in facts.items():
        grid.add_row(name, Text(value))
    return grid


def make_members_sheet(report: Mapping[str, Any], population: Population) -> Sheet:
    """A row for each member; of one that was trained in a pair its role and its mate, with which it plays its SP."""
    mates = find_mates(population.members)
    pairs = {member["id"]: mate for member, mate in zip(report["members"], mates, strict=True) if mate != member["id"]}
    frame = pd.DataFrame(
        [
            {
                "member": str(member["id"]),
                "policy": member["kind"],
                **({"pair": _name_mate(member, pairs)} if pairs else {}),
                "seed": str(member["seed"]),
                "parameters": f"{member['parameters']:,}",
                "MiB": f"{member['bytes'] / 2**20:.1f}",
                **{f"{kind} steps": f"{member['steps'].get(kind, 0):,}" for kind in report["steps"]},
                "all steps": f"{member['total_steps']:,}",
            }
            for member in report["members"]
        ]
    )
    return Sheet("members", frame, labels=3 if pairs else 2)


def _name_mate(member: Mapping[str, Any], pairs: Mapping[int, int]) -> str:
    return f"{member['extra']['role']}, mate {pairs[member['id']]}" if member["id"] in pairs else UNKNOWN
