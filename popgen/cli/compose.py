"""Configuration: conf/ and overrides become a plain dictionary. The only file that knows Hydra and OmegaConf."""

from __future__ import annotations

import difflib
import json
import math
import pickle
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from popgen.cli.arguments import expand_home
from popgen.cli.preset_files import check_presets, describe_yaml_error, find_preset_folder
from popgen.cli.printing import short
from popgen.errors import UserError
from popgen.methods.recipe import SourcedSetting

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override
    from omegaconf import DictConfig

    from popgen.config.run_config import RunConfig

ALIASES = {"seed": "run.seed"}
OPEN_SECTIONS = ("env.params", "cluster.resources", "discovery.event_factors", "discovery.scaffolds")
"""Dictionaries that take any key."""


QUOTES = "'\""
CUSTOM_LAYOUT = "env=overcooked/custom"
SEVERAL_RUNS = "popgen sweep makes several runs"

CHOICES = ("method", "scale", "env")
"""Groups that decide which schema and which recipe the other settings stand on."""

_GROUP_CHOICE = rf"({'|'.join((*CHOICES, 'cluster', 'tracking'))})=[\w/.-]+"

_COMPOSED: dict[str, bytes] = {}
"""What this process has composed of conf/ and groups, by all that it depends on; pickled, which copies it fastest."""


@dataclass(frozen=True)
class SweepAxis:
    """A setting that a sweep varies.

    Attributes:
        key: dotted, or a group.
        values: as words of the command line; none where the setting is drawn from [low, high].
        is_log: drawn evenly by its logarithm.
        is_integer: whole numbers.
    """

    key: str
    values: tuple[str, ...] = ()
    low: float = 0.0
    high: float = 0.0
    is_log: bool = False
    is_integer: bool = False

    def draw_value(self, rng: Any) -> str:
        """A value from the range, by a numpy generator."""
        if self.is_integer and not self.is_log:
            return str(int(rng.integers(int(self.low), int(self.high) + 1)))
        ends = (math.log(self.low), math.log(self.high)) if self.is_log else (self.low, self.high)
        drawn = float(rng.uniform(*ends))
        value = math.exp(drawn) if self.is_log else drawn
        return str(round(value)) if self.is_integer else f"{value:.4g}"


@dataclass(frozen=True)
class PresetValue:
    """What a preset file gives a field, and the option that names the file."""

    value: Any
    option: str


@dataclass(frozen=True)
class Composed:
    """A configuration and where it comes from.

    Attributes:
        values: the plain dictionary, not yet checked by the schemas.
        recipe: what the recipe sets, by dotted field.
        overrides: of the command line, as Hydra reads them.
        schema: of the method.
        config_dir: a user's folder of groups.
    """

    values: dict[str, Any]
    recipe: dict[str, SourcedSetting]
    overrides: tuple[str, ...]
    schema: type[RunConfig]
    config_dir: Path | None

    @property
    def overridden(self) -> tuple[str, ...]:
        """Dotted fields that the command line sets."""
        return tuple(override.lstrip("+").partition("=")[0] for override in self.overrides)

    @cached_property
    def presets(self) -> dict[str, PresetValue]:
        """Dotted fields that a preset file sets -> the file's value and its name, such as env=overcooked/mine."""
        return _list_presets(self.overrides, self.config_dir)


def compose(overrides: Sequence[str], config_dir: str | None = None) -> dict[str, Any]:
    """The plain dictionary of `compose_sources`."""
    return compose_sources(overrides, config_dir).values


