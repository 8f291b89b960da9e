"""A recipe: settings that belong together, complete for every layout, with the reasons for those that need one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Setting:
    """A value and why it is what it is.

    Attributes:
        reason: a sentence, or where to read on; "" where the field's description says enough.
        ours: the paper is silent or can be read in more than one way: the choice is ours.
    """

    value: Any
    reason: str = ""
    ours: bool = False


@dataclass(frozen=True)
class SourcedSetting:
    """A setting of a recipe, and which part of the recipe it comes from."""

    setting: Setting
    source: str


Settings = Mapping[str, Any]
"""Dotted field -> a value, or a `Setting` where there is something to say about it."""


def ours(value: Any, reason: str = "") -> Setting:
    """A value that the paper does not give."""
    return Setting(value, reason, ours=True)


def because(value: Any, reason: str) -> Setting:
    """A value with its reason."""
    return Setting(value, reason)


@dataclass(frozen=True)
class Recipe:
    """Settings on top of the schema's defaults; a layout's row goes on top of these, for whoever asks.

    Attributes:
        name: value of the setting `scale`.
        summary: what it is for.
        settings: for all environments.
        by_layout: environment's name -> what differs there.
        base: recipe that this one changes; its row of the layout applies too, before this recipe's settings.
    """

    name: str
    summary: str
    settings: Settings = field(default_factory=dict)
    by_layout: Mapping[str, Settings] = field(default_factory=dict)
    base: Recipe | None = None

    def list_settings(self, layout: str) -> dict[str, SourcedSetting]:
        """Everything that the recipe sets on a layout, by dotted field."""
        listed = {} if self.base is None else self.base.list_settings(layout)
        row = self.by_layout.get(layout, {})
        for source, settings in ((f"recipe {self.name}", self.settings), (f"layout row of {self.name}", row)):
            for name, value in settings.items():
                listed[name] = SourcedSetting(value if isinstance(value, Setting) else Setting(value), source)
        return listed

    def values(self, layout: str) -> dict[str, Any]:
        """The same as a nested dictionary of plain values."""
        nested: dict[str, Any] = {}
        for name, sourced in self.list_settings(layout).items():
            section, _, last = name.rpartition(".")
            (nested.setdefault(section, {}) if section else nested)[last] = sourced.setting.value
        return nested
