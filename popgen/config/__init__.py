"""Frozen schemas, one per group of conf/, checked before anything starts.

Every number that a method uses stands here with its range; `conf/` holds the values. The schemas know
nothing of Hydra: the command line composes a plain dictionary and calls `RunConfig.parse`.
"""

from popgen.config.base import Schema
from popgen.config.baselines import DiversityConfig, PpoConfig
from popgen.config.common import (
    ClusterConfig,
    EnvConfig,
    EvaluationConfig,
    PopulationConfig,
    RunSection,
    TrackingConfig,
)
from popgen.config.run import SECTIONS, RunConfig, as_user_error, closest_field, field_names, unknown_field
from popgen.config.xpm_sim import XpmSimConfig
from popgen.config.xpm_wm import (
    ACTING,
    OPEN_LOOP,
    PREFILL_CHUNK,
    SHAPES,
    AgentConfig,
    Phase1Config,
    Phase2Config,
    ReplayConfig,
    WorldModelConfig,
)

__all__ = [
    "ACTING",
    "OPEN_LOOP",
    "PREFILL_CHUNK",
    "SECTIONS",
    "SHAPES",
    "AgentConfig",
    "ClusterConfig",
    "DiversityConfig",
    "EnvConfig",
    "EvaluationConfig",
    "Phase1Config",
    "Phase2Config",
    "PopulationConfig",
    "PpoConfig",
    "ReplayConfig",
    "RunConfig",
    "RunSection",
    "Schema",
    "TrackingConfig",
    "WorldModelConfig",
    "XpmSimConfig",
    "as_user_error",
    "closest_field",
    "field_names",
    "unknown_field",
]
