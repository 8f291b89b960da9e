"""Which runs the targets want, by budget and seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from popgen.methods.registry import (
    DEFAULT_EGO,
    METHODS,
    find_objective,
    list_objectives,
    list_working,
    methods_with,
    recipe,
)
from popgen.reports.method_titles import name_of, title_of
from popgen.reports.paper_figures import BASELINES, OWN_METHOD, RENDEZVOUS, SIMULATOR_METHOD
from popgen.reports.reproduction.target_records import Budget, WantedRun, WantedStudy

ONE_LEVEL = "fcp"
"""The same networks and training without the ego's second level."""

EGO_MARK = "E-"
"""Before the name of the method whose population an ego was trained with, as in the paper."""

MODEL, SIMULATOR = name_of(OWN_METHOD), name_of(SIMULATOR_METHOD)
COMPARED = (MODEL, SIMULATOR, *(name_of(title) for title in BASELINES))
TEACHERS = (*(name_of(title) for title in BASELINES), MODEL)
"""Whose populations train egos and are held out, in the paper's order."""

ALL_TEACHERS = (MODEL, SIMULATOR, *sorted(name_of(title) for title in BASELINES))
"""Of an ego that all methods' populations train."""

NEEDS_RAY = "ppo.max_steps"
"""Methods with this setting learn on RLlib, which runs nowhere else."""

RANDOM_PLAY = 1.2
"""Dishes that members serve beside a random partner in cramped_room: cross-play need not be less."""

NEVER = 1_000_000.0
"""A score that nobody reaches."""

KL = "world_model.kl_predecessors"
SCORES, COSTS = "scores", "costs"


def list_words(
    budget: Budget, label: str, environment: str, changes: Mapping[str, Any] | None = None, size: int | None = None
) -> list[str]:
    """Overrides of a run.

    Args:
        budget: its recipe, sizes and settings.
        label: `method` or `method:objective`.
        environment: registry name.
        changes: settings on top of all.
        size: of its population, where it is not the budget's.
    """
    method = label.partition(":")[0]
    on_rendezvous = environment == RENDEZVOUS
    agents = budget.rendezvous_agents if on_rendezvous else budget.agents
    agents = METHODS[method].fit_size(agents if size is None else size)
    settings = {**find_objective(label), **(changes or {})}
    return [
        *(f"method={method}", f"env={environment}", f"scale={budget.scale}"),
        f"population.size={agents}",
        *(["run.transport=inline"] if budget.inline and method not in methods_with(NEEDS_RAY) else []),
        *(budget.rendezvous if on_rendezvous else ()),
        *budget.settings,
        *(f"{name}={'null' if value is None else value}" for name, value in settings.items()),
    ]


def want_runs(
    budget: Budget,
    seeds: Sequence[int],
    labels: Sequence[str],
    environments: Sequence[str],
    measures: Sequence[str],
) -> list[WantedRun]:
    """A run of each label in each environment with each seed; seeds vary slowest, so that the first is complete
    early."""
    return [
        WantedRun(title_of(label), tuple(list_words(budget, label, name)), seed, tuple(measures))
        for seed in seeds
        for name in environments
        for label in labels
    ]


def want_variants(
    budget: Budget,
    seeds: Sequence[int],
    label: str,
    environment: str,
    variants: Mapping[str, Mapping[str, Any]],
    measures: Sequence[str],
    size: int | None = None,
) -> list[WantedRun]:
    """Runs of one label that differ in some settings: what a row is called -> its settings."""
    title = title_of(label)
    return [
        WantedRun(
            f"{title}: {name}", tuple(list_words(budget, label, environment, changes, size)), seed, tuple(measures)
        )
        for seed in seeds
        for name, changes in variants.items()
    ]


def list_sabotage(budget: Budget, seeds: Sequence[int]) -> list[WantedRun]:
    """Every method with every objective on rendezvous."""
    return want_runs(budget, seeds, list_objectives(), [RENDEZVOUS], ["sabotage", COSTS])


def list_steps(budget: Budget, seeds: Sequence[int]) -> list[WantedRun]:
    """Costs, and a held evaluation of each member."""
    return want_runs(budget, seeds, COMPARED, budget.layouts, [COSTS, "held"])


def list_scores(budget: Budget, seeds: Sequence[int]) -> list[WantedRun]:
    """Self-play and cross-play of every method."""
    return want_runs(budget, seeds, COMPARED, budget.layouts, [SCORES, COSTS])


def list_curves(budget: Budget, seeds: Sequence[int]) -> list[WantedRun]:
    """Learning curves."""
    return want_runs(budget, seeds, COMPARED, budget.layouts, ["curves", SCORES])


def list_times(budget: Budget, seeds: Sequence[int]) -> list[WantedRun]:
    """The ring alone."""
    return want_runs(budget, seeds, COMPARED, [budget.ring], [COSTS])


def list_conventions(budget: Budget, seeds: Sequence[int]) -> list[WantedRun]:
    """How much of what people do the populations cover; and a row for each ego of a simulated study."""
    populations = want_runs(budget, seeds, COMPARED, budget.layouts, ["conventions", SCORES])
    return [*populations, *(run for seed in seeds for run in list_study_rows(budget, seed))]


def list_study_rows(budget: Budget, seed: int) -> list[WantedRun]:
    """A row for each method whose population teaches egos: clones of people beside those, in all layouts."""
    words, found = (f"method={DEFAULT_EGO}", f"scale={budget.scale}"), []
    for name in TEACHERS:
        teachers = (want_runs(budget, [seed], [name], [layout], [SCORES])[0] for layout in budget.layouts)
        found.append([WantedRun(teacher.row, words, seed, (), (teacher,)) for teacher in teachers])
    people = WantedStudy(tuple(ego for egos in found for ego in egos), budget.study)
    return [
        WantedRun(
            f"{EGO_MARK}{egos[0].row}, clones of people", words, seed, ("conventions",), egos[0].teachers, (), people
        )
        for egos in found
    ]


