"""Means with their standard errors, and the correction of p-values for their number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Estimate:
    """A mean and its standard error, NaN where one sample (or none) allows no estimate."""

    mean: float
    error: float

    @classmethod
    def of(cls, samples: np.ndarray) -> Estimate:
        """Mean of independent samples (N,); error = s / sqrt(N) with the unbiased s."""
        count = len(samples)
        error = float(np.std(samples, ddof=1)) / math.sqrt(count) if count > 1 else math.nan
        return cls(float(np.mean(samples)) if count else math.nan, error)

    @classmethod
    def average(cls, parts: Sequence[Estimate]) -> Estimate:
        """Mean of independent estimates, with equal weights; error = sqrt(sum of squares) / N."""
        if not parts:
            return cls(math.nan, math.nan)
        error = math.sqrt(sum(part.error**2 for part in parts)) / len(parts)
        return cls(float(np.mean([part.mean for part in parts])), error)

    def to_dict(self) -> dict[str, float | None]:
        """Keys mean and standard_error, as in every JSON report; None where unknown."""
        values = {"mean": self.mean, "standard_error": self.error}
        return {name: float(value) if math.isfinite(value) else None for name, value in values.items()}

    def __str__(self) -> str:
        if not math.isfinite(self.mean):
            return "unknown"
        return f"{self.mean:.2f} ± {self.error:.2f}" if math.isfinite(self.error) else f"{self.mean:.2f}"

    def below(self, other: Estimate) -> bool:
        """Lower than `other` by more than two standard errors of the difference; never where these are unknown."""
        return self.mean < other.mean - 2 * math.hypot(self.error, other.error)

    def chance_below(self, other: Estimate, samples: int) -> float:
        """One-sided p-value of being lower than `other` by Welch's t, both means of so many samples; NaN of one sample.

        It is never less than the share of the best of all ways to deal the 2 N samples out to the two: samples that
        happen to be equal have no spread, and would prove anything.
        """
        from scipy.special import stdtr

        error, difference = math.hypot(self.error, other.error), self.mean - other.mean
        if samples < 2 or not math.isfinite(error) or not math.isfinite(difference):
            return math.nan
        least = 1 / math.comb(2 * samples, samples)
        if error == 0.0:
            return least if difference < 0.0 else 1.0
        degrees = (samples - 1) / ((self.error / error) ** 4 + (other.error / error) ** 4)
        return max(least, float(stdtr(degrees, difference / error)))

    def divide(self, other: Estimate) -> Estimate:
        """Ratio of two independent estimates, error by the delta method; NaN where `other` is not above 0."""
        if not other.mean > 0.0:
            return Estimate(math.nan, math.nan)
        ratio = self.mean / other.mean
        return Estimate(ratio, math.hypot(self.error, ratio * other.error) / other.mean)


def measure_half_interval(samples: Sequence[float] | np.ndarray) -> float:
    """Half of the 95 % interval of the mean of independent samples (N,), by Student's t, which takes them as normal.

    NaN for fewer than two. A percentile bootstrap of so few, between their extremes, would hold the mean of two half
    of the time and that of three three times in four.
    """
    from scipy.special import stdtrit

    count = len(samples)
    if count < 2:
        return math.nan
    return float(stdtrit(count - 1, 0.975)) * float(np.std(samples, ddof=1)) / math.sqrt(count)


def adjust_by_holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down adjusted p-values, in the given order; NaN stays and counts in the number of tests.

    Rejecting where the adjusted value is at most alpha keeps the chance of any false rejection at alpha.
    """
    adjusted = [math.nan] * len(p_values)
    known = [n for n, value in enumerate(p_values) if math.isfinite(value)]
    highest = 0.0
    for rank, n in enumerate(sorted(known, key=lambda n: p_values[n])):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[n]))
        adjusted[n] = highest
    return adjusted
