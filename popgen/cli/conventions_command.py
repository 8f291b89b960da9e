"""`popgen conventions`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from popgen.cli.arguments import add_command, at_least, named_path, positive
from popgen.cli.output_places import check_report_folder
from popgen.cli.printing import OK, print_json, print_report, tell_unfinished
from popgen.cli.training import bound_threads

PEOPLE = "people"


def add(commands: Any) -> None:
    """`conventions`."""
    parser = add_command(
        commands,
        "conventions",
        analyse,
        "how dishes go with what players do, and how much of it a population covers",
        "People are those whose games overcooked-ai installs, or those of --records, each ego's apart. "
        "A player in a game is in the high (low) group of a "
        "behaviour if its rate lies so many standard deviations above (below) the mean of its layout and seat; the "
        "last column pools layouts and seats as the paper does. Members play with themselves, those of pairs with "
        "their mates. Keys of --json: players (label, games, within, pooled, coverage), files.",
    )
    parser.add_argument("populations", nargs="*", type=named_path, metavar="[NAME=]POPULATION", help="beside people")
    parser.add_argument("--layout", action="append", metavar="NAME", help="of people; may be repeated; all by default")
    parser.add_argument(
        "--records",
        action="append",
        type=Path,
        metavar="FILE",
        help="recorded games of people, as popgen study export writes them; instead of overcooked-ai's",
    )
    parser.add_argument("--threshold", type=positive, default=0.5, help="standard deviations (%(default)s)")
    parser.add_argument("--episodes", type=at_least(1), default=10, help="of each member (%(default)s)")
    parser.add_argument("--seed", type=at_least(0), default=0, help="of populations' games (%(default)s)")
    parser.add_argument("--out", default="conventions", metavar="DIR", help="of the report (%(default)s)")


def analyse(args: argparse.Namespace) -> int:
    """Count, compare, write and print."""
    bound_threads(1)
    from popgen.population import load_population
    from popgen.reports.conventions_report import (
        coverage_table,
        effects_table,
        paper_table,
        to_sentences,
        write_conventions,
    )

    check_report_folder(Path(args.out), quiet=args.quiet)
    tell_unfinished(path for _, path in args.populations)
    populations = [(name or path, load_population(path)) for name, path in args.populations]
    reports = _report_players(args, populations)
    files = write_conventions(reports, Path(args.out))
    if args.json:
        print_json({"players": [report.as_dict() for report in reports], "files": [str(file) for file in files]})
        return OK
    tables = [effects_table(report) for report in reports]
    covered = coverage_table(reports)
    tables += [paper_table(), *([] if covered is None else [covered])]
    print_report(tables, to_sentences(reports), args.out, [file.name for file in files], width=80)
    return OK


def _report_players(args: argparse.Namespace, populations: list[tuple[str, Any]]) -> list[Any]:
    """People first, then each population."""
    from popgen.evaluation.convention_coverage import measure_coverage
    from popgen.evaluation.convention_effects import tabulate_effects
    from popgen.evaluation.played_games import count_members, count_people
    from popgen.humans.recordings import load_games
    from popgen.reports.conventions_report import PlayersReport

    recorded = _count_records(args.records, args.layout) if args.records else None
    people = [one for games in (recorded or {}).values() for one in games]
    people = people or count_people(load_games(layouts=args.layout))

    def report(label: str, games: list[Any], coverage: dict[str, Any]) -> PlayersReport:
        within = tabulate_effects(games, args.threshold)
        return PlayersReport(label, len(games), within, tabulate_effects(games, args.threshold, pooled=True), coverage)

    reports = [report(label, games, {}) for label, games in (recorded or {PEOPLE: people}).items()]
    for label, population in populations:
        games = count_members(population, args.episodes, args.seed)
        layout = games[0].layout
        same = [game for game in people if game.layout == layout]
        covered = {layout: measure_coverage(same, games, seed=args.seed)} if same else {}
        reports.append(report(label, games, covered))
    return reports


def _count_records(files: list[Path], layouts: list[str] | None) -> dict[str, list[Any]]:
    """Label -> games of people in these files; the tutorial's are left out."""
    from popgen.errors import UserError
    from popgen.evaluation.played_games import count_table_games
    from popgen.humans.record_tables import read_table_games

    found: dict[str, list[Any]] = {}
    for file in files:
        games = [game for game in read_table_games(file) if layouts is None or game.layout in layouts]
        for label, played in count_table_games(games).items():
            if label != "people with tutorial":
                found.setdefault(label, []).extend(played)
    if not found:
        raise UserError("--records", "hold no games of people in these layouts", "give other files or layouts")
    return dict(sorted(found.items()))
