"""Titles and looks of methods on tables and charts, by the registry of methods."""

from __future__ import annotations

from popgen.methods.registry import METHODS, list_working

__all__ = ["METHODS", "name_of", "title_of"]


def title_of(label: str) -> str:
    """A method's title, with the name of the objective where there is one; other labels stay as they are."""
    method, _, objective = label.partition(":")
    if method not in METHODS or (objective and objective not in METHODS[method].objectives):
        return label
    return f"{METHODS[method].title}, {objective}" if objective else METHODS[method].title


def name_of(title: str) -> str:
    """The method with this title; a title that no method has stays as it is."""
    return next((name for name, method in list_working() if method.title == title), title)
