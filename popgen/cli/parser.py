"""The whole command line: arguments in, a namespace with the command to call out."""

from __future__ import annotations

import argparse
import sys
from functools import cache

import popgen
from popgen.cli import bench_commands as bench
from popgen.cli import compare_command as comparison
from popgen.cli import config_command as configuration
from popgen.cli import conventions_command as conventions
from popgen.cli import diversity_command as diversity
from popgen.cli import ego_commands as ego
from popgen.cli import evaluate_command as evaluation
from popgen.cli import experiment_commands as experiments
from popgen.cli import humans_commands as humans
from popgen.cli import play_command as play
from popgen.cli import population_commands as population
from popgen.cli import reproduce_command as reproduction
from popgen.cli import run_command as run
from popgen.cli import study_commands as study
from popgen.cli import sweep_command as sweep
from popgen.cli.arguments import Parser, expand_home, list_words, suggest_word
from popgen.cli.compose import SEVERAL_RUNS
from popgen.cli.printing import ERROR
from popgen.errors import UserError

HYDRAS_MANY = ("--multirun", "-m")
"""What other programs on Hydra take for several runs."""


def parse(argv: list[str]) -> argparse.Namespace:
    """The arguments; `command` is the function to call with them.

    Raises:
        UserError: arguments that are wrong.
        SystemExit: there was nothing but a help text or the version to print.
    """
    parser = _parser()
    args, rest = parser.parse_known_args([_expand_word(word) for word in argv])
    if hasattr(args, "overrides"):  # overrides may stand after options too
        args.overrides = [*args.overrides, *(word for word in rest if not word.startswith("-"))]
        rest = [word for word in rest if word.startswith("-")]
    if rest:
        command, options = list_words(parser, argv)
        meant = suggest_word(rest[0].partition("=")[0], options)
        fix = f"did you mean {meant}?" if meant else f"see {command} --help"
        fix = SEVERAL_RUNS if rest[0] in HYDRAS_MANY else fix
        raise UserError("arguments", f"unknown argument {rest[0]}", fix)
    if args.command is None:
        parser.print_help(sys.stderr)
        raise SystemExit(ERROR)
    return args


def _expand_word(word: str) -> str:
    """`~/path` and `--option=~/path`; settings (`KEY=VALUE`) have rules of their own."""
    option, equals, value = word.partition("=")
    if option.startswith("--") and equals:
        return f"{option}={expand_home(value)}"
    return expand_home(word) if "=" not in word else word


@cache
def _parser() -> argparse.ArgumentParser:
    """Built once in a process: it takes 20 milliseconds."""
    parser = Parser(
        prog="popgen",
        description="Populations of diverse cooperative partner agents.",
        epilog="Methods, recipes and environments: popgen config --list.",
    )
    parser.add_argument("--version", action="version", version=f"popgen {popgen.__version__}")
    parser.set_defaults(command=None)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", parser_class=Parser)
    for subject in (
        *(run, sweep, configuration, evaluation, diversity, population, ego, play, comparison),
        *(experiments, reproduction, humans, conventions, study, bench),
    ):
        subject.add(commands)
    return parser
