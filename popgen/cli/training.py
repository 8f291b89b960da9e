"""What the commands that train share: runs checked before anything starts, and a process made ready for them."""

from __future__ import annotations

import os
import secrets
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from popgen.cli.compose import choose_method, compose
from popgen.cli.output_places import check_report_folder
from popgen.cli.printing import tell_notes

if TYPE_CHECKING:
    from popgen.config.run_config import RunConfig


def bound_threads(count: int) -> None:
    """Before torch is imported: its threads wait for each other actively, which on busy cores costs many times more
    than one thread alone takes for the small networks of an acting policy. Where there are several, they are to sleep
    while they wait; the workers of a local Ray inherit both."""
    os.environ.setdefault("OMP_NUM_THREADS", str(count))
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def before_ray(threads: int, local: bool) -> None:
    """Before Ray is imported: it sends nothing home, threads are bounded, and a local Ray takes no orders from others.

    A local Ray listens on all of the machine's addresses; it gets a token that only its own processes know. With a
    running cluster, or RAY_AUTH_MODE set, the environment decides.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if local and "RAY_AUTH_MODE" not in os.environ and "ray" not in sys.modules:
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    bound_threads(threads)


def runs_to_start(
    overrides: Sequence[Sequence[str]],
    out: str,
    shared: Sequence[str] = (),
    config_dir: str | None = None,
    *,
    quiet: bool = False,
) -> list[RunConfig]:
    """The runs that a command starts itself, in folders under `out` that their settings decide.

    All that can be known before the first of them starts is checked, and the place of the report.

    Args:
        overrides: of each run.
        out: folder.
        shared: those of them that all runs were given; one that only some methods have is left out for the others.
        config_dir: the user's own presets.
        quiet: say nothing of what is left out, and of what to know about the environments.

    Raises:
        UserError: what cannot work.
    """
    from popgen.config.run_config import RunConfig
    from popgen.runs.preflight import preflight

    notes: dict[str, None] = {}
    kept = leave_out_foreign(overrides, shared, config_dir, notes)
    configs = [RunConfig.parse(compose(words, config_dir)) for words in kept]
    local = all(config.cluster.address is None for config in configs)
    before_ray(max((config.cluster.threads for config in configs), default=1), local)
    from popgen.pipelines.run_batch import check_different, named

    configs = [named(config, Path(out) / "runs") for config in configs]
    check_different(configs)
    for config in configs:
        notes |= dict.fromkeys(f"{config.env.name}: {note}" for note in preflight(config).notes)
    check_report_folder(Path(out), quiet=quiet)
    if not quiet:
        tell_notes(notes)
    return configs


def leave_out_foreign(
    overrides: Sequence[Sequence[str]], shared: Sequence[str], config_dir: str | None, notes: dict[str, None]
) -> list[list[str]]:
    """The overrides without those shared ones that a run's method lacks and another run's has; `notes` takes these.

    A setting that none of the methods has stays, for its run to be refused by.
    """
    from popgen.config.run_config import field_names
    from popgen.methods.registry import METHODS

    methods = [choose_method(words, config_dir) for words in overrides] if shared else []
    fields = {method: set(field_names(METHODS[method].config)) for method in methods}
    kept = [list(words) for words in overrides]
    for words, method in zip(kept, methods, strict=False):
        foreign = set().union(*fields.values()) - fields[method]
        for word in [word for word in words if word in shared]:
            if word.lstrip("+~").partition("=")[0] in foreign:
                words.remove(word)
                notes[f"{word} is left out for {method}, which has no such setting"] = None
    return kept
