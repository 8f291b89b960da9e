"""What `popgen reproduce` measures of a finished run: name -> small figures for its record.

Where the meaning of a measure changes, `popgen.reports.reproduction.measure_definitions` gets a new number.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from popgen.envs import make_env
from popgen.errors import UserError
from popgen.evaluation.action_diversity import measure_groups
from popgen.evaluation.convention_coverage import measure_coverage
from popgen.evaluation.convention_effects import tabulate_effects
from popgen.evaluation.crossplay import IDLE, RANDOM
from popgen.evaluation.held_members import hold_members
from popgen.evaluation.holdout import Casting, evaluate_holdout
from popgen.evaluation.holdout_overlap import check_disjoint
from popgen.evaluation.holdout_players import open_sides
from popgen.evaluation.partner_diversity import measure_partners
from popgen.evaluation.played_games import PlayedGame, count_members, count_people
from popgen.humans.proxies import ProxySearch, fit_missing_population
from popgen.humans.recordings import LAYOUTS, load_games
from popgen.pipelines.compare import HELD_SEED
from popgen.pipelines.experiments import describe_population, measure_source, open_sources
from popgen.pipelines.simulated_study import CONVENTION_SPREAD, StudyToSimulate, play_study
from popgen.play import event_diversity
from popgen.population import load_population
from popgen.reports.comparison import default_thresholds, quality_costs
from popgen.reports.crossplay_report import list_own_scores
from popgen.reports.holdout_report import to_dict
from popgen.reports.method_titles import title_of
from popgen.reports.run_record import MemberRecord, RunRecord, read_run
from popgen.types import FINAL_SKILL, SKILLS, Kind

SEED = 0
"""Of evaluations; that of held ones is HELD_SEED."""

GRID = 21
"""Points of a curve that is kept."""

SHARE = 0.8
"""Of the final score, at which a curve has risen."""

SUBSETS = 5_000
"""Sets of members that BR-Div is averaged over at most; of more of them so many are drawn."""


@dataclass(frozen=True)
class RunToMeasure:
    """A finished run, and what it is measured with.

    Attributes:
        folder: of the run.
        row: what it is called.
        episodes: of every evaluation.
        holdouts: title -> folder of a run whose population an ego is held against.
        people: the study in which simulated people play with the ego.
        humans: folder of human proxies, which are fitted there once.
        proxy: of the search for one, as the budget says.
        common: members of the smallest population that it is compared with, 0 where it is compared with none.
    """

    folder: Path
    row: str
    episodes: int
    holdouts: Mapping[str, Path]
    people: StudyToSimulate | None = None
    humans: Path = Path("humans")
    proxy: Mapping[str, int] = field(default_factory=dict)
    common: int = 0


def measure_scores(job: RunToMeasure) -> dict[str, Any]:
    """Of the run's own evaluation: SP, XP, beside random and idle, what remains after cross-play, obstruction; and its
    episodes for each pair."""
    scores = read_run(job.folder).scores
    found = {"episodes": scores["episodes"], **{name: scores[name]["mean"] for name in ("sp", "xp")}}
    found |= {partner: scores["beside"][partner]["both"]["mean"] for partner in (RANDOM, IDLE)}
    members = scores.get("mixed_play", {}).get("members", [])
    shares = [one[seat]["kept"]["mean"] for one in members for seat in ("seat_0", "seat_1")]
    known = [share for share in shares if share is not None]
    if known:
        found |= {"mixed": float(np.mean(known)), "mixed_least": min(known)}
    if "pairs" in scores["obstruction"]:
        found["obstructed"] = len({tuple(one["pair"]) for one in scores["obstruction"]["pairs"]})
    return found


def measure_costs(job: RunToMeasure) -> dict[str, Any]:
    """Environment steps and minutes: of the first member, of each later one on average, in all, and cumulative."""
    members = read_run(job.folder).members
    steps = [member.real for member in members]
    simulated = sum(member.steps.get(str(Kind.SIMULATED), 0) for member in members)
    found = {"first": steps[0], "real": sum(steps), "by_members": list(accumulate(steps)), "simulated": simulated}
    if len(steps) > 1:
        found["later"] = float(np.mean(steps[1:]))
    minutes = [member.seconds / 60 for member in members if member.seconds is not None]
    if len(minutes) == len(members):
        found |= {"first_minutes": minutes[0], "minutes": sum(minutes), "minutes_by_members": list(accumulate(minutes))}
        if len(minutes) > 1:
            found["later_minutes"] = float(np.mean(minutes[1:]))
    return found


def measure_curves(job: RunToMeasure) -> dict[str, Any]:
    """Real self-play in training: the mean of later members against own and simulated steps; where that is first at
    SHARE of the later members' score in the run's evaluation; and the episodes of that for each pair."""
    run = read_run(job.folder)
    later = run.members[1:]
    own = [score for score in list(list_own_scores(run.scores).values())[1:] if score is not None]
    found: dict[str, Any] = {
        "episodes": run.scores["episodes"],
        "later": _average_curve(later, simulated=False),
        "later_simulated": _average_curve(later, simulated=True),
    }
    if own:
        found["final"] = float(np.mean(own))
        for name, curve in (("reached", found["later"]), ("reached_simulated", found["later_simulated"])):
            above = [steps for steps, score in curve if score >= SHARE * found["final"]]
            found |= {name: above[0]} if above and found["final"] > 0 else {}
    return {name: value for name, value in found.items() if value != []}


def _average_curve(members: Sequence[MemberRecord], *, simulated: bool) -> list[list[float]]:
    """[step, score] on a grid that all members reach; empty where nothing was kept."""
    found = [[(p.simulated if simulated else p.step, p.sp) for p in member.curve] for member in members]
    known = [np.array(points, float) for points in found if len(points) > 1]
    end = min((points[-1, 0] for points in known), default=0.0)
    if not end:
        return []
    grid = np.linspace(0.0, end, GRID)
    mean = np.mean([np.interp(grid, points[:, 0], points[:, 1]) for points in known], axis=0)
    return [[float(step), float(score)] for step, score in zip(grid, mean, strict=True)]


def measure_first(job: RunToMeasure) -> dict[str, Any]:
    """Of the first member alone: real self-play in training, its score in the run's evaluation and the episodes of that
    for each pair, steps and minutes."""
    run = read_run(job.folder)
    member, scores = run.members[0], run.scores
    final = list_own_scores(scores)[member.member]
    found: dict[str, Any] = {"final": final, "episodes": scores["episodes"], "steps": member.real}
    if curve := _average_curve([member], simulated=False):
        found["curve"] = curve
    return found | ({} if member.seconds is None else {"minutes": member.seconds / 60})


def measure_held(job: RunToMeasure) -> dict[str, Any]:
    """How many members pass a held evaluation, and the real steps taken in all by then where all do."""
    run = read_run(job.folder)
    limits = default_thresholds(run.environment.name)
    if limits is None:
        return {}
    held = hold_members(load_population(job.folder / "population"), job.episodes, HELD_SEED)
    last = quality_costs(run, limits, held)[-1]
    return {"passed": last.reached, "sp": limits.sp, "xp": limits.xp} | ({} if last.bound else {"steps": last.steps})


def measure_exits(job: RunToMeasure) -> dict[str, Any]:
    """Who leaves rendezvous in cross-play; nothing where players cannot leave."""
    try:
        source = open_sources([(job.row, job.folder)])[0]
    except UserError:
        return {}
    row = describe_population(measure_source(source, job.episodes, SEED))
    landmarks = row["landmarks"]
    return {
        "any_exit": row["average_ended_early"],
        "own_exit": row["average"],
        "by_agent": row["ended_early"],
        **{name: row[name]["mean"] for name in ("sp", "xp", "xp_apart")},
        **{partner: row["beside"][partner]["mean"] for partner in (RANDOM, IDLE)},
        **({"landmarks": len(landmarks["used"]), "sharing": len(row["pairs"]["sharing"])} if landmarks else {}),
    }


def measure_diversity(job: RunToMeasure) -> dict[str, Any]:
    """BR-Div over the members' events in play with themselves, or with their mates where they were trained in pairs:
    of as many members as the smallest population that is compared has, the mean over all sets of so many."""
    opened = open_sides({"partner": [(None, str(job.folder))]}, title_of)
    players = [player for group in opened.sides["partner"] for player in group.players]
    name, params = opened.environment.name, opened.environment.params

    def make(num_envs: int, seed: int) -> Any:
        return make_env(name, num_envs, seed=seed, **params)

    size = min(job.common or len(players), len(players))
    sets = measure_subsets(measure_partners(make, players, None, job.episodes, SEED).kinds, size)
    rank, log = (float(np.mean([getattr(one, name) for one in sets])) for name in ("effective_rank", "log_determinant"))
    figures = {"members": len(players), "of": size, "effective_rank": rank}
    return figures | ({"log_determinant": log} if math.isfinite(log) else {})


def measure_subsets(counts: np.ndarray, size: int) -> list[event_diversity.Diversity]:
    """BR-Div of every set of `size` of some members, each set on its own; of SUBSETS drawn ones of more.

    Args:
        counts: (K, F) mean counts of an episode.
        size: at most K.
    """
    members = len(counts)
    if math.comb(members, size) <= SUBSETS:
        chosen = [list(rows) for rows in itertools.combinations(range(members), size)]
    else:
        rng = np.random.default_rng(SEED)
        chosen = [sorted(rng.choice(members, size, replace=False).tolist()) for _ in range(SUBSETS)]
    return [event_diversity.measure_diversity(counts[rows]) for rows in chosen]


def measure_acting(job: RunToMeasure) -> dict[str, Any]:
    """How differently the members act (see `popgen.evaluation.action_diversity`); of members of several skills those
    whose training went to its end.

    Nothing where they cannot tell their probabilities. Where there are fewer of full skill than the smallest population
    has members, it is told how many there are and how many it takes.
    """
    opened = open_sides({"partner": [(None, str(job.folder))]}, title_of)
    name, params = opened.environment.name, opened.environment.params
    (group,) = opened.sides["partner"]
    if any(player.part in SKILLS for player in group.players):
        group = replace(group, players=tuple(player for player in group.players if player.part == FINAL_SKILL))
        if len(group.players) < max(2, job.common):
            return {"finals": len(group.players), "needed": max(2, job.common)}

    def make(num_envs: int, seed: int) -> Any:
        return make_env(name, num_envs, seed=seed, **params)

    measured = {one.part: one.found for one in measure_groups(make, [group], job.episodes, SEED)}
    if not measured:
        return {}
    found = measured["all"]
    figures: dict[str, Any] = {"members": found.members} | ({"share": found.share.value} if found.share else {})
    for name, interval in (("entropy", found.entropy), ("trajectories", found.trajectories)):
        figures |= {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
    return figures


def measure_ego(job: RunToMeasure) -> dict[str, Any]:
    """Score of an ego beside each held-out population, their mean, and its worst pair."""
    standings = _play_with_strangers(job, job.holdouts)
    means = {one["partners"]: one["mean"] for one in standings if one["partners"] in job.holdouts}
    worst = min(one["worst"]["score"] for one in standings)
    return {**means, "average": float(np.mean(list(means.values()))), "worst": worst}


def measure_human(job: RunToMeasure) -> dict[str, Any]:
    """Score of an ego beside a clone of the people whose games are held out; nothing where none were recorded."""
    layout = read_run(job.folder).environment.name.partition("/")[2]
    if layout not in LAYOUTS:
        return {}
    standings = _play_with_strangers(job, {"people": find_proxy(job, layout)})
    return {"score": next(one["mean"] for one in standings if one["partners"] == "people")}


def _play_with_strangers(job: RunToMeasure, partners: Mapping[str, Path]) -> list[dict[str, Any]]:
    """Standings of an ego beside populations, by title, with which it has nothing in common.

    Raises:
        UserError: it has.
    """
    wanted = {"ego": [("ego", str(job.folder))], "partner": [(title, str(path)) for title, path in partners.items()]}
    opened = open_sides(wanted, title_of)
    check_disjoint(opened.sides["ego"], opened.sides["partner"])
    environment = opened.environment

    def make(num_envs: int, seed: int) -> Any:
        return make_env(environment.name, num_envs, seed=seed, **environment.params)

    casting = Casting(opened.sides["ego"], opened.sides["partner"])
    return to_dict(evaluate_holdout(casting, environment, make, job.episodes, SEED))["standings"]


def find_proxy(job: RunToMeasure, layout: str) -> Path:
    """The population of a layout's proxy of half B; fitted where it is not there yet."""
    return fit_missing_population(job.humans, layout, "B", seed=SEED, search=ProxySearch(**job.proxy))


