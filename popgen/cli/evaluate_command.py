"""`popgen evaluate`: the SP/XP matrix of a population, or egos beside hold-out partners."""

from __future__ import annotations

import argparse
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from popgen.cli.arguments import add_command, add_response_options, at_least, named_path, numbers, pair
from popgen.cli.output_places import check_report_folder
from popgen.cli.printing import OK, print_json, print_report, tell_unfinished
from popgen.cli.training import bound_threads
from popgen.errors import UserError

if TYPE_CHECKING:
    from popgen.evaluation.holdout import Casting
    from popgen.population.manifest import EnvironmentInfo
    from popgen.progress import Reporter

MATRIX_EPISODES, HOLDOUT_EPISODES = 20, 40
"""Defaults: for each ordered pair of members; for each ego, partner and seat."""

_MATRIX_ONLY = ("members", "env", "param")
_HOLDOUT_ONLY = ("human", "met", "control", "best_responses", "response_set", "responses")
_NAMED = "[NAME=]POPULATION"


def add(commands: Any) -> None:
    """`evaluate`."""
    parser = add_command(
        commands,
        "evaluate",
        evaluate,
        "SP/XP matrix of a population, or egos beside hold-out partners (--with)",
        "Of members that were trained in pairs SP is play with the mate and XP across pairs. "
        "Keys of --json: files, and those of popgen/reports/crossplay_report.py (sp, xp, matrix, beside, obstruction, "
        "pairs, ...) or, with --with, of popgen/reports/holdout_report.py (standings, controls, margins, pairs, ...).",
    )
    _add_players(parser)
    parser.add_argument("--control", metavar="NAME", help="an ego over which the others' margins are told")
    parser.add_argument(
        "--best-responses", action="store_true", help="train the best responses that are missing to all partners first"
    )
    add_response_options(parser)
    told = f"per ordered pair ({MATRIX_EPISODES}), or per ego, partner and seat ({HOLDOUT_EPISODES})"
    parser.add_argument("--episodes", type=at_least(1), default=None, help=told)
    parser.add_argument("--seed", type=at_least(0), default=0, help="of the evaluation (%(default)s)")
    parser.add_argument("--members", type=numbers, default=None, metavar="1,2,...", help="all by default")
    parser.add_argument("--out", metavar="DIR", help="of the report (POPULATION/evaluation, with --with: holdout)")
    parser.add_argument("--env", metavar="NAME", help="refuse a population that was trained in another environment")
    parser.add_argument(
        "--param", type=pair, action="append", default=[], metavar="KEY=VALUE", help="the same for a parameter of it"
    )


def _add_players(parser: argparse.ArgumentParser) -> None:
    """Who is evaluated, and beside whom."""
    parser.add_argument(
        *("populations",),
        metavar=_NAMED,
        nargs="+",
        type=named_path,
        help="population or its run, PATH:1,3 for some members; with --with also module:Agent, and one NAME for "
        "several seeds of an ego",
    )
    partners = "hold-out partners: populations, PATH:1,3 for some members only, or agents as module:Agent"
    for option, name, told in (
        ("--with", "partners", partners),
        ("--human", "human", "human proxies as partners"),
        ("--met", "met", "populations that taught the egos: rows of their own, in no average"),
    ):
        parser.add_argument(option, dest=name, metavar=_NAMED, nargs="+", action="extend", type=named_path, help=told)


def evaluate(args: argparse.Namespace) -> int:
    """Play, and write the report."""
    bound_threads(1)
    together = args.partners or args.human or args.met
    for name in _MATRIX_ONLY if together else _HOLDOUT_ONLY:
        if getattr(args, name):
            without = "without" if together else "with"
            option = f"--{name.replace('_', '-')}"
            raise UserError(option, f"is of an evaluation {without} --with", "leave it out")
    if args.response_set and not args.best_responses:
        raise UserError("--response-set", "is of best responses, and none are trained", "add --best-responses")
    tell_unfinished(
        path for name in ("populations", "partners", "human", "met") for _, path in getattr(args, name) or []
    )
    if together:
        return _evaluate_egos(args)
    if len(args.populations) > 1:
        raise UserError("arguments", "give one population, or hold-out partners by --with", "see popgen evaluate -h")
    return _evaluate_matrix(args, args.populations[0][1])


