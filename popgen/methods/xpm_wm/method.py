"""XPM-WM, and what else is trained in its world model, as the rest of the house knows them."""

from popgen.methods.method import Continuation, Method
from popgen.methods.xpm_wm.config import SHAPES, FcpWmRun, MepWmRun, XpmWmRun
from popgen.methods.xpm_wm.needs import check_fcp, check_run, estimate_needs, list_actors
from popgen.methods.xpm_wm.recipes import FCP_RECIPES, MEP_RECIPES, RECIPES
from popgen.types import SKILLS

POLICIES = {"world_model": "popgen.methods.xpm_wm.actor_critic:WorldModelPolicy"}
CONTINUATION = Continuation("world_model", SHAPES, ("replay", "capacity"))

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
    policies=POLICIES,
    continuation=CONTINUATION,
)

FCP_WM = Method(
    name="fcp_wm",
    title="FCP-WM",
    summary="Self-play by different seeds in XPM-WM's world model, each kept at three skills.",
    colour="#A65628",
    marker="h",
    config=FcpWmRun,
    recipes=FCP_RECIPES,
    training="popgen.actors.xpm_wm_workers:open_skilled_training",
    actors=list_actors,
    needs=estimate_needs,
    check=check_fcp,
    policies=POLICIES,
    continuation=CONTINUATION,
    multiple=len(SKILLS),
    alone=1,
)

MEP_WM = Method(
    name="mep_wm",
    title="MEP-WM",
    summary="Self-play in XPM-WM's world model, paid for what the population so far seldom does.",
    colour="#8DD3C7",
    marker="H",
    config=MepWmRun,
    recipes=MEP_RECIPES,
    training="popgen.actors.xpm_wm_workers:open_training",
    actors=list_actors,
    needs=estimate_needs,
    check=check_run,
    policies=POLICIES,
    continuation=CONTINUATION,
)
