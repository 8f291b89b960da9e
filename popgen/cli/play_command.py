"""`popgen play`: watch members play, as a page or as an animation."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from popgen.cli.arguments import add_command, at_least
from popgen.cli.printing import OK, print_json
from popgen.cli.training import bound_threads
from popgen.errors import UserError


def add(commands: Any) -> None:
    """`play`."""
    parser = add_command(
        commands,
        "play",
        play,
        "watch members of a population play",
        "A player is a member's number, `random` or `idle`. Without --html and --gif the game is written to "
        "POPULATION-1-2.html in the present folder. The same seed gives the same game. Keys of --json: players, seed, "
        "score, unit, steps, files.",
    )
    parser.add_argument("population", metavar="POPULATION", help="folder of a population, or of the run that made it")
    parser.add_argument(
        "--watch", nargs=2, metavar=("PLAYER", "PLAYER"), default=None, help="in seat 0 and seat 1 (1 and 1)"
    )
    parser.add_argument("--html", metavar="FILE", help="write a page with a time slider, which needs no other file")
    parser.add_argument("--gif", metavar="FILE", help="write an animation")
    parser.add_argument("--steps", type=at_least(1), default=None, help="show no more than the first of them (all)")
    parser.add_argument("--scale", type=at_least(1), default=2, help="size of the animation (%(default)s)")
    parser.add_argument("--seed", type=at_least(0), default=0, help="of the game (%(default)s)")


def play(args: argparse.Namespace) -> int:
    """Play one game and write it."""
    bound_threads(1)
    from popgen.pages.game_recording import record_games
    from popgen.pages.replay_files import name_game, replay_page, to_replay, write_gif
    from popgen.population import load_population

    population = load_population(args.population)
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