def _evaluate_matrix(args: argparse.Namespace, path: str) -> int:
    from popgen.population import check_compatible, load_population
    from popgen.population.chosen_members import split_members
    from popgen.progress import make_reporter

    path, chosen = split_members(path)
    if chosen and args.members:
        raise UserError("--members", f"are named by {path}:... too", "leave one of them out")
    population = load_population(path)
    if args.env or args.param:
        from popgen.envs import make_env

        info = population.env_info
        name = args.env or info.name
        params = {**(info.params if name == info.name else {}), **dict(args.param)}
        check_compatible(population, make_env(name, 1, **params).spec)
    out = Path(args.out) if args.out else population.path / "evaluation"
    check_report_folder(out, quiet=args.quiet)
    from popgen.evaluation.crossplay import evaluate_population
    from popgen.reports.crossplay_report import matrix_sheet, mixed_play_sheet, summary, to_dict, write_report

    with closing(make_reporter(quiet=args.quiet)) as reporter:
        reporter.phase("evaluation", 1)
        result = evaluate_population(
            population,
            args.episodes or MATRIX_EPISODES,
            args.seed,
            list(chosen) or args.members,
            progress=lambda done, total: reporter.update(done / total, episodes=done),
        )
    files, report = write_report(result, out), to_dict(result)
    if args.json:
        print_json({**report, "files": {suffix: str(path) for suffix, path in files.items()}})
        return OK
    sheets = [matrix_sheet(report, narrow=True), mixed_play_sheet(report)]
    print_report(
        (sheet for sheet in sheets if sheet is not None),
        summary(report),
        str(out),
        [path.name for path in files.values()],
    )
    return OK


def _evaluate_egos(args: argparse.Namespace) -> int:
    from popgen.envs import make_env
    from popgen.evaluation.holdout import evaluate_holdout
    from popgen.progress import make_reporter
    from popgen.reports.holdout_report import to_dict, write_report
    from popgen.reports.holdout_tables import list_lines, to_sheets

    casting, environment = _cast_players(args)
    out = Path(args.out or "holdout")
    check_report_folder(out, 64 * 2**20, quiet=args.quiet)
    with closing(make_reporter(quiet=args.quiet)) as reporter:
        casting = _train_responses(casting, environment, args, reporter)
        reporter.phase("evaluation", 1)
        result = evaluate_holdout(
            casting,
            environment,
            lambda num_envs, seed: make_env(environment.name, num_envs, seed=seed, **environment.params),
            args.episodes or HOLDOUT_EPISODES,
            args.seed,
            progress=lambda done, total: reporter.update(done / total, episodes=done),
        )
    report = to_dict(result, args.control)
    files = write_report(report, out)
    if args.json:
        print_json({**report, "files": {suffix: str(path) for suffix, path in files.items()}})
        return OK
    print_report(to_sheets(report), list_lines(report), str(out), [path.name for path in files.values()], width=80)
    return OK


def _train_responses(
    casting: Casting, environment: EnvironmentInfo, args: argparse.Namespace, reporter: Reporter
) -> Casting:
    """The same players with the best responses to the partners, trained first where that is asked for."""
    from popgen.pipelines.best_responses import ResponseTraining, count_others, find_responses, train_responses

    training = ResponseTraining.of_words(args.response_set)
    where = (casting.partners, args.responses, training, environment)
    if args.best_responses:
        train_responses(*where, reporter)
    responses = find_responses(*where)
    if not responses and (others := count_others(*where)):
        told = f"{others} best responses lie there that were trained with other settings, and are not taken"
        reporter.note(f"{told}: name these settings (--best-responses --response-set KEY=VALUE)")
    return replace(casting, responses=responses)


def _cast_players(args: argparse.Namespace) -> tuple[Casting, EnvironmentInfo]:
    """Egos and partners with nothing in common, in one environment."""
    from popgen.evaluation.holdout import Casting
    from popgen.evaluation.holdout_overlap import check_disjoint, check_met
    from popgen.evaluation.holdout_players import open_sides
    from popgen.reports.method_titles import title_of

    wanted = {"ego": args.populations, "partner": args.partners or [], "human": args.human or [], "met": args.met or []}
    opened = open_sides(wanted, title_of)
    humans = opened.sides["human"]
    partners, met = (*opened.sides["partner"], *humans), opened.sides["met"]
    check_disjoint(opened.sides["ego"], partners)
    check_met(opened.sides["ego"], met)
    if args.control and args.control not in {group.label for group in opened.sides["ego"]}:
        raise UserError("--control", f"there is no ego {args.control}", "name it as NAME=POPULATION")
    named, taught = (frozenset(group.label for group in groups) for groups in (humans, met))
    return Casting(opened.sides["ego"], (*partners, *met), humans=named, met=taught), opened.environment
