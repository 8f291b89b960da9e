"""Diversity of event counts and the choice of the most different players, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from popgen.play import event_diversity
from popgen.play.event_diversity import choose_most_distant, choose_most_diverse, measure_distances, measure_diversity


def test_br_div_of_orthogonal_and_of_equal_partners() -> None:
    orthogonal = measure_diversity(np.eye(3) * 5)
    scale = 5 / (5 + 1e-3)
    assert orthogonal.determinant == pytest.approx(scale**6) and orthogonal.effective_rank == pytest.approx(3.0)
    equal = measure_diversity(np.array([[1.0, 2.0], [1.0, 2.0]]))
    assert equal.determinant == pytest.approx(0.0, abs=1e-12) and equal.effective_rank == pytest.approx(1.0)


def test_the_effective_rank_of_two_eigenvalues() -> None:
    """Columns 1 and 0.5: the Gram matrix of rows (1, 1) and (1, 0) has trace 3 and determinant 1, margins aside."""
    diversity = measure_diversity(np.array([[1e6, 1e6], [1e6, 0.0]]))
    values = np.array([(3 + math.sqrt(5)) / 2, (3 - math.sqrt(5)) / 2]) / 3
    assert diversity.determinant == pytest.approx(1.0, rel=1e-6)
    assert diversity.effective_rank == pytest.approx(math.exp(-(values * np.log(values)).sum()), rel=1e-6)


def test_dependent_partners_have_no_determinant_by_rounding_either() -> None:
    """Seven partners and four events that occur: the eigenvalues of three directions are rounding noise, whose product
    with the others would be a number like any."""
    rng = np.random.default_rng(5)
    events = np.zeros((7, 17))
    events[:, [1, 4, 9, 12]] = rng.integers(1, 400, size=(7, 4)) / 40
    found = measure_diversity(events)
    assert (found.rank, found.determinant, found.log_determinant) == (4, 0.0, -math.inf)
    assert 1.0 <= found.effective_rank <= 4.0
    four = measure_diversity(events[:4])
    assert four.rank == 4 and four.log_determinant == pytest.approx(np.linalg.slogdet(compute_gram(events[:4]))[1])
    assert measure_diversity(np.zeros((3, 2))).rank == 0


def test_near_collinear_partners_that_differ_keep_their_determinant() -> None:
    """Rows (1, 1) and (1, 1 - 1e-5): the determinant is 1e-10, five orders above what counts as rounding."""
    found = measure_diversity(np.array([[1e6, 1e6], [1e6, 1e6 - 10]]))
    assert found.rank == 2 and found.determinant == pytest.approx(1e-10, rel=1e-4)


def compute_gram(events: np.ndarray) -> np.ndarray:
    scaled = events / (events.max(0) + 1e-3)
    return scaled @ scaled.T


@pytest.mark.parametrize("limit", [10**9, 0])
def test_of_more_than_are_independent_those_of_the_largest_volume_are_chosen(
    monkeypatch: pytest.MonkeyPatch, limit: int
) -> None:
    """Three of rank two. Rows (1, 0), (.9, .1), (0, 1), (1, 0) again: by Cauchy and Binet the product of the two
    eigenvalues of three rows is the sum of the squares of their three determinants: of rows 1, 3, 4 it is 0 + 1 + 1, of
    2, 3, 4 .81 + 1 + .01, of 1, 2, 3 the same and of 1, 2, 4 .02."""
    monkeypatch.setattr(event_diversity, "EXHAUSTIVE", limit)
    events = 1e6 * np.array([[1.0, 0.0], [0.9, 0.1], [0.0, 1.0], [1.0, 0.0]])
    assert choose_most_diverse(events, 3) == [0, 2, 3]
    assert choose_most_diverse(np.zeros((4, 3)), 2) == [0, 1]


@pytest.mark.parametrize("limit", [10**9, 0])
def test_the_most_diverse_are_found_with_and_without_trying_all(monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    events = np.abs(np.random.default_rng(3).normal(size=(9, 6)))
    events[4] = events[2] * 1.001  # a near copy must not be chosen beside its model
    everything = choose_most_diverse(events, 4)
    monkeypatch.setattr(event_diversity, "EXHAUSTIVE", limit)
    chosen = choose_most_diverse(events, 4)
    assert chosen == everything == sorted(chosen) and not {2, 4} <= set(chosen)


def test_the_most_distant_are_those_with_the_largest_sum_of_distances() -> None:
    """Columns' maxima are 10 and 4: rows (0, 0), (1, 0), (.9, 0), (0, 1), (.5, .5). The first chosen is farthest from
    all (sums 3.9, 4.1, 3.9, 4.9, 3.9 up to margins), the next ones farthest from those chosen."""
    events = np.array([[0.0, 0.0], [10.0, 0.0], [9.0, 0.0], [0.0, 4.0], [5.0, 2.0]])
    assert choose_most_distant(events, 1) == [3]
    assert choose_most_distant(events, 2) == [1, 3]
    assert choose_most_distant(events, 3) == [1, 2, 3]
    assert choose_most_distant(events, 5) == [0, 1, 2, 3, 4]


def test_distances_are_of_counts_in_which_the_largest_is_1() -> None:
    """Of (0, 0), (1, 0), (1, 1)."""
    found = measure_distances(np.array([[0.0, 0.0], [2e6, 0.0], [2e6, 3e6]]))
    np.testing.assert_allclose(found, [[0, 1, 2], [1, 0, 1], [2, 1, 0]], rtol=1e-6)


def test_what_cannot_be_is_refused() -> None:
    for call in (
        lambda: measure_diversity(np.array([[-1.0]])),
        lambda: choose_most_diverse(np.eye(3), 4),
        lambda: choose_most_distant(np.eye(3), 4),
        lambda: measure_distances(np.zeros((2, 0))),
    ):
        with pytest.raises(ValueError):
            call()
