"""Titles and looks of methods on tables and charts, by the registry of methods."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class _Interim:
    name: str
    title: str
    colour: str
    marker: str


METHODS = {
    m.name: m
    for m in (
        _Interim("xpm_wm", "XPM-WM", "#0072B2", "o"),
        _Interim("xpm_sim", "XPM-Sim", "#009E73", "D"),
        _Interim("lipo", "LIPO", "#E69F00", "s"),
        _Interim("comedi", "CoMeDi", "#CC79A7", "^"),
        _Interim("mappo", "MAPPO", "#D55E00", "v"),
    )
}


def title_of(label: str) -> str:
    """A method's title; other labels stay as they are."""
    return METHODS[label].title if label in METHODS else label


def name_of(title: str) -> str:
    """The method with this title; a title that no method has stays as it is."""
    return next((name for name, method in METHODS.items() if method.title == title), title)
