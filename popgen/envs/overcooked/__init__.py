"""Two-player Overcooked: compiled, batched, exact.

The rules are those of overcooked_ai 1.1.0 (Carroll et al. 2019, "On the Utility of Learning about Humans for
Human-AI Coordination"), whose classes are the oracle in the tests.
"""

from popgen.envs.overcooked.env import OvercookedEnv
from popgen.envs.overcooked.layout import layout_names

__all__ = ["OvercookedEnv", "layout_names"]
