"""The baselines on RLlib's MAPPO."""

from __future__ import annotations

from popgen.config.base import Schema


class PpoConfig(Schema):
    """MAPPO: networks, rollouts and the clipped surrogate."""


class DiversityConfig(Schema):
    """Cross-play and mixed play of LIPO and CoMeDi."""
