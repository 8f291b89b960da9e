"""Ego agents as the rest of the house knows them."""

from functools import partial

from popgen.methods.ego.config import BrRun, EgoFcpRun, HiptRun, SpAugRun, SpRun
from popgen.methods.ego.needs import check_run, estimate_needs, list_actors
from popgen.methods.ego.recipes import ALONE_RECIPES, BR_RECIPES, FLAT_RECIPES, HIPT_RECIPES
from popgen.methods.method import Method

_make_ego = partial(
    Method,
    training="popgen.actors.ego_workers:open_training",
    actors=list_actors,
    needs=estimate_needs,
    check=check_run,
    policies={
        "ego": "popgen.methods.ego.ego_policy:EgoPolicy",
        "hierarchical_ego": "popgen.methods.ego.ego_policy:HierarchicalEgoPolicy",
    },
    trains_ego=True,
)

HIPT = _make_ego(
    name="hipt",
    title="HiPT",
    summary="An ego of two levels beside a population: a z for some steps, and actions under it.",
    colour="#882255",
    marker="P",
    config=HiptRun,
    recipes=HIPT_RECIPES,
)

FCP = _make_ego(
    name="ego_fcp",
    title="FCP ego",
    summary="A recurrent ego of one level beside a population.",
    colour="#332288",
    marker="X",
    config=EgoFcpRun,
    recipes=FLAT_RECIPES,
)

BR = _make_ego(
    name="br",
    title="BR",
    summary="The best response to one partner.",
    colour="#44AA99",
    marker="<",
    config=BrRun,
    recipes=BR_RECIPES,
)

SP = _make_ego(
    name="sp",
    title="SP",
    summary="A recurrent ego in self-play: a control.",
    colour="#999933",
    marker=">",
    config=SpRun,
    recipes=ALONE_RECIPES,
)

SP_AUG = _make_ego(
    name="sp_aug",
    title="SP-aug",
    summary="A recurrent ego in self-play from augmented start states: a control.",
    colour="#661100",
    marker="p",
    config=SpAugRun,
    recipes=ALONE_RECIPES,
)
