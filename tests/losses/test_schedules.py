"""Schedules by hand."""

from __future__ import annotations

import pytest

from popgen.losses.policy_losses import annealed, geometric, linear_schedule


def test_linear_rises_and_stays() -> None:
    assert [linear_schedule(1.0, 3.0, done, 4) for done in (0, 1, 2, 4, 9)] == [1.0, 1.5, 2.0, 3.0, 3.0]
    assert linear_schedule(1.0, 3.0, 0, 0) == 3.0  # no ramp


def test_geometric_falls_by_the_same_factor() -> None:
    assert [geometric(8.0, 1.0, done, 3) for done in (0, 1, 2, 3, 7)] == pytest.approx([8.0, 4.0, 2.0, 1.0, 1.0])
    assert [geometric(8.0, 0.0, done, 2) for done in (0, 1, 2)] == [8.0, 4.0, 0.0]  # to 0 evenly


def test_annealing_goes_over_the_budget_and_no_further() -> None:
    assert [annealed(2.0, 0.5, progress) for progress in (-1.0, 0.0, 0.5, 1.0, 2.0)] == [2.0, 2.0, 1.5, 1.0, 1.0]
