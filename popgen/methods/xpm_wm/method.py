"""XPM-WM, and what else is trained in its world model, as the rest of the house knows them."""

from functools import partial

from popgen.methods.method import Continuation, Method
from popgen.methods.xpm_wm.config import SHAPES, FcpWmRun, MepWmRun, XpmWmRun
from popgen.methods.xpm_wm.needs import check_fcp, check_run, estimate_needs, list_actors
from popgen.methods.xpm_wm.recipes import FCP_RECIPES, MEP_RECIPES, RECIPES
from popgen.types import SKILLS

POLICIES = {"world_model": "popgen.methods.xpm_wm.actor_critic:WorldModelPolicy"}
CONTINUATION = Continuation("world_model", SHAPES, ("replay", "capacity"))
IN_WORLD_MODEL = partial(Method, actors=list_actors, needs=estimate_needs, policies=POLICIES, continuation=CONTINUATION)
"""What all methods in a world model have in common."""

METHOD = IN_WORLD_MODEL(
    name="xpm_wm",
    title="XPM-WM",
    summary="Cross-play minimisation on trajectories simulated by a learned world model.",
    colour="#0072B2",
    marker="o",
    config=XpmWmRun,
    recipes=RECIPES,
    training="popgen.actors.xpm_wm_workers:open_training",
    check=check_run,
)

FCP_WM = IN_WORLD_MODEL(
    name="fcp_wm",
    title="FCP-WM",
    summary="Self-play by different seeds in XPM-WM's world model, each kept at three skills.",
    colour="#A65628",
    marker="h",
    config=FcpWmRun,
    recipes=FCP_RECIPES,
    training="popgen.actors.xpm_wm_workers:open_skilled_training",
    check=check_fcp,
    multiple=len(SKILLS),
    alone=1,
)

MEP_WM = IN_WORLD_MODEL(
    name="mep_wm",
    title="MEP-WM",
    summary="Self-play in XPM-WM's world model, paid for what the population so far seldom does.",
    colour="#8DD3C7",
    marker="H",
    config=MepWmRun,
    recipes=MEP_RECIPES,
    training="popgen.actors.xpm_wm_workers:open_training",
    check=check_run,
)
