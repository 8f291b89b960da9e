"""Segments on disk: one safetensors file for what one call of a sampler gave, with its marks in the header."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from popgen.durable_files import write_file
from popgen.errors import UserError
from popgen.types import Kind, Segment

_ARRAYS = tuple(field.name for field in fields(Segment) if field.name not in ("kind", "members", "sampler", "sequence"))


def save_segments(path: Path, segments: list[Segment], owner: int) -> None:
    """Write and sync; `owner` is the member during whose training the steps were taken."""
    arrays = {
        f"{number}.{name}": np.ascontiguousarray(getattr(segment, name))
        for number, segment in enumerate(segments)
        for name in _ARRAYS
    }
    marks = [[str(s.kind), list(s.members), s.sampler, s.sequence] for s in segments]
    said = {"owner": str(owner), "segments": json.dumps(marks)}
    data = save(arrays, metadata={**said, "sha256": _digest_segments(arrays, said)})
    write_file(path, data)


def load_segments(path: Path) -> tuple[list[Segment], int]:
    """What `save_segments` wrote: the segments and their owner.

    Raises:
        UserError: a missing or damaged file.
    """
    try:
        with safe_open(str(path), "numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no dictionary)
            if metadata.get("sha256", _digest_segments(arrays, metadata)) != _digest_segments(arrays, metadata):
                raise ValueError("they are not what was written")
            marks = json.loads(metadata["segments"])
            segments = [
                Segment(
                    Kind(kind),
                    (int(members[0]), int(members[1])),
                    **{name: arrays[f"{number}.{name}"] for name in _ARRAYS},
                    sampler=sampler,
                    sequence=int(sequence),
                )
                for number, (kind, members, sampler, sequence) in enumerate(marks)
            ]
            return segments, int(metadata["owner"])
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise UserError(str(path), f"unreadable segments ({error})", "remove checkpoints/progress") from None


def _digest_segments(arrays: Mapping[str, np.ndarray], said: Mapping[str, str]) -> str:
    """sha256 of the marks and, by name, of the arrays."""
    digest = hashlib.sha256(f"{said['owner']} {said['segments']}".encode())
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(arrays[name]).data)
    return digest.hexdigest()
