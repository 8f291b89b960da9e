"""The baselines on RLlib's MAPPO as the rest of the house knows them."""

from popgen.methods.mappo.config import ComediRun, LipoRun, MappoRun
from popgen.methods.mappo.needs import (
    check_comedi,
    check_view,
    estimate_comedi,
    estimate_lipo,
    estimate_mappo,
    list_actors,
)
from popgen.methods.mappo.recipes import COMEDI_RECIPES, LIPO_RECIPES, RECIPES
from popgen.methods.method import Method

MAPPO = Method(
    name="mappo",
    title="MAPPO",
    summary="Self-play by MAPPO on RLlib: members that differ by their seeds.",
    colour="#D55E00",
    marker="v",
    config=MappoRun,
    recipes=RECIPES,
    training="popgen.methods.mappo.train:open_training",
    actors=list_actors,
    needs=estimate_mappo,
    check=check_view,
)

LIPO = Method(
    name="lipo",
    title="LIPO",
    summary="All members together, less cross-play with the strongest partner, on RLlib's MAPPO.",
    colour="#E69F00",
    marker="s",
    config=LipoRun,
    recipes=LIPO_RECIPES,
    training="popgen.methods.mappo.lipo:open_training",
    actors=list_actors,
    needs=estimate_lipo,
    check=check_view,
)

COMEDI = Method(
    name="comedi",
    title="CoMeDi",
    summary="One member after the other against frozen predecessors, with mixed play, on RLlib's MAPPO.",
    colour="#CC79A7",
    marker="^",
    config=ComediRun,
    recipes=COMEDI_RECIPES,
    training="popgen.methods.mappo.comedi:open_training",
    actors=list_actors,
    needs=estimate_comedi,
    check=check_comedi,
)