def compose_sources(overrides: Sequence[str], config_dir: str | None = None) -> Composed:
    """What the method's schema, the recipe, conf/ (and `config_dir`, a folder of the same form) and overrides give.

    Raises:
        UserError: an override that cannot be read, an unknown group option, key or interpolation.
    """
    from popgen.config.run_config import schema_of, unknown_field
    from popgen.methods.registry import DEFAULT_RECIPE, METHODS

    folder = None if config_dir is None else find_preset_folder(config_dir)
    check_presets(overrides, folder)
    translated = choose_custom_layout([_translate(override) for override in overrides])
    chosen = _choose_groups(translated, overrides, folder)
    schema = schema_of(chosen)
    recipes = METHODS[chosen["method"]].recipes
    if "scale" not in chosen:
        raise UserError("scale", "the preset does not say what it stands on", "add a line such as scale: laptop")
    if not isinstance(chosen["scale"], str):
        raise UserError("scale", "the preset sets a section `scale`", "begin its file with: # @package _global_")
    if (name := chosen["scale"]) not in recipes and name not in _list_own_scales(folder):
        raise UserError("scale", f"{chosen['method']} has no recipe {name!r}", f"choose one of {', '.join(recipes)}")
    recipe = recipes.get(name, recipes[DEFAULT_RECIPE])
    base = _merge(schema.model_validate({}).as_dict(), recipe.values(chosen["env"]["name"]))
    values = _compose(base, translated, overrides, folder, lambda key: unknown_field(key, schema))
    return Composed(values, recipe.list_settings(chosen["env"]["name"]), tuple(translated), schema, folder)


def _list_own_scales(folder: Path | None) -> set[str]:
    """Presets of a user's folder that no file of conf/ has the name of."""
    return set(group_options("scale", folder)) - set(group_options("scale"))


def choose_custom_layout(words: Sequence[str]) -> list[str]:
    """Overrides in which a layout's file that stands alone is one of `env=overcooked/custom`: what the default layout
    sets, such as its cooking, is not asked of the file."""
    from popgen.config.run_config import LAYOUT_FILE

    given = {key.lstrip("+"): value.strip(QUOTES) for key, _, value in (word.partition("=") for word in words)}
    is_alone = "env" not in given and given.get("env.name", "").endswith(LAYOUT_FILE)
    return [CUSTOM_LAYOUT, *words] if is_alone else list(words)


