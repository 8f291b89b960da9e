"""XPM-Sim with the exact simulator as dynamics model F."""

from __future__ import annotations

from popgen.config.base import Schema


class XpmSimConfig(Schema):
    """Buffers, simulated trajectories and the objective (paper, section 3 and the table of XPM-Sim)."""
