"""Ego agents as the rest of the house knows them."""

from popgen.methods.ego.config import BrRun, FcpRun, HiptRun, SpAugRun, SpRun
from popgen.methods.ego.needs import check_run, estimate_needs, list_actors
from popgen.methods.ego.recipes import ALONE_RECIPES, BR_RECIPES, FLAT_RECIPES, HIPT_RECIPES
from popgen.methods.method import Method

_TRAINING = "popgen.actors.ego_workers:open_training"
_POLICIES = {
    "ego": "popgen.methods.ego.ego_policy:EgoPolicy",
    "hierarchical_ego": "popgen.methods.ego.ego_policy:HierarchicalEgoPolicy",
}

HIPT = Method(
    name="hipt",
    title="HiPT",
    summary="An ego of two levels beside a population: a z for some steps, and actions under it.",
    colour="#882255",
    marker="P",
    config=HiptRun,
    recipes=HIPT_RECIPES,
    training=_TRAINING,
    actors=list_actors,
    needs=estimate_needs,
    check=check_run,
    policies=_POLICIES,
    trains_ego=True,
)

FCP = Method(
    name="ego_fcp",
    title="FCP ego",
    summary="A recurrent ego of one level beside a population.",
    colour="#332288",
    marker="X",
    config=FcpRun,
    recipes=FLAT_RECIPES,
    training=_TRAINING,
    actors=list_actors,
    needs=estimate_needs,
    check=check_run,
    policies=_POLICIES,
    trains_ego=True,
)

BR = Method(
    name="br",
    title="BR",
    summary="The best response to one partner.",
    colour="#44AA99",
    marker="<",
    config=BrRun,
    recipes=BR_RECIPES,
    training=_TRAINING,
    actors=list_actors,
    needs=estimate_needs,
    check=check_run,
    policies=_POLICIES,
    trains_ego=True,
)

SP = Method(
    name="sp",
    title="SP",
    summary="A recurrent ego in self-play: a control.",
    colour="#999933",
    marker=">",
    config=SpRun,
    recipes=ALONE_RECIPES,
    training=_TRAINING,
    actors=list_actors,
    needs=estimate_needs,
    check=check_run,
    policies=_POLICIES,
    trains_ego=True,
)

SP_AUG = Method(
    name="sp_aug",
    title="SP-aug",
    summary="A recurrent ego in self-play from augmented start states: a control.",
    colour="#661100",
    marker="p",
    config=SpAugRun,
    recipes=ALONE_RECIPES,
    training=_TRAINING,
    actors=list_actors,
    needs=estimate_needs,
    check=check_run,
    policies=_POLICIES,
    trains_ego=True,
)
