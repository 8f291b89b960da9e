"""How different players are by what they do: diversity of event counts, and which of many differ most.

BR-Div is that of ZSC-Eval (Wang et al. 2024), the choice by distance that of HSP (Yu et al. 2023).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

EXHAUSTIVE = 200_000
"""Subsets that are all tried when the most diverse one is looked for; with more of them it is built step by step."""

_COLUMN_MARGIN = 1e-3
"""ZSC-Eval's, beside a column's maximum: events that nobody causes have no weight."""


@dataclass(frozen=True)
class Diversity:
    """BR-Div of a set of partners.

    Attributes:
        determinant: of the Gram matrix of normalised event counts; tiny for many near-collinear partners.
        log_determinant: its logarithm, -inf for linearly dependent partners.
        effective_rank: exp of the entropy of the Gram matrix's normalised eigenvalues, from 1 to K.
    """

    determinant: float
    log_determinant: float
    effective_rank: float


def measure_diversity(events: np.ndarray) -> Diversity:
    """BR-Div of partners by the mean event counts of their best responses (or of themselves).

    Args:
        events: (K, F) mean counts; each column is divided by its maximum (and a margin) before K = Phi Phi^T.
    """
    gram = _compute_gram(events)
    values = np.clip(np.linalg.eigvalsh(gram), 0.0, None)
    sign, log_determinant = np.linalg.slogdet(gram)
    shares = values / values.sum() if values.sum() > 0.0 else np.full(len(values), 1.0 / len(values))
    entropy = -sum(share * math.log(share) for share in shares if share > 0.0)
    log_determinant = float(log_determinant) if sign > 0.0 else -math.inf
    return Diversity(math.exp(log_determinant), log_determinant, math.exp(entropy))


def choose_most_diverse(events: np.ndarray, count: int) -> list[int]:
    """Rows of the `count` partners whose Gram matrix has the largest determinant, ascending.

    All subsets are tried while there are at most `EXHAUSTIVE` of them; otherwise the set is built one by one and then
    improved by exchanges until none helps.

    Raises:
        ValueError: more partners wanted than there are.
    """
    gram = _compute_gram(events)
    size = len(gram)
    if not 1 <= count <= size:
        raise ValueError(f"count: {count} of {size} partners cannot be chosen")
    if math.comb(size, count) <= EXHAUSTIVE:
        subsets = itertools.combinations(range(size), count)
        return list(max(subsets, key=lambda rows: _log_determinant(gram, rows)))
    chosen: list[int] = []
    for _ in range(count):
        others = [row for row in range(size) if row not in chosen]
        chosen.append(max(others, key=lambda row: _log_determinant(gram, [*chosen, row])))
    return sorted(_exchange_rows(gram, chosen))


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


def _exchange_rows(gram: np.ndarray, chosen: list[int]) -> list[int]:
    """Replace one row by another as long as that raises the determinant."""
    best = _log_determinant(gram, chosen)
    improved = True
    while improved:
        improved = False
        for place, row in itertools.product(range(len(chosen)), range(len(gram))):
            if row in chosen:
                continue
            changed = [*chosen[:place], row, *chosen[place + 1 :]]
            if (value := _log_determinant(gram, changed)) > best + 1e-12:
                chosen, best, improved = changed, value, True
    return chosen


def _compute_gram(events: np.ndarray) -> np.ndarray:
    scaled = _scale_columns(events)
    return scaled @ scaled.T


def _scale_columns(events: np.ndarray) -> np.ndarray:
    events = np.asarray(events, np.float64)
    if events.ndim != 2 or not events.size:
        raise ValueError(f"events: expected (partners, kinds), got shape {events.shape}")
    if (events < 0.0).any():
        raise ValueError("events: counts cannot be negative")
    return events / (events.max(axis=0) + _COLUMN_MARGIN)


def _log_determinant(gram: np.ndarray, rows: list[int] | tuple[int, ...]) -> float:
    sign, value = np.linalg.slogdet(gram[np.ix_(rows, rows)])
    return float(value) if sign > 0.0 else -math.inf
