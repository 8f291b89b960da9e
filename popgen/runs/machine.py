"""What the machine is, for figures whose worth depends on it."""

from __future__ import annotations

import os
import platform
from pathlib import Path

_PROCESSORS = Path("/proc/cpuinfo")


def describe_machine() -> str:
    """Processor, cores and memory in a line: `2 cores of AMD EPYC, 16 GB`."""
    cores = os.cpu_count() or 1
    return f"{cores} core{'s' if cores > 1 else ''} of {_find_processor()}, {_count_gigabytes()} GB"


def _find_processor() -> str:
    """The model's name, the architecture where the system does not tell it."""
    try:
        lines = _PROCESSORS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _count_gigabytes() -> int:
    """Memory, rounded."""
    return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30)
