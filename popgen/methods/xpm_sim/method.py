"""XPM-Sim as the rest of the house knows it."""

from popgen.methods.method import Method
from popgen.methods.xpm_sim.config import XpmSimRun
from popgen.methods.xpm_sim.needs import check_run, estimate_needs, list_actors
from popgen.methods.xpm_sim.recipes import OBJECTIVES, RECIPES

METHOD = Method(
    name="xpm_sim",
    title="XPM-Sim",
    summary="Cross-play minimisation on trajectories of the exact simulator.",
    colour="#009E73",
    marker="D",
    config=XpmSimRun,
    recipes=RECIPES,
    training="popgen.actors.xpm_sim_workers:open_training",
    actors=list_actors,
    needs=estimate_needs,
    check=check_run,
    objectives=OBJECTIVES,
    policies={"encoded": "popgen.methods.xpm_sim.encoded_policy:EncodedPolicy"},
)