def measure_conventions(job: RunToMeasure) -> dict[str, Any]:
    """How members' dishes go with what they do, pooled as in the paper, and how near they come to recorded people; of
    an ego, how the dishes of simulated people beside it go with what those do."""
    if job.people is not None:
        games = play_study(job.people)
        if not games:
            raise UserError("study", "no game of it was finished", "give its games more time, or simulate more people")
        mean = float(np.mean([game.dish_rate for game in games]))
        return {**_list_effects(games), "games": len(games), "dishes": mean}
    games = count_members(load_population(job.folder / "population"), job.episodes, SEED)
    layout = games[0].layout
    found = _list_effects(games)
    if layout not in LAYOUTS:
        return found
    covered = measure_coverage(count_people(load_games(layouts=[layout])), games, seed=SEED)
    return {**found, "nearest": covered.nearest, "shuffled": covered.shuffled, "average": covered.average}


def _list_effects(games: Sequence[PlayedGame]) -> dict[str, float]:
    """The paper's table: `behaviour group` -> effect."""
    effects = [one for one in tabulate_effects(games, CONVENTION_SPREAD, pooled=True) if "share" not in one.behaviour]
    return {f"{one.behaviour} {one.group}": one.effect for one in effects if math.isfinite(one.effect)}


MEASURES: dict[str, Callable[[RunToMeasure], dict[str, Any]]] = {
    "scores": measure_scores,
    "costs": measure_costs,
    "curves": measure_curves,
    "first": measure_first,
    "held": measure_held,
    "sabotage": measure_exits,
    "diversity": measure_diversity,
    "acting": measure_acting,
    "holdout": measure_ego,
    "human": measure_human,
    "conventions": measure_conventions,
}
"""Name -> measure."""


def round_figures(value: Any) -> Any:
    """Floats to six significant digits, in lists and dictionaries too."""
    if isinstance(value, dict):
        return {name: round_figures(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [round_figures(one) for one in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def describe_seconds(run: RunRecord) -> float | None:
    """Of all members' training, None where one's is unknown."""
    times = [member.seconds for member in run.members]
    return None if None in times else float(sum(time for time in times if time is not None))
