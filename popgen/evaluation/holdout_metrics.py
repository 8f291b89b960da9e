"""Figures of egos beside hold-out partners, as functions of arrays.

Dimensions: E egos (or seeds of one ego), K partners, P = 2 seats of the ego, N episodes. Scores are in the
environment's own unit (dishes in Overcooked). A mean is a mean over episodes unless its name says otherwise; SD is the
standard deviation over episodes, SE that of the mean.

Sources: BR-Prox, inter-quartile mean and BR-Div from ZSC-Eval (Wang et al. 2024), normalised return and regret from
jax-aht and ROTATE, stratified bootstrap intervals from rliable (Agarwal et al. 2021), whose package cannot be imported
beside pandas 3 (it pins arch 7.2).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from popgen.types import check


@dataclass(frozen=True)
class Spread:
    """Mean, standard deviation over the N samples, standard error of the mean (nan for one sample)."""

    mean: float
    sd: float
    se: float
    count: int


@dataclass(frozen=True)
class Interval:
    """A point estimate with its bootstrap interval, whose ends are NaN where there is none."""

    value: float
    low: float
    high: float


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
        (E, K, P). NaN where the best response scores nothing or less: a ratio to that says nothing. As published it is
        1 there, which the worst ego has too.
    """
    means, best = np.asarray(means, np.float64), np.asarray(best, np.float64)
    check(best, means.shape[1:], "best")
    useful = np.broadcast_to(best > 0.0, means.shape)
    ratio = np.divide(means, best, out=np.full(means.shape, math.nan), where=useful)
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
    """Mean of the middle half of all scores, in any shape.

    The same as `scipy.stats.trim_mean(scores, 0.25, axis=None)` to the bit; that takes 40 times as long, most of a
    bootstrap's time.
    """
    values = np.asarray(scores, np.float64).ravel()
    cut = int(0.25 * values.size)
    return float(np.partition(values, (cut, values.size - cut - 1))[cut : values.size - cut].mean())


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
        scores: (R, T): R independent samples of each of T tasks. They are resampled within each task; see
            `bootstrap_crossed` for samples that belong together from task to task.
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


def bootstrap_crossed(
    values: np.ndarray, groups: Sequence[int], estimate: Callable[[np.ndarray], float], *, repetitions: int = 2000
) -> Interval:
    """An estimate with its 95 % percentile bootstrap interval over runs and over partners, wherever there are several.

    Runs are drawn whole: what one policy scores beside many others is not independent, and drawn anew for each of them
    (`bootstrap_interval`) these scores would give an interval that is far too narrow. Partners are drawn with all their
    seats, within each group (stratified): how many of them are of one population is not by chance. With few runs the
    interval is still too narrow: with three, one in four misses the truth.

    Args:
        values: (R, K, P) of R runs beside K partners in P seats.
        groups: of each of the K partners.
        estimate: values -> figure.
        repetitions: of the bootstrap.

    Returns:
        The figure of all; low and high are NaN where there is one run and no two partners of a group.

    Raises:
        ValueError: there are no values, or they are not of as many partners as `groups`.
    """
    values = np.asarray(values, np.float64)
    if values.ndim != 3 or not values.size:
        raise ValueError(f"values: expected (runs, partners, seats), got shape {values.shape}")
    check(values, (len(values), len(groups), values.shape[2]), "values")
    figure, runs, strata = float(estimate(values)), len(values), list_strata(groups)
    if runs == max(map(len, strata)) == 1:
        return Interval(figure, math.nan, math.nan)
    rng, drawn = np.random.default_rng(0), []
    for _ in range(repetitions):
        columns = draw_within(strata, rng)
        rows = rng.integers(runs, size=runs) if runs > 1 else np.zeros(1, np.int64)
        drawn.append(estimate(values[np.ix_(rows, columns)]))
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Interval(figure, float(low), float(high))


def list_strata(groups: Sequence[int]) -> list[np.ndarray]:
    """Places of each group's members, in the order of the groups."""
    places = np.asarray(groups)
    return [np.flatnonzero(places == group) for group in dict.fromkeys(groups)]


def draw_within(strata: Sequence[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """As many places as there are, drawn with replacement within each stratum."""
    return np.concatenate([own[rng.integers(len(own), size=len(own))] for own in strata])


def bootstrap_gain(
    own: np.ndarray, base: np.ndarray, groups: Sequence[int] | None = None, *, repetitions: int = 2000
) -> Interval:
    """How much larger one mean is than another over the same partners, with its 95 % percentile bootstrap interval.

    Drawn anew are the runs of either, each on its own, and the partners, which both have in common and which are drawn
    whole, with all their seats, within their groups. What there is one of stays as it is.

    Args:
        own, base: (R, K, P) and (S, K, P) mean scores of R and of S runs beside K partners.
        groups: of each of the K partners; without them all are one group.
        repetitions: of the bootstrap.

    Returns:
        Mean of `own` less mean of `base`; low and high are NaN where there is one run of either and one partner of each
        group.

    Raises:
        ValueError: there are no values, or not the same partners.
    """
    own, base = np.asarray(own, np.float64), np.asarray(base, np.float64)
    if own.ndim != 3 or not own.size or not base.size:
        raise ValueError(f"own, base: expected (runs, partners, seats), got shapes {own.shape} and {base.shape}")
    check(base, (len(base), *own.shape[1:]), "base")
    gain, (runs, partners, _), controls = float(own.mean() - base.mean()), own.shape, len(base)
    strata = list_strata([0] * partners if groups is None else groups)
    if runs == controls == max(map(len, strata)) == 1:
        return Interval(gain, math.nan, math.nan)
    own, base = own.mean(-1), base.mean(-1)
    rng, drawn = np.random.default_rng(0), []
    for _ in range(repetitions):
        columns = draw_within(strata, rng)
        rows, others = rng.integers(runs, size=runs), rng.integers(controls, size=controls)
        drawn.append(own[np.ix_(rows, columns)].mean() - base[np.ix_(others, columns)].mean())
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Interval(gain, float(low), float(high))


def _resample(scores: np.ndarray, over_tasks: bool, rng: np.random.Generator) -> np.ndarray:
    """Draw runs with replacement, anew within each task; and before that the tasks, where they are drawn too."""
    runs, tasks = scores.shape
    columns = rng.integers(tasks, size=tasks) if over_tasks else np.arange(tasks)
    rows = rng.integers(runs, size=(runs, tasks))
    return scores[rows, columns]
