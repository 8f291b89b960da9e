"""Schedules of the objective's weights: pure functions of how much has been done."""

from __future__ import annotations


def linear(start: float, end: float, done: int | float, length: int | float) -> float:
    """From `start` to `end`, even over `length` steps of which `done` are over; `end` at once where `length` is 0."""
    return start + (end - start) * min(1.0, done / length) if length else end


def geometric(start: float, end: float, done: int | float, length: int | float) -> float:
    """From `start` to `end` by the same factor in every step; even where `end` is 0, which no factor reaches."""
    share = min(1.0, done / length)
    return start * (end / start) ** share if end else start * (1.0 - share)


def annealed(start: float, end_share: float, progress: int | float) -> float:
    """From `start` to `end_share` of it, even over the budget of which the share `progress` is used up."""
    left = 1.0 - min(1.0, max(0.0, progress))
    return start * (end_share + (1.0 - end_share) * left)
