"""How different players are by what they do: diversity of event counts, and which of many differ most.

BR-Div is that of ZSC-Eval (Wang et al. 2024), the choice by distance that of HSP (Yu et al. 2023).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

EXHAUSTIVE = 200_000
"""Subsets that are all tried when the most diverse one is looked for; with more of them it is built step by step."""

_TOGETHER = 4096
"""Subsets that are rated in one call."""

_NOISE = 4.0 * float(np.finfo(np.float64).eps)
"""For each row or column, the share of the largest eigenvalue up to which one of 0 may come out by rounding."""

_COLUMN_MARGIN = 1e-3
"""ZSC-Eval's, beside a column's maximum: events that nobody causes have no weight."""


@dataclass(frozen=True)
class Diversity:
    """BR-Div of a set of partners.

    Attributes:
        determinant: of the Gram matrix of normalised event counts; tiny for many near-collinear partners, 0 for
            linearly dependent ones, as they are whenever there are more of them than events that occur.
        log_determinant: its logarithm, -inf for linearly dependent partners.
        effective_rank: exp of the entropy of the Gram matrix's normalised eigenvalues, from 1 to K.
        rank: of the Gram matrix: how many of them are linearly independent, from 0 to K.
    """

    determinant: float
    log_determinant: float
    effective_rank: float
    rank: int


class _Gram(NamedTuple):
    """The Gram matrix of partners, and the share of its largest eigenvalue below which one is rounding noise."""

    matrix: np.ndarray
    noise: float


class _Rating(NamedTuple):
    """How diverse some partners are, to be compared: the rank, then the logarithm of the product of that many largest
    eigenvalues, which at full rank is the determinant."""

    rank: int
    log_product: float


def measure_diversity(events: np.ndarray) -> Diversity:
    """BR-Div of partners by the mean event counts of their best responses (or of themselves).

    Args:
        events: (K, F) mean counts; each column is divided by its maximum (and a margin) before K = Phi Phi^T.
    """
    gram = _compute_gram(events)
    values = np.clip(np.linalg.eigvalsh(gram.matrix), 0.0, None)
    shares = values / values.sum() if values.sum() > 0.0 else np.full(len(values), 1.0 / len(values))
    entropy = -sum(share * math.log(share) for share in shares if share > 0.0)
    (rating,) = _rate_subsets(gram, np.arange(len(values))[None])
    log_determinant = rating.log_product if rating.rank == len(values) else -math.inf
    return Diversity(math.exp(log_determinant), log_determinant, math.exp(entropy), rating.rank)


def choose_most_diverse(events: np.ndarray, count: int) -> list[int]:
    """Rows of the `count` partners whose Gram matrix has the largest determinant, ascending.

    All subsets are tried while there are at most `EXHAUSTIVE` of them; otherwise the set is built one by one and then
    improved by exchanges until none helps. Where so many are linearly dependent (see `Diversity.rank`) no determinant
    tells subsets apart: of those with the largest rank the one is chosen whose eigenvalues above 0 have the largest
    product.

    Raises:
        ValueError: more partners wanted than there are.
    """
    gram = _compute_gram(events)
    size = len(gram.matrix)
    if not 1 <= count <= size:
        raise ValueError(f"count: {count} of {size} partners cannot be chosen")
    if math.comb(size, count) <= EXHAUSTIVE:
        return _try_subsets(gram, count)
    chosen: list[int] = []
    for _ in range(count):
        others = [row for row in range(size) if row not in chosen]
        ratings = _rate_subsets(gram, np.array([[*chosen, row] for row in others]))
        chosen.append(others[ratings.index(max(ratings))])
    return sorted(_exchange_rows(gram, chosen))


def _try_subsets(gram: _Gram, count: int) -> list[int]:
    """The best rated of all; of equals the first."""
    best, chosen = _Rating(-1, 0.0), list[int]()
    for subsets in _list_subsets(len(gram.matrix), count):
        ratings = _rate_subsets(gram, subsets)
        if (highest := max(ratings)) > best:
            best, chosen = highest, subsets[ratings.index(highest)].tolist()
    return chosen


def _list_subsets(size: int, count: int) -> Iterator[np.ndarray]:
    """(N, count) rows of all subsets, some at a time."""
    subsets = itertools.combinations(range(size), count)
    while some := list(itertools.islice(subsets, _TOGETHER)):
        yield np.array(some)


def choose_most_distant(events: np.ndarray, count: int) -> list[int]:
    """Rows of `count` players whose event counts are far from each other, ascending: the one that is farthest from all,
    then again and again the one that is farthest from those chosen (sum of L1 distances).

    Args:
        events: (K, F) mean counts; each column is divided by its maximum (and a margin).

    Raises:
        ValueError: more players wanted than there are.
    """
    distance = measure_distances(events)
    if not 1 <= count <= len(distance):
        raise ValueError(f"count: {count} of {len(distance)} players cannot be chosen")
    chosen = [int(distance.sum(1).argmax())]
    while len(chosen) < count:
        far = distance[chosen].sum(0)
        far[chosen] = -1.0
        chosen.append(int(far.argmax()))
    return sorted(chosen)


def measure_distances(events: np.ndarray) -> np.ndarray:
    """(K, K) L1 distances between two players' event counts (K, F), in which each event's largest count is 1."""
    scaled = _scale_columns(events)
    return np.abs(scaled[:, None] - scaled[None]).sum(-1)


def _exchange_rows(gram: _Gram, chosen: list[int]) -> list[int]:
    """Replace one row by another as long as that raises the determinant."""
    (best,) = _rate_subsets(gram, np.array([chosen]))
    improved = True
    while improved:
        improved = False
        for place, row in itertools.product(range(len(chosen)), range(len(gram.matrix))):
            if row in chosen:
                continue
            changed = [*chosen[:place], row, *chosen[place + 1 :]]
            (rating,) = _rate_subsets(gram, np.array([changed]))
            if rating > _Rating(best.rank, best.log_product + 1e-12):
                chosen, best, improved = changed, rating, True
    return chosen


def _rate_subsets(gram: _Gram, subsets: np.ndarray) -> list[_Rating]:
    """Of (N, count) rows, in their order."""
    parts = gram.matrix[subsets[:, :, None], subsets[:, None, :]]
    values = np.linalg.eigvalsh(parts)
    above = values > gram.noise * values[:, -1:]
    ranks = above.sum(-1)
    logs = np.log(np.where(above, values, 1.0)).sum(-1)
    signs, whole = np.linalg.slogdet(parts)
    logs = np.where((ranks == subsets.shape[1]) & (signs > 0.0), whole, logs)
    return [_Rating(int(rank), float(log)) for rank, log in zip(ranks, logs, strict=True)]


def _compute_gram(events: np.ndarray) -> _Gram:
    scaled = _scale_columns(events)
    return _Gram(scaled @ scaled.T, max(scaled.shape) * _NOISE)


def _scale_columns(events: np.ndarray) -> np.ndarray:
    events = np.asarray(events, np.float64)
    if events.ndim != 2 or not events.size:
        raise ValueError(f"events: expected (partners, kinds), got shape {events.shape}")
    if (events < 0.0).any():
        raise ValueError("events: counts cannot be negative")
    return events / (events.max(axis=0) + _COLUMN_MARGIN)
