"""Bytes that a run may need, from its configuration alone: memory, object store, disk.

A method says what its buffers, weights and batches need (`popgen.methods.method.Needs`). All are bounds of what grows
with the configuration; what does not (programs, logs, plots, MLflow's own file) is `MARGIN`.
`popgen/runs/preflight.py` compares them with what the machine has.
"""

from __future__ import annotations

from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec
from popgen.methods.method import Needs
from popgen.methods.registry import METHODS

MARGIN = 256 * 2**20
"""Bytes of disk beside buffers and weights: MLflow's file, logs, plots."""

PROGRESS = 8
"""Copies of a member's weights in one checkpoint of its training: optimisers, what is published, the best so far."""

KEPT = 3
"""Checkpoints of the running member that are on disk at a time, the one that is being written among them."""


def needs_of(config: RunConfig, spec: EnvSpec) -> Needs:
    """What the run's method says."""
    return METHODS[config.method].needs(config, spec)


def store_bytes(needs: Needs) -> int:
    """What is in a node's object store at a time.

    Both whole buffers on their way to a checkpoint, the samplers' segments, and a margin for weights and start states.
    """
    return needs.buffers + needs.in_flight + MARGIN


def memory_needed(config: RunConfig, needs: Needs) -> int:
    """Object store, a batch, and the buffers three times: where they are filled, as they are copied for a checkpoint,
    and in the driver that writes it."""
    store = max(config.cluster.object_store_bytes or 0, store_bytes(needs))
    return 3 * needs.buffers + store + needs.batch


def disk_bytes(config: RunConfig, needs: Needs) -> int:
    """The run's folder: population (twice where MLflow's artefacts are in it), checkpoints, and the margin."""
    copies = 2 if config.tracking.enabled and config.tracking.uri is None else 1
    return config.population.size * (copies * needs.member + needs.left) + _running_bytes(needs) + MARGIN


def copy_bytes(config: RunConfig, needs: Needs) -> int:
    """The folder's copy in a storage, which for a while holds what only the copy before needs."""
    return disk_bytes(config, needs) + _running_bytes(needs)


def _running_bytes(needs: Needs) -> int:
    """Checkpoints of the running member: its weights and the buffers."""
    return needs.buffer_copies * needs.buffers + KEPT * PROGRESS * needs.together * needs.member
