"""`popgen diversity`: how diverse partners are, and which of them are the most diverse."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from popgen.cli.arguments import add_command, add_response_options, at_least, named_path, share_of_one
from popgen.cli.output_places import check_report_folder
from popgen.cli.printing import OK, print_json, print_report, tell_unfinished
from popgen.cli.training import bound_threads
from popgen.errors import UserError


def add(commands: Any) -> None:
    """`diversity`."""
    parser = add_command(
        commands,
        "diversity",
        measure,
        "BR-Div of partners (determinant, its logarithm, effective rank), the most diverse K, how differently they act",
        "Over the events of the partners in play with themselves (of pairs with their mates), and of their best "
        "responses beside them where all have one (popgen evaluate --best-responses trains them). Then, for each "
        "population, the entropy of its mean policy and the divergence of its members' trajectories. Keys of --json: "
        "those of popgen/reports/diversity_report.py and files.",
    )
    parser.add_argument(
        *("populations",),
        metavar="[NAME=]POPULATION",
        nargs="+",
        type=named_path,
        help="partners, of one environment; PATH:1,3 for some members only",
    )
    parser.add_argument(
        "--choose", type=at_least(1), default=None, metavar="K", help="the most diverse K of them, as --with takes them"
    )
    add_response_options(parser)
    parser.add_argument("--episodes", type=at_least(2), default=20, help="for each partner and seat (%(default)s)")
    parser.add_argument(
        "--kernel", type=share_of_one, default=0.5, help="TrajeDi's: 0 compares actions, 1 episodes (%(default)s)"
    )
    parser.add_argument("--seed", type=at_least(0), default=0, help="(%(default)s)")
    parser.add_argument("--out", default="diversity", metavar="DIR", help="of the report (%(default)s)")


def measure(args: argparse.Namespace) -> int:
    """Play, count and write the report."""
    bound_threads(1)
    from popgen.envs import make_env
    from popgen.evaluation.action_diversity import measure_groups
    from popgen.evaluation.holdout_players import open_sides
    from popgen.evaluation.partner_diversity import measure_partners
    from popgen.pipelines.best_responses import ResponseTraining, find_responses
    from popgen.reports.diversity_report import (
        describe_diversity,
        list_commands,
        list_lines,
        list_sheets,
        write_report,
    )
    from popgen.reports.method_titles import title_of

    tell_unfinished(path for _, path in args.populations)
    opened = open_sides({"partner": args.populations}, title_of)
    groups = opened.sides["partner"]
    players = [player for group in groups for player in group.players]
    if args.choose is not None and args.choose > len(players):
        raise UserError("--choose", f"is {args.choose}, there are {len(players)} partners", "choose fewer")
    check_report_folder(Path(args.out), quiet=args.quiet)
    environment, training = opened.environment, ResponseTraining.of_words(args.response_set)
    found = find_responses(groups, args.responses, training, environment)
    responses = [found[player.identity or ""].player for player in players if (player.identity or "") in found]

    def make(num_envs: int, seed: int) -> Any:
        return make_env(environment.name, num_envs, seed=seed, **environment.params)

    measured = {"members": measure_partners(make, players, None, args.episodes, args.seed, choose=args.choose)}
    if len(responses) == len(players):
        over = measure_partners(make, players, responses, args.episodes, args.seed, choose=args.choose)
        measured["best responses"] = over
    acting = measure_groups(make, groups, args.episodes, args.seed, kernel=args.kernel)
    report = describe_diversity(
        *(environment, args.episodes, args.seed, measured, len(responses)),
        actions=acting,
        kernel=args.kernel,
        training={"scale": training.scale, "settings": training.settings},
    )
    files = write_report(report, args.out)
    if args.json:
        print_json({**report, "files": {name: str(path) for name, path in files.items()}})
        return OK
    print_report(list_sheets(report), list_lines(report), args.out, files, width=80)
    for command in list_commands(report):
        print(f"to hold these out: {command}")
    return OK