def list_generators(budget: Budget, seeds: Sequence[int]) -> list[WantedRun]:
    """A row for each method that makes populations, in which the egos that they taught stand too: of one level, which
    take a third of the time of two."""
    labels = [name for name, method in list_working() if not method.trains_ego]
    measures = [SCORES, COSTS, "diversity", "acting", "conventions"]
    populations = want_runs(budget, seeds, labels, budget.layouts, measures)
    teachers = [(label,) for label in labels]
    judged = ("holdout", "human")
    egos = (train_egos(budget, seeds, seed, teachers, judged, ego=ONE_LEVEL) for seed in seeds)
    return [*populations, *(one for found in egos for one in found)]


def list_egos(budget: Budget, seeds: Sequence[int]) -> list[WantedRun]:
    """An ego of two levels and one of one level for each method, and one of each that all methods' populations train;
    held out are all methods."""
    teachers = [*((name,) for name in (*TEACHERS, SIMULATOR)), ALL_TEACHERS]
    found = []
    for seed in seeds:
        for ego, mark in ((DEFAULT_EGO, ""), (ONE_LEVEL, ", one level")):
            found += train_egos(budget, seeds, seed, teachers, ("holdout",), ALL_TEACHERS, ego, mark)
    return found


def train_egos(
    budget: Budget,
    seeds: Sequence[int],
    seed: int,
    teachers: Sequence[Sequence[str]],
    measures: tuple[str, ...],
    held_out: Sequence[str] = TEACHERS,
    ego: str = DEFAULT_EGO,
    mark: str = "",
) -> list[WantedRun]:
    """Egos of one seed, beside populations that they never met.

    Args:
        budget: of all runs.
        seeds: of the target.
        seed: of the egos and of their teachers.
        teachers: labels of those that train one ego together, for each ego.
        measures: of the egos.
        held_out: labels; their populations are of the next one of the seeds.
        ego: method of the egos.
        mark: behind the name of a row.
    """
    other = seeds[(seeds.index(seed) + 1) % len(seeds)] if len(seeds) > 1 else seed + 1
    words, found = (f"method={ego}", f"scale={budget.scale}"), []
    for layout in budget.layouts:
        holdouts = tuple(want_runs(budget, [other], held_out, [layout], [SCORES]))
        for labels in teachers:
            needed = tuple(want_runs(budget, [seed], labels, [layout], [SCORES]))
            row = needed[0].row if len(needed) == 1 else "all of them"
            found.append(WantedRun(f"{row}{mark}", words, seed, measures, needed, holdouts))
    return found


def list_rewards(budget: Budget, seeds: Sequence[int]) -> list[WantedRun]:
    """Agent 1 of XPM-WM with each head of the world model, in the ring alone."""
    variants = {"event vector": {}, "scalar reward": {"world_model.reward_head": "scalar"}}
    runs = want_variants(budget, seeds, MODEL, budget.ring, variants, ["first"], size=1)
    return [replace(run, of_first=True) for run in runs]


def list_baselines(budget: Budget, seeds: Sequence[int]) -> list[WantedRun]:
    """Each baseline with other weights of cross-play, and trained for its whole budget."""
    found = []
    for environment in budget.layouts:
        for label in (name_of(title) for title in BASELINES):
            weight = recipe(label, environment, budget.scale).as_dict()["diversity"]["lambda_xp"]
            variants = {
                "recipe": {},
                "half of lambda_XP": {"diversity.lambda_xp": weight / 2},
                "twice lambda_XP": {"diversity.lambda_xp": 2 * weight},
                "no early end": {"ppo.target_score": NEVER},
            }
            found += want_variants(budget, seeds, label, environment, variants, [SCORES, COSTS, "held"])
    return found


def list_encoders(budget: Budget, seeds: Sequence[int]) -> list[WantedRun]:
    """XPM-Sim with and without an encoder that all members share."""
    variants = {"separate agents": {}, "shared encoder": {f"{SIMULATOR}.encoder": "shared"}}
    return want_variants(budget, seeds, SIMULATOR, RENDEZVOUS, variants, ["curves", SCORES, COSTS])


def list_ablations(budget: Budget, seeds: Sequence[int]) -> list[WantedRun]:
    """One part left out or put in at a time, each beside the recipe."""
    layout = budget.layouts[0]
    model = {
        "recipe": {},
        "KL to predecessors": {KL: 1.0},
        "no self-play from cross-play states": {"agent.sp_from_xp": 0.0},
    }
    limited = {
        name: {"recipe": {}, "cross-play limited": {f"{part}.xp_limit": RANDOM_PLAY, f"{part}.multiplier_step": 2.0}}
        for name, part in ((MODEL, "agent"), (SIMULATOR, SIMULATOR))
    }
    plain = {"env.params.exit_penalty": "none"}
    rendezvous = {
        "recipe": {},
        "no self-play from cross-play states": {f"{SIMULATOR}.sims_restart": 0, f"{SIMULATOR}.restart_weight": 0.0},
        "plain termination": plain,
    }
    return [
        *want_variants(budget, seeds, MODEL, layout, model | limited[MODEL], [SCORES, COSTS]),
        *want_variants(budget, seeds, SIMULATOR, layout, limited[SIMULATOR], [SCORES, COSTS]),
        *want_variants(budget, seeds, f"{SIMULATOR}:ours", RENDEZVOUS, rendezvous, [SCORES, COSTS, "sabotage"]),
    ]
