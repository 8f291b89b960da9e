"""Shapes in signatures are checked in tests: importing this before popgen makes jaxtyping and beartype look at them."""

from __future__ import annotations

from jaxtyping import install_import_hook

CHECKED = [
    "popgen.losses",
    "popgen.nets.blocks",
    "popgen.nets.feed_forward",
    "popgen.play.trajectories",
    "popgen.methods.xpm_wm.world_model",
    "popgen.methods.xpm_wm.latent_filter",
    "popgen.methods.xpm_wm.agent",
    "popgen.methods.xpm_wm.imagination",
    "popgen.methods.xpm_wm.actor_critic",
]
"""Modules whose public functions name the dimensions of their arrays."""

install_import_hook(CHECKED, "beartype.beartype")
