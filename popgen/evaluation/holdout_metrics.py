"""Figures of egos beside hold-out partners, as functions of arrays.

Dimensions: E egos (or seeds of one ego), K partners, P = 2 seats of the ego, N episodes. Scores are in the
environment's own unit (dishes in Overcooked). A mean is a mean over episodes unless its name says otherwise; SD is the
standard deviation over episodes, SE that of the mean.

Sources: BR-Prox, inter-quartile mean and BR-Div from ZSC-Eval (Wang et al. 2024), normalised return and regret from
jax-aht and ROTATE, stratified bootstrap intervals from rliable (Agarwal et al. 2021), whose package cannot be imported
beside pandas 3 (it pins arch 7.2).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from popgen.types import check

EXHAUSTIVE = 200_000
"""Subsets that are all tried when the most diverse one is looked for; with more of them it is built step by step."""

_COLUMN_MARGIN = 1e-3
"""ZSC-Eval's, beside a column's maximum: events that nobody causes have no weight."""


@dataclass(frozen=True)
class Spread:
    """Mean, standard deviation over the N samples, standard error of the mean (nan for one sample)."""

    mean: float
    sd: float
    se: float
    count: int


@dataclass(frozen=True)
class Interval:
    """A point estimate with its bootstrap interval."""

    value: float
    low: float
    high: float


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


def describe_spread(samples: np.ndarray) -> Spread:
    """Mean, SD and SE of samples of any shape."""
    values = np.asarray(samples, np.float64).ravel()
    if not values.size:
        raise ValueError("samples: there are none")
    sd = float(values.std(ddof=1)) if values.size > 1 else math.nan
    return Spread(float(values.mean()), sd, sd / math.sqrt(values.size), values.size)


def measure_br_proximity(means: np.ndarray, best: np.ndarray, *, clip: bool = True) -> np.ndarray:
    """BR-Prox: an ego's mean score beside a partner over that of the partner's best response.

    Args:
        means: (E, K, P) mean scores.
        best: (K, P) mean scores of each partner's best response, in the same seats.
        clip: bound by 1, as published, which hides egos better than a poor best response.

    Returns:
        (E, K, P). Where the best response scores nothing or less, 1 as published (nan unclipped: it says nothing).
    """
    means, best = np.asarray(means, np.float64), np.asarray(best, np.float64)
    check(best, means.shape[1:], "best")
    useful = np.broadcast_to(best > 0.0, means.shape)
    ratio = np.divide(means, best, out=np.full(means.shape, 1.0 if clip else math.nan), where=useful)
    return np.minimum(ratio, 1.0) if clip else ratio


def normalise_returns(means: np.ndarray, low: np.ndarray | float, high: np.ndarray) -> np.ndarray:
    """(R - low) / (high - low): 0 is `low` (often 0), 1 the best known response; bounds (K, P) or scalars."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    if (high <= low).any():
        raise ValueError("high: must be above low for every partner and seat")
    return (np.asarray(means, np.float64) - low) / (high - low)


def measure_regret(means: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Best response's mean score less the ego's, (E, K, P): what cooperation with this partner is missed."""
    means, best = np.asarray(means, np.float64), np.asarray(best, np.float64)
    check(best, means.shape[1:], "best")
    return best - means


def find_worst(means: np.ndarray) -> np.ndarray:
    """(E,) the lowest mean score over partners and seats of (E, K, P)."""
    return np.asarray(means, np.float64).min(axis=(1, 2))


def measure_cvar(values: np.ndarray, share: float = 0.2) -> float:
    """Mean of the lowest `share` of the values, at least one; the last one counts by the part that belongs to it."""
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share: must be above 0 and at most 1, got {share}")
    ordered = np.sort(np.asarray(values, np.float64).ravel())
    if not ordered.size:
        raise ValueError("values: there are none")
    wanted = max(1.0, share * ordered.size)
    weights = np.clip(wanted - np.arange(ordered.size), 0.0, 1.0)
    return float(weights @ ordered / wanted)


def interquartile_mean(scores: np.ndarray) -> float:
    """Mean of the middle half of all scores, in any shape."""
    from scipy.stats import trim_mean

    return float(trim_mean(np.asarray(scores, np.float64).ravel(), proportiontocut=0.25))


def bootstrap_interval(
    scores: np.ndarray,
    estimate: Callable[[np.ndarray], float] = interquartile_mean,
    *,
    over_tasks: bool = False,
    repetitions: int = 2000,
    level: float = 0.95,
    seed: int = 0,
) -> Interval:
    """An estimate over (runs, tasks) with its stratified percentile bootstrap interval.

    Args:
        scores: (R, T): R seeds of an ego, T pairs of partner and seat. Runs are resampled within each task.
        estimate: scores -> figure.
        over_tasks: resample the tasks too, for a statement about other partners; the only choice with one run.
        repetitions, level, seed: of the bootstrap.

    Raises:
        ValueError: not two-dimensional, or one run without `over_tasks`, whose interval would have no width.
    """
    scores = np.asarray(scores, np.float64)
    if scores.ndim != 2 or not scores.size:
        raise ValueError(f"scores: expected (runs, tasks), got shape {scores.shape}")
    if len(scores) == 1 and not over_tasks:
        raise ValueError("scores: one run alone has no interval over runs; resample the tasks with over_tasks=True")
    rng = np.random.default_rng(seed)
    estimates = [estimate(_resample(scores, over_tasks, rng)) for _ in range(repetitions)]
    low, high = np.quantile(estimates, [(1.0 - level) / 2.0, (1.0 + level) / 2.0])
    return Interval(float(estimate(scores)), float(low), float(high))


def _resample(scores: np.ndarray, over_tasks: bool, rng: np.random.Generator) -> np.ndarray:
    """Draw runs with replacement, anew within each task; and before that the tasks, where they are drawn too."""
    runs, tasks = scores.shape
    columns = rng.integers(tasks, size=tasks) if over_tasks else np.arange(tasks)
    rows = rng.integers(runs, size=(runs, tasks))
    return scores[rows, columns]


def measure_diversity(events: np.ndarray) -> Diversity:
    """BR-Div of partners by the mean event counts of their best responses (or of themselves).

    Args:
        events: (K, F) mean counts; each column is divided by its maximum (and a margin) before K = Phi Phi^T.
    """
    gram = _gram(events)
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
    gram = _gram(events)
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


def _gram(events: np.ndarray) -> np.ndarray:
    events = np.asarray(events, np.float64)
    if events.ndim != 2 or not events.size:
        raise ValueError(f"events: expected (partners, kinds), got shape {events.shape}")
    if (events < 0.0).any():
        raise ValueError("events: counts cannot be negative")
    scaled = events / (events.max(axis=0) + _COLUMN_MARGIN)
    return scaled @ scaled.T


def _log_determinant(gram: np.ndarray, rows: list[int] | tuple[int, ...]) -> float:
    sign, value = np.linalg.slogdet(gram[np.ix_(rows, rows)])
    return float(value) if sign > 0.0 else -math.inf
