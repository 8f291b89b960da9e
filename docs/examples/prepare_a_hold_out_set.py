"""Choose the members of a population that differ most, and hold them out: an agent is evaluated beside them.

    python docs/examples/prepare_a_hold_out_set.py runs/demo 1 my_agent:MyAgent

The last words are how many to choose, and whom to evaluate: `module:Agent`, or the folder of an ego that has met none
of the population. On the command line: `popgen diversity runs/demo --choose 1`, then what its last line says.
"""

import sys

from popgen.envs import BatchedEnv, make_env
from popgen.evaluation.holdout import Casting, evaluate_holdout
from popgen.evaluation.holdout_overlap import check_disjoint
from popgen.evaluation.holdout_players import open_sides
from popgen.evaluation.partner_diversity import measure_partners
from popgen.reports.diversity_report import list_arguments
from popgen.reports.method_titles import title_of

population, count, ego = sys.argv[1], int(sys.argv[2]), sys.argv[3]
everybody = open_sides({"partner": [(None, population)]}, title_of)
info, players = everybody.environment, everybody.sides["partner"][0].players


def make(num_envs: int, seed: int) -> BatchedEnv:
    """The environment of the population."""
    return make_env(info.name, num_envs, seed=seed, **info.params)


found = measure_partners(make, players, None, episodes=5, seed=0, choose=count)
words = list_arguments([players[n] for n in found.chosen])
print("held out:", *words)

named = [(name, path) for name, _, path in (word.partition("=") for word in words)]
sides = open_sides({"ego": [("ego", ego)], "partner": named}, title_of).sides
check_disjoint(sides["ego"], sides["partner"])
result = evaluate_holdout(Casting(sides["ego"], sides["partner"]), info, make, episodes=5, seed=0)
print(
    f"{result.scores.mean():.2f} {info.score_name} an episode beside {count} of {len(players)} partners, in both seats"
)
