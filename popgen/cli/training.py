"""What the commands that train share: runs checked before anything starts, and a process made ready for them."""

from __future__ import annotations

import os
import secrets
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from popgen.cli.compose import compose

if TYPE_CHECKING:
    from popgen.config.run_config import RunConfig


def bound_threads(count: int) -> None:
    """Before torch is imported: its threads wait for each other actively, which on busy cores costs many times more
    than one thread alone takes for the small networks of an acting policy."""
    os.environ.setdefault("OMP_NUM_THREADS", str(count))


def before_ray(threads: int, local: bool) -> None:
    """Before Ray is imported: it sends nothing home, threads are bounded, and a local Ray takes no orders from others.

    A local Ray listens on all of the machine's addresses; it gets a token that only its own processes know. With a
    running cluster, or RAY_AUTH_MODE set, the environment decides.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if local and "RAY_AUTH_MODE" not in os.environ and "ray" not in sys.modules:
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    bound_threads(threads)


def runs_to_start(overrides: Sequence[Sequence[str]], out: str) -> list[RunConfig]:
    """The runs that a command starts itself, in folders under `out` that their settings decide.

    All that can be known before the first of them starts is checked, and the place of the report.

    Raises:
        UserError: what cannot work.
    """
    from popgen.config.run_config import RunConfig
    from popgen.runs.preflight import check_root, preflight

    configs = [RunConfig.parse(compose(words)) for words in overrides]
    local = all(config.cluster.address is None for config in configs)
    before_ray(max((config.cluster.threads for config in configs), default=1), local)
    from popgen.pipelines.run_batch import check_different, named

    configs = [named(config, Path(out) / "runs") for config in configs]
    check_different(configs)
    for config in configs:
        preflight(config)
    check_root(Path(out), 16 * 2**20, "--out")
    return configs
