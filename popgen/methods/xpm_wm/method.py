"""XPM-WM as the rest of the house knows it."""

from popgen.methods.method import Continuation, Method
from popgen.methods.xpm_wm.config import SHAPES, XpmWmRun
from popgen.methods.xpm_wm.needs import check_run, estimate_needs, list_actors
from popgen.methods.xpm_wm.recipes import RECIPES

METHOD = Method(
    name="xpm_wm",
    title="XPM-WM",
    summary="Cross-play minimisation on trajectories simulated by a learned world model.",
    colour="#0072B2",
    marker="o",
    config=XpmWmRun,
    recipes=RECIPES,
    training="popgen.actors.xpm_wm_workers:open_training",
    actors=list_actors,
    needs=estimate_needs,
    check=check_run,
    policies={"world_model": "popgen.methods.xpm_wm.actor_critic:WorldModelPolicy"},
    continuation=Continuation("world_model", SHAPES, ("replay", "capacity")),
)
