"""Ray for one run: connect to a cluster, or start one on this machine."""

from __future__ import annotations

import math
import os
from typing import Any

import ray

from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.runs.interruption import end_on_sigterm
from popgen.runs.ray_folder import make_ray_folder
from popgen.runs.resources import count_cores, demands, total

STARTS = 4
LATE = "timed out during startup"


def start_ray(config: RunConfig) -> bool:
    """Connect to a cluster or start a local one; True if this call did it."""
    if ray.is_initialized():
        return False
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Quiet: Ray warns once about the accelerator variable it will stop overriding.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    cluster, wanted = config.cluster, total(demands(config)).get("CPU", 0.0)
    local = cluster.address is None
    limits: dict[str, Any] = (
        {"object_store_memory": cluster.object_store_bytes} if local and cluster.object_store_bytes else {}
    )
    arguments = {
        # Without an address Ray would look for a running cluster before it starts a local one.
        "address": "local" if local else cluster.address,
        # On fewer cores than the actors ask for they take turns.
        "num_cpus": cluster.num_cpus or max(count_cores(), math.ceil(wanted)) if local else None,
        "include_dashboard": False if local else None,
        "log_to_driver": False,
        "logging_level": "ERROR",
    }
    if local and (folder := make_ray_folder()):
        limits["_temp_dir"] = folder
    try:
        _start_with_patience(arguments | limits)
    except ConnectionError as error:
        raise UserError("cluster.address", f"no Ray answers ({error})", "start it, or use cluster=laptop") from None
    return True


def _start_with_patience(arguments: dict[str, Any]) -> None:
    """`ray.init`, again where Ray gave up on its own processes: it waits half a minute, too short on a busy machine.

    Raises:
        UserError: it gave up `STARTS` times.
    """
    for _ in range(STARTS):
        try:
            ray.init(**arguments)
            end_on_sigterm()
            return
        except Exception as error:  # Ray raises that very class
            if LATE not in str(error):
                raise
        ray.shutdown()
    problem = f"Ray did not come up in {STARTS} tries, the machine is too busy"
    raise UserError("cluster", problem, "end other work; the same run.id goes on")