def parse_axis(override: str) -> SweepAxis | None:
    """The axis that an override with several values or a range means; None for one with a single value.

    Raises:
        UserError: it cannot be read, or a range is empty or has no logarithm.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import IntervalSweep
    from hydra.errors import HydraException

    word = _translate(override)
    try:
        parsed = OverridesParser.create().parse_override(word)
        if not parsed.is_sweep_override():
            return None
        sweep, key = parsed.value(), word.lstrip("+").partition("=")[0]
        if not isinstance(sweep, IntervalSweep):
            return SweepAxis(key, tuple(parsed.sweep_string_iterator()))
    except (HydraException, ValueError, OverflowError):
        raise UserError("overrides", f"cannot read {short(override)!r}", "write KEY=a,b or KEY=interval(a,b)") from None
    low, high = float(sweep.start or 0.0), float(sweep.end or 0.0)
    whole = isinstance(sweep.start, int) and isinstance(sweep.end, int) and "int(" in word
    if not low < high or ("log" in sweep.tags and low <= 0.0):
        raise UserError(key, f"[{low:g}, {high:g}] is no range to draw from", "give an ascending, positive one")
    return SweepAxis(key, low=low, high=high, is_log="log" in sweep.tags, is_integer=whole)


def choose_method(overrides: Sequence[str], config_dir: str | None = None) -> str:
    """The method that overrides, or a preset that they name, choose.

    Raises:
        UserError: an override that cannot be read, an unknown option.
    """
    folder = None if config_dir is None else find_preset_folder(config_dir)
    check_presets(overrides, folder)
    return str(_choose_groups([_translate(override) for override in overrides], overrides, folder)["method"])


def _list_presets(translated: Sequence[str], folder: Path | None) -> dict[str, PresetValue]:
    """What the chosen files of conf/ and of a user's folder set, the last one winning as in Hydra's defaults list."""
    from omegaconf import OmegaConf

    from popgen.conf import DIRECTORY

    chosen = {}
    for entry in OmegaConf.load(DIRECTORY / "config.yaml").defaults:
        chosen |= dict(entry) if OmegaConf.is_dict(entry) else {}
    given = (word.partition("=") for word in translated)
    chosen |= {key.lstrip("+"): option for key, _, option in given if group_options(key.lstrip("+"), folder)}
    found: dict[str, PresetValue] = {}
    for group, option in chosen.items():
        found |= {"env.name": PresetValue(option, f"env={option}")} if group == "env" else {}
        paths = [root / group / f"{option}.yaml" for root in (DIRECTORY, *([folder] if folder else []))]
        for path in (path for path in paths if path.is_file()):
            values = OmegaConf.to_container(OmegaConf.load(path), resolve=False) or {}
            is_global = "@package _global_" in path.read_text(encoding="utf-8").partition("\n")[0]
            prefix = "" if is_global else f"{group.replace('/', '.')}."
            found |= {key: PresetValue(value, f"{group}={option}") for key, value in _flatten(values, prefix)}
    return found


def _flatten(values: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of nested dictionaries."""
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def compose_record(record: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """The configuration that a run recorded, with overrides of fields; the run gets a name of its own.

    `cluster=NAME` and `tracking=NAME` take what conf/ says in place of what was recorded.

    Raises:
        UserError: an override that cannot be read, or one that asks for another recipe.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import OmegaConf

    from popgen.conf import DIRECTORY

    config = OmegaConf.create({**record, "run": {**record.get("run", {}), "id": None}})
    for override in overrides:
        word = _translate(override).lstrip("+")
        key = word.partition("=")[0]
        if key in CHOICES:
            raise UserError(key, "is that of the record", f"leave it out, or start without --from {key}=...")
        try:
            parsed = OverridesParser.create().parse_override(word)
            if parsed.is_delete() or parsed.is_sweep_override():
                raise UserError("overrides", f"cannot read {short(override)!r}", "write KEY=VALUE")
            if (value := parsed.value()) in group_options(key):
                config[key] = OmegaConf.load(DIRECTORY / key / f"{value}.yaml")
            else:
                OmegaConf.update(config, key, value)
        except (HydraException, ValueError) as error:
            first = str(error).partition("\n")[0]
            raise UserError("overrides", f"cannot read {short(override)!r} ({first})", "write KEY=VALUE") from None
    values = OmegaConf.to_container(config, resolve=True)
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def _choose_groups(translated: list[str], overrides: Sequence[str], folder: Path | None) -> dict[str, Any]:
    """Method, scale and environment, which the rest stands on."""
    keys = {word: word.lstrip("+").partition("=")[0] for word in translated}
    first = [word for word, key in keys.items() if key in CHOICES or key.startswith("env.")]
    base: dict[str, Any] = {"env": {"name": None, "params": {}}}
    return _compose(base, first, overrides, folder, lambda key: UserError(key, "there is no such field"), loose=True)


def _compose(
    base: dict[str, Any],
    translated: list[str],
    overrides: Sequence[str],
    folder: Path | None,
    unknown: Callable[[str], UserError],
    *,
    loose: bool = False,
) -> dict[str, Any]:
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import MarkedYAMLError

    try:
        groups, fields = _split_fields(translated)
        config = _compose_groups(base, groups, folder)
        ConfigLoaderImpl._apply_overrides_to_config(fields, config)
        values = OmegaConf.to_container(config, resolve=not loose)
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # the last for a number as a group's option
        raise _composition_error(error, overrides, folder, unknown) from None
    except MarkedYAMLError as error:
        raise describe_yaml_error(error) from None
    assert isinstance(values, dict)
    for key in [] if loose else sorted(_unset(values)):
        raise UserError(key, "has no value", f"give one with {key}=VALUE")
    return {str(key): value for key, value in values.items()}


def _split_fields(translated: list[str]) -> tuple[list[str], list[Override]]:
    """Words that Hydra composes by, and those that only set a field of what it composes: KEY.KEY=VALUE."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parsed = OverridesParser.create().parse_overrides(translated)
    groups: list[str] = []
    fields: list[Override] = []
    for word, one in zip(translated, parsed, strict=True):
        if one.is_delete() or one.is_sweep_override() or not re.fullmatch(r"\w+(\.\w+)+", one.key_or_group):
            groups.append(word)
        else:
            fields.append(one)
    return groups, fields


def _compose_groups(base: dict[str, Any], words: list[str], folder: Path | None) -> DictConfig:
    """What Hydra composes of the schema and the groups that are chosen. It takes a tenth of a second, so that what came
    of conf/ alone is kept: the runs of a sweep differ in fields, and their methods in what lies beneath the groups."""
    from omegaconf import DictConfig, OmegaConf

    installed = _installed_options()
    name = json.dumps([base, words, {group: sorted(options) for group, options in installed.items()}])
    if folder is None and name in _COMPOSED:
        return pickle.loads(_COMPOSED[name])
    if base and folder is None and all(re.fullmatch(_GROUP_CHOICE, word) for word in words):
        config = OmegaConf.merge(base, _compose_groups({}, words, None))
        assert isinstance(config, DictConfig)
        OmegaConf.set_struct(config, True)
    else:
        config = _run_hydra(base, words, folder, installed)
    if folder is None:
        _COMPOSED[name] = pickle.dumps(config)
    return config


def _run_hydra(
    base: dict[str, Any], words: list[str], folder: Path | None, installed: dict[str, set[str]]
) -> DictConfig:
    """Hydra's defaults list: the schema, then a file of each group."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    from popgen.conf import DIRECTORY

    _store_groups(base, installed, folder)
    GlobalHydra.instance().clear()
    search = [] if folder is None else [f"hydra.searchpath=[{json.dumps(folder.as_uri())}]"]
    with initialize_config_dir(str(DIRECTORY), version_base="1.3"):
        return hydra_compose("config", [*search, *words])


def _store_groups(base: dict[str, Any], installed: dict[str, set[str]], folder: Path | None) -> None:
    """What Hydra composes from beside files: the schema with its recipe, and groups of what others have installed."""
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    store.store(name="schema", node=base)
    for group, options in installed.items():
        for option in options - _file_options(group, folder):
            inner, _, name = f"{group}/{option}".rpartition("/")
            if group == "env":
                store.store(group=inner, name=name, node={"name": option, "params": {}}, package="env")
            else:
                store.store(group=inner, name=name, node={group: option}, package="_global_")


def _installed_options() -> dict[str, set[str]]:
    """Methods, their recipes, and environments; those of a package that cannot be imported are left out until they are
    asked for."""
    from popgen.envs.env_registry import env_names
    from popgen.methods.registry import METHODS

    scales: set[str] = set()
    for name in METHODS:
        with suppress(UserError):
            scales |= METHODS[name].recipes.keys()
    return {"method": set(METHODS), "scale": scales, "env": set(env_names())}


def group_options(group: str, config_dir: Path | None = None) -> list[str]:
    """Names that `group=NAME` takes: files in conf/ and in a user's folder, and what is installed."""
    return sorted(_file_options(group, config_dir) | _installed_options().get(group, set()))


def _file_options(group: str, config_dir: Path | None) -> set[str]:
    from popgen.conf import DIRECTORY

    folders = [DIRECTORY / group, *([] if config_dir is None else [config_dir / group])]
    return {
        path.relative_to(folder).with_suffix("").as_posix() for folder in folders for path in folder.rglob("*.yaml")
    }


def _merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with nested `changes`."""
    merged = dict(base)
    for name, value in changes.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(name), Mapping)
        merged[name] = _merge(merged[name], value) if both else value
    return merged


def to_yaml(values: Mapping[str, Any]) -> str:
    """A configuration as YAML."""
    from omegaconf import OmegaConf

    return OmegaConf.to_yaml(OmegaConf.create(dict(values)))


def _translate(override: str) -> str:
    """Aliases, and `++` for dictionaries that take any key, so that users need not know Hydra's signs."""
    key, equals, value = override.partition("=")
    if equals and key or override.startswith("~"):
        if key.lstrip("+").startswith("hydra"):
            raise UserError(key, "Hydra's own settings have no use here", "leave it out")
        if key in ALIASES:
            return f"{ALIASES[key]}={value}"
        if re.search(r"(^|[/'\"])~", value):  # a sign of Hydra's, but never meant so in a value
            override = f"{key}={_quote_text(expand_home(value.strip(QUOTES)))}"
        is_open = key in OPEN_SECTIONS or key.startswith(tuple(f"{name}." for name in OPEN_SECTIONS))
        return f"++{override}" if is_open else override
    raise UserError("overrides", f"cannot read {short(override)!r}", "write KEY=VALUE")


def _quote_text(text: str) -> str:
    """A value that Hydra takes as it is."""
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def _unset(values: Any, prefix: str = "") -> list[str]:
    """Keys with OmegaConf's mark of a missing value, also where an interpolation gave it."""
    if values == "???":
        return [prefix]
    items = values.items() if isinstance(values, dict) else ()
    return [key for name, item in items for key in _unset(item, f"{prefix}.{name}" if prefix else str(name))]


def _composition_error(
    error: Exception, overrides: Sequence[str], folder: Path | None, unknown: Callable[[str], UserError]
) -> UserError:
    from hydra.errors import MissingConfigException, OverrideParseException
    from omegaconf.errors import InterpolationKeyError

    text = str(error)
    if isinstance(error, MissingConfigException) and "Could not find" in text:
        group, _, option = text.partition("Could not find '")[2].partition("'")[0].partition("/")
        return _unknown_option(group, option, folder)
    if isinstance(error, OverrideParseException):
        return UserError(
            "overrides", f"cannot read {_culprit(text, overrides)!r}", "write KEY=VALUE, with quotes around odd text"
        )
    if (sweep := re.search(r"(?<![\w.])([\w.]+)=\w+\(.*--multirun|Sweep parameters '([\w.]+)", text)) is not None:
        fix = f"give one; {SEVERAL_RUNS}"
        return UserError(sweep[1] or sweep[2], "asks for several values", fix)
    if text.startswith("Ambiguous value"):
        fix = f"write a list as KEY=[a,b]; {SEVERAL_RUNS}"
        return UserError(
            "overrides", f"{text.partition(chr(10))[0].rpartition(' ')[2].strip(chr(39))!r} has several values", fix
        )
    if text.startswith("Config group override"):  # a number or nothing where a name belongs
        groups = {override.partition("=")[0]: override.partition("=")[2] for override in overrides}
        options = {group: group_options(group, folder) for group in groups}
        wrong = (g for g, option in groups.items() if options[g] and option not in options[g])
        return next(_unknown_option(group, groups[group], folder) for group in wrong)
    if text.startswith("Could not override '"):
        return unknown(text.split("'")[1])
    first = text.partition("\n")[0]
    if isinstance(error, InterpolationKeyError):
        return UserError(error.full_key or "overrides", first, "refer to a field that is there")
    return UserError("overrides", first, "see conf/ for what can be set")


def _unknown_option(group: str, option: str, folder: Path | None) -> UserError:
    options = group_options(group, folder)
    by_leaf = {name.rpartition("/")[2]: name for name in options}
    close = difflib.get_close_matches(option, options, n=1) or [
        by_leaf[leaf] for leaf in difflib.get_close_matches(option.rpartition("/")[2], by_leaf, n=1)
    ]
    listed = f"choose one of {', '.join(options)}" if options else "see conf/"
    return UserError(group, f"there is no option {option!r}", f"did you mean {group}={close[0]}?" if close else listed)


def _culprit(text: str, overrides: Sequence[str]) -> str:
    return next((override for override in overrides if override in text), overrides[0] if len(overrides) == 1 else text)
