"""The baselines on RLlib's MAPPO as the rest of the house knows them."""

from popgen.methods.mappo.config import (
    BpRun,
    BrdivRun,
    ComediRun,
    E3tRun,
    FcpRun,
    HspRun,
    LipoRun,
    MappoRun,
    MepRun,
    TrajediRun,
)
from popgen.methods.mappo.needs import (
    check_brdiv,
    check_comedi,
    check_e3t,
    check_fcp,
    check_hsp,
    check_run,
    estimate_brdiv,
    estimate_comedi,
    estimate_hsp,
    estimate_lipo,
    estimate_mappo,
    estimate_together,
    list_actors,
)
from popgen.methods.mappo.recipes import (
    BP_RECIPES,
    BRDIV_RECIPES,
    COMEDI_OBJECTIVES,
    COMEDI_RECIPES,
    FCP_RECIPES,
    HSP_RECIPES,
    LIPO_OBJECTIVES,
    LIPO_RECIPES,
    RECIPES,
    TRAJEDI_RECIPES,
)
from popgen.methods.method import Method
from popgen.types import SKILLS

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
    check=check_run,
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
    objectives=LIPO_OBJECTIVES,
    actors=list_actors,
    needs=estimate_lipo,
    check=check_run,
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
    objectives=COMEDI_OBJECTIVES,
    actors=list_actors,
    needs=estimate_comedi,
    check=check_comedi,
)

FCP = Method(
    name="fcp",
    title="FCP",
    summary="Self-play by different seeds, each kept before, half-way through and after its training.",
    colour="#7F7F7F",
    marker="p",
    config=FcpRun,
    recipes=FCP_RECIPES,
    training="popgen.methods.mappo.fcp:open_training",
    actors=list_actors,
    needs=estimate_mappo,
    check=check_fcp,
    multiple=len(SKILLS),
)

MEP = Method(
    name="mep",
    title="MEP",
    summary="All members together, paid for what the population seldom does, on RLlib's MAPPO.",
    colour="#56B4E9",
    marker="P",
    config=MepRun,
    recipes=RECIPES,
    training="popgen.methods.mappo.mep:open_training",
    actors=list_actors,
    needs=estimate_together,
    check=check_run,
)

TRAJEDI = Method(
    name="trajedi",
    title="TrajeDi",
    summary="All members together, paid for trajectories that diverge from the others', on RLlib's MAPPO.",
    colour="#000000",
    marker="X",
    config=TrajediRun,
    recipes=TRAJEDI_RECIPES,
    training="popgen.methods.mappo.trajedi:open_training",
    actors=list_actors,
    needs=estimate_together,
    check=check_run,
)

HSP = Method(
    name="hsp",
    title="HSP",
    summary="Pairs of an agent with a hidden utility and its partner, the most different of a pool, on RLlib's MAPPO.",
    colour="#DDCC77",
    marker="D",
    config=HspRun,
    recipes=HSP_RECIPES,
    training="popgen.methods.mappo.hsp:open_training",
    actors=list_actors,
    needs=estimate_hsp,
    check=check_hsp,
    multiple=2,
)

BP = Method(
    name="bp",
    title="BP",
    summary="Behaviour-preferring partners and their best responses, chosen by BR-Div, on RLlib's MAPPO.",
    colour="#117733",
    marker="d",
    config=BpRun,
    recipes=BP_RECIPES,
    training="popgen.methods.mappo.hsp:open_training",
    actors=list_actors,
    needs=estimate_hsp,
    check=check_hsp,
    multiple=2,
)

BRDIV = Method(
    name="brdiv",
    title="BRDiv",
    summary="Pairs of a confederate and its best response, good together and bad with all others', on RLlib's MAPPO.",
    colour="#AA4499",
    marker="<",
    config=BrdivRun,
    recipes=BRDIV_RECIPES,
    training="popgen.methods.mappo.brdiv:open_training",
    actors=list_actors,
    needs=estimate_brdiv,
    check=check_brdiv,
    multiple=2,
)

E3T = Method(
    name="e3t",
    title="E3T",
    summary="Play beside the own policy mixed with chance: members that differ by their seeds, on RLlib's MAPPO.",
    colour="#6699CC",
    marker="*",
    config=E3tRun,
    recipes=RECIPES,
    training="popgen.methods.mappo.e3t:open_training",
    actors=list_actors,
    needs=estimate_mappo,
    check=check_e3t,
)
