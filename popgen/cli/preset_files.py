"""A user's presets (`--config-dir`) as files: each is read once by itself, before Hydra composes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from popgen.errors import UserError

if TYPE_CHECKING:
    from yaml import MarkedYAMLError

_PRESET_FORM = "write lines such as `agent: {entropy: 0.03}`, below # @package _global_"


def find_preset_folder(path: str) -> Path:
    """A user's folder of groups.

    Raises:
        UserError: there is none.
    """
    folder = Path(path).absolute()
    if not folder.is_dir():
        raise UserError("--config-dir", f"{path} is no folder", "give one with groups such as scale/NAME.yaml")
    return folder


def check_presets(words: Sequence[str], folder: Path | None) -> None:
    """The files that a user has written for the groups in these words are read once by themselves.

    Raises:
        UserError: one cannot be read, is no YAML, or holds something else than settings.
    """
    import yaml

    given = (word.lstrip("+").partition("=") for word in words)
    files = [] if folder is None else [folder / key / f"{option}.yaml" for key, _, option in given]
    for file in (file for file in files if file.is_file()):
        try:
            values = yaml.safe_load(file.read_text(encoding="utf-8"))
        except yaml.MarkedYAMLError as error:
            raise describe_yaml_error(error, str(file)) from None
        except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
            reason = str(error).partition("\n")[0] or type(error).__name__
            raise UserError("--config-dir", f"{file} cannot be read ({reason})", _PRESET_FORM) from None
        if values is not None and not isinstance(values, dict):
            raise UserError("--config-dir", f"{file} holds no settings", _PRESET_FORM)


def describe_yaml_error(error: MarkedYAMLError, file: str | None = None) -> UserError:
    """Of a preset; one that another preset stands on is known by the error alone."""
    place = error.problem_mark or error.context_mark
    line = "" if place is None else f"line {place.line + 1}: "
    named = file or getattr(place, "name", "a preset")
    return UserError("--config-dir", f"{named} is no YAML ({line}{error.problem})", _PRESET_FORM)
