"""Configuration: conf/ and overrides become a plain dictionary. The only file that knows Hydra and OmegaConf."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

from popgen.cli.printing import short
from popgen.errors import UserError

ALIASES = {"seed": "run.seed"}
OPEN_SECTIONS = ("env.params", "cluster.resources")  # dictionaries that take any key


def compose(overrides: Sequence[str]) -> dict[str, Any]:
    """The plain dictionary that conf/ and the overrides give, not yet checked by the schemas.

    Raises:
        UserError: an override that cannot be read, an unknown group option, key or interpolation.
    """
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.config_store import ConfigStore
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from popgen.conf import DIRECTORY
    from popgen.config.run_config import RunConfig

    ConfigStore.instance().store(name="schema", node=RunConfig().model_dump(mode="json"))
    GlobalHydra.instance().clear()
    given = [_translate(override) for override in overrides]
    try:
        with initialize_config_dir(str(DIRECTORY), version_base="1.3"):
            composed = hydra_compose("config", given)
        missing = sorted(OmegaConf.missing_keys(composed))
        values = OmegaConf.to_container(composed, resolve=True)
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # the last for a number as a group's option
        raise _composition_error(error, overrides) from None
    for key in missing or _unset(values):
        raise UserError(key, "has no value", f"give one with {key}=VALUE")
    assert isinstance(values, dict)
    values.pop("per_env", None)  # the table that conf/scale/paper.yaml looks values up in
    return values


def group_options(group: str) -> list[str]:
    """Names that `group=NAME` takes."""
    from popgen.conf import DIRECTORY

    folder = DIRECTORY / group
    return sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml"))


def to_yaml(values: Mapping[str, Any]) -> str:
    """A configuration as YAML."""
    from omegaconf import OmegaConf

    return OmegaConf.to_yaml(OmegaConf.create(values))


def _translate(override: str) -> str:
    """Aliases, and `++` for dictionaries that take any key, so that users need not know Hydra's signs."""
    key, equals, value = override.partition("=")
    if equals and key or override.startswith("~"):
        if key.lstrip("+").startswith("hydra"):
            raise UserError(key, "Hydra's own settings have no use here", "leave it out")
        if key in ALIASES:
            return f"{ALIASES[key]}={value}"
        is_open = key in OPEN_SECTIONS or key.startswith(tuple(f"{name}." for name in OPEN_SECTIONS))
        return f"++{override}" if is_open else override
    raise UserError("overrides", f"cannot read {short(override)!r}", "write KEY=VALUE")


def _unset(values: Any, prefix: str = "") -> list[str]:
    """Keys whose interpolation gave the mark of a missing value."""
    if values == "???":
        return [prefix]
    items = values.items() if isinstance(values, dict) else ()
    return [key for name, item in items for key in _unset(item, f"{prefix}.{name}" if prefix else str(name))]


def _composition_error(error: Exception, overrides: Sequence[str]) -> UserError:
    from hydra.errors import MissingConfigException, OverrideParseException
    from omegaconf.errors import InterpolationKeyError

    from popgen.config.run_config import unknown_field

    text = str(error)
    if isinstance(error, MissingConfigException) and "Could not find" in text:
        group, _, option = text.partition("Could not find '")[2].partition("'")[0].partition("/")
        return _unknown_option(group, option)
    if isinstance(error, OverrideParseException):
        return UserError(
            "overrides", f"cannot read {_culprit(text, overrides)!r}", "write KEY=VALUE, with quotes around odd text"
        )
    if text.startswith("Ambiguous value"):
        fix = "write a list as KEY=[a,b]; several runs need several commands"
        return UserError(
            "overrides", f"{text.partition(chr(10))[0].rpartition(' ')[2].strip(chr(39))!r} has several values", fix
        )
    if text.startswith("Config group override"):  # a number or nothing where a name belongs
        groups = {override.partition("=")[0]: override.partition("=")[2] for override in overrides}
        known = {group: group_options(group) for group in groups}
        return next(_unknown_option(g, option) for g, option in groups.items() if known[g] and option not in known[g])
    if text.startswith("Could not override '"):
        return unknown_field(text.split("'")[1])
    first = text.partition("\n")[0]
    if isinstance(error, InterpolationKeyError):
        return UserError(error.full_key or "overrides", first, "refer to a field that is there")
    return UserError("overrides", first, "see conf/ for what can be set")


def _unknown_option(group: str, option: str) -> UserError:
    options = group_options(group)
    by_leaf = {name.rpartition("/")[2]: name for name in options}
    close = difflib.get_close_matches(option, options, n=1) or [
        by_leaf[leaf] for leaf in difflib.get_close_matches(option.rpartition("/")[2], by_leaf, n=1)
    ]
    listed = f"choose one of {', '.join(options)}" if options else "see conf/"
    return UserError(group, f"there is no option {option!r}", f"did you mean {group}={close[0]}?" if close else listed)


def _culprit(text: str, overrides: Sequence[str]) -> str:
    return next((override for override in overrides if override in text), overrides[0] if len(overrides) == 1 else text)
