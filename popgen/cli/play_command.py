"""`popgen play`: play with a member in the browser, or watch members as a page or as an animation."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from popgen.cli import report_command
from popgen.cli.arguments import add_command, at_least
from popgen.cli.output_places import check_written_file
from popgen.cli.printing import OK, print_json, tell_unfinished
from popgen.cli.training import bound_threads
from popgen.errors import UserError

if TYPE_CHECKING:
    from popgen.population.store import Population


def add(commands: Any) -> None:
    """`play` and, in a file of its own, `report`."""
    report_command.add(commands)
    parser = add_command(
        commands,
        "play",
        play,
        "play with a member in the browser, or watch two of them (--watch)",
        "A partner or player is a member's number, `random` or `idle`. Without further options a local server offers "
        "the game until it is interrupted. With --watch and no file a page is written to RUN-1-2.html in the present "
        "folder. The same seed gives the same game. Keys of --json (with --watch, --html or --gif): players, seed, "
        "score, unit, steps, files.",
    )
    parser.add_argument(
        "population", metavar="POPULATION|EGO", help="folder of a population, or of the run that made it"
    )
    parser.add_argument("--watch", nargs=2, metavar="PLAYER", default=None, help="in seat 0 and seat 1")
    parser.add_argument("--html", metavar="FILE", help="write a page with a time slider, which needs no other file")
    parser.add_argument("--gif", metavar="FILE", help="write an animation")
    parser.add_argument("--steps", type=at_least(1), default=None, help="show no more than the first of them (all)")
    parser.add_argument("--scale", type=at_least(1), default=2, help="size of the animation (%(default)s)")
    parser.add_argument("--seed", type=at_least(0), default=0, help="of the game (%(default)s)")
    parser.add_argument("--partner", metavar="PLAYER", default="1", help="whom to play with (%(default)s)")
    parser.add_argument("--seat", type=int, choices=(0, 1), default=0, help="yours (%(default)s)")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (%(default)s)")
    parser.add_argument("--port", type=at_least(0), default=8010, help="0 takes a free one (%(default)s)")


def play(args: argparse.Namespace) -> int:
    """Serve games, or play one and write it."""
    check_written_file(args.html, "--html", ".html")
    check_written_file(args.gif, "--gif", ".gif")
    bound_threads(1)
    from popgen.population import load_population

    tell_unfinished([args.population])
    population = load_population(args.population)
    if args.watch or args.html or args.gif:
        return _watch_members(args, population)
    from popgen.pages.game_server import GameServer, serve_games

    server = GameServer(population, partner=args.partner, seat=args.seat, seed=args.seed)
    server.prepare()
    try:
        serve_games(server, args.host, args.port, lambda url: print(f"play at {url} (end with Ctrl-C)", flush=True))
    except KeyboardInterrupt:
        print("popgen: the server has ended", file=sys.stderr)
    return OK


def _watch_members(args: argparse.Namespace, population: Population) -> int:
    from popgen.pages.game_recording import record_games
    from popgen.pages.replay_files import name_game, replay_page, to_replay, write_gif

    first, second = args.watch or ("1", "1")
    game = record_games(population, [(first, second)], args.seed)[0]
    game = game if args.steps is None else game.cut(args.steps)
    env, unit = population.make_env(), population.spec.score_name
    title = name_game(game.players, game.score, unit)
    html = args.html or (None if args.gif else f"{_name_place(population.path)}-{first}-{second}.html")
    files = {}
    if html:
        command = f"popgen play {shlex.quote(args.population)} --watch {first} {second} --seed {args.seed}"
        source = f"{population.spec.name}, {population.manifest.method}, seed {population.manifest.seed}: {command}"
        page = replay_page(to_replay([game], env), title=f"{population.spec.name}, {title}", source=source)
        files["html"] = _write_page(Path(html), page)
    if args.gif:
        write_gif(game, env, Path(args.gif), scale=args.scale)
        files["gif"] = args.gif
    if args.json:
        score = {"score": game.score, "unit": unit, "steps": game.steps}
        print_json({"players": game.players, "seed": game.seed, **score, "files": files})
        return OK
    print(f"{title} in {game.steps} steps (seed {args.seed})")
    for suffix, file in files.items():
        print(f"{suffix}: {file}")
    return OK


def _name_place(path: Path) -> str:
    """The run's name where the population lies in one, else the population's own."""
    path = path.resolve()
    return path.parent.name if path.name == "population" else path.name


def _write_page(path: Path, page: str) -> str:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise UserError(str(path), f"cannot be written: {error.strerror}", "choose another place") from error
    return str(path)
