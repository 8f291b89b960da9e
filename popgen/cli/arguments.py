"""The parser's class, what every command has, and the types of arguments."""

from __future__ import annotations

import argparse
import difflib
import math
import os
import re
import shlex
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NoReturn

from popgen.errors import UserError


class Parser(argparse.ArgumentParser):
    """Mistakes are the user's errors."""

    def error(self, message: str) -> NoReturn:
        """Raises: UserError."""
        choice = re.fullmatch(r"argument (COMMAND|WHAT|WHICH): invalid choice: '(.*?)' \(choose from (.*)\)", message)
        if choice is None:
            raise UserError("arguments", message, f"see {self.prog} --help")
        found = suggest_word(choice[2], re.findall(r"[\w-]+", choice[3]))
        fix = f"did you mean {self.prog} {found}?" if found else f"see {self.prog} --help"
        raise UserError("arguments", f"there is no command '{self.prog} {choice[2]}'", fix)


def add_command(
    commands: Any, name: str, command: Callable[[argparse.Namespace], int], summary: str, details: str
) -> argparse.ArgumentParser:
    """A command with the options that all have.

    Args:
        commands: of `add_subparsers`.
        name: of the command.
        command: gets the parsed arguments and returns the exit code.
        summary: in a line, without a capital or a full stop.
        details: of its help, below the options.
    """
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=summary, description=f"{summary[0].upper()}{summary[1:]}.", epilog=details
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.set_defaults(command=command)
    return parser


def suggest_word(word: str, known: Iterable[str]) -> str | None:
    """The one of `known` that `word` was meant to be."""
    return next(iter(difflib.get_close_matches(word, list(known), n=1)), None)


def list_words(parser: argparse.ArgumentParser, words: Sequence[str]) -> tuple[str, set[str]]:
    """The command that the first words name, as it is called, and its options."""
    for word in words:
        kinds = next((action for action in parser._actions if isinstance(action, argparse._SubParsersAction)), None)
        if kinds is None or word not in kinds.choices:
            break
        parser = kinds.choices[word]
    return parser.prog, {option for action in parser._actions for option in action.option_strings}


def at_least(minimum: int) -> Callable[[str], int]:
    """A whole number from `minimum` to 2^31 - 1."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"must be a whole number, got {text!r}") from None
        if not minimum <= value < 2**31:
            raise argparse.ArgumentTypeError(f"must be at least {minimum} and below 2^31, got {value}")
        return value

    return read


def positive(text: str) -> float:
    """A finite number above 0."""
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number above 0, got {text!r}")
    return value


def finite(text: str) -> float:
    """A finite number."""
    value = _number(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be a number, got {text!r}")
    return value


def share_of_one(text: str) -> float:
    """A number from 0 to 1."""
    value = _number(text)
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"must be from 0 to 1, got {text!r}")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def numbers(text: str) -> list[int]:
    """1,2,..."""
    return [at_least(1)(part) for part in text.split(",")]


def words(text: str) -> list[str]:
    """One word or more, as a shell would split them."""
    try:
        found = shlex.split(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"cannot read {text!r} ({error})") from None
    if not found:
        raise argparse.ArgumentTypeError("names no settings: write KEY=VALUE, such as seed=1")
    return found


def named_path(text: str) -> tuple[str | None, str]:
    """NAME=PATH, or a path alone; a name holds no slash."""
    name, equals, _ = text.partition("=")
    if not equals or "/" in name:
        return None, expand_home(text)
    return label_and_path(text)


def label_and_path(text: str) -> tuple[str, str]:
    """NAME=PATH."""
    name, _, path = text.partition("=")
    if not name or not path or "/" in name or len(name) > 40:
        raise argparse.ArgumentTypeError(f"must be NAME=PATH with a short name without slashes, got {text!r}")
    return name, expand_home(path)


def expand_home(text: str) -> str:
    """A path, or an address that holds one, with `~` replaced as a shell would do where a path begins with it.

    Raises:
        UserError: there is no such home.
    """

    def expand(found: re.Match[str]) -> str:
        home = os.path.expanduser(found[2])
        if home.startswith("~"):
            raise UserError("arguments", f"{found[2]!r} in {text!r} names no home folder", "write the path out")
        return found[1] + home

    return re.sub(r"(^|/)(~[\w.-]*)(?=/|$)", expand, text)


def pair(text: str) -> tuple[str, Any]:
    """KEY=VALUE, the value as YAML reads it."""
    import yaml

    key, equals, value = text.partition("=")
    if not key or not equals:
        raise argparse.ArgumentTypeError(f"must be KEY=VALUE, got {text!r}")
    try:
        return key, yaml.safe_load(value)
    except yaml.YAMLError:
        raise argparse.ArgumentTypeError(f"cannot read the value of {text!r}") from None


def add_config_dir(parser: argparse.ArgumentParser) -> None:
    """`--config-dir`, of every command that composes a configuration."""
    parser.add_argument(
        "--config-dir",
        default=None,
        metavar="DIR",
        help="your own presets, such as DIR/scale/NAME.yaml or DIR/env/NAME.yaml",
    )


def add_response_options(parser: argparse.ArgumentParser) -> None:
    """Where best responses lie, and how they are trained."""
    parser.add_argument("--responses", metavar="DIR", help="of best responses (best_responses beside each population)")
    parser.add_argument(
        *("--response-set",),
        nargs="+",
        action="extend",
        type=pair,
        default=[],
        metavar="KEY=VALUE",
        help="settings of their training, such as scale=demo",
    )
