"""Titles and looks of methods on tables and charts, by the registry of methods."""

from __future__ import annotations

from popgen.methods.registry import METHODS

__all__ = ["METHODS", "name_of", "title_of"]


def title_of(label: str) -> str:
    """A method's title; other labels stay as they are."""
    return METHODS[label].title if label in METHODS else label


def name_of(title: str) -> str:
    """The method with this title; a title that no method has stays as it is."""
    return next((name for name, method in METHODS.items() if method.title == title), title)
