"""Hold-out figures against numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from popgen.evaluation.holdout_metrics import (
    bootstrap_interval,
    bootstrap_units,
    describe_spread,
    interquartile_mean,
    measure_br_proximity,
    measure_cvar,
    measure_regret,
    normalise_returns,
)

MEANS = np.array([[[2.0, 4.0], [9.0, 0.0]]])  # one ego, two partners, two seats
BEST = np.array([[4.0, 8.0], [6.0, 0.0]])


def test_mean_sd_and_se_have_their_names() -> None:
    spread = describe_spread(np.array([[1.0, 2.0], [3.0, 6.0]]))  # deviations -2 -1 0 3: 14 / 3
    assert (spread.mean, spread.count) == (3.0, 4)
    assert spread.sd == pytest.approx(math.sqrt(14 / 3)) and spread.se == pytest.approx(math.sqrt(14 / 3) / 2)
    assert math.isnan(describe_spread(np.array([5.0])).se)


def test_br_prox_clipped_and_not() -> None:
    assert measure_br_proximity(MEANS, BEST).tolist() == [[[0.5, 0.5], [1.0, 1.0]]]
    unclipped = measure_br_proximity(MEANS, BEST, clip=False)
    assert unclipped[0, 1, 0] == 1.5 and math.isnan(unclipped[0, 1, 1])


def test_regret_and_normalised_return() -> None:
    assert measure_regret(MEANS, BEST).tolist() == [[[2.0, 4.0], [-3.0, 0.0]]]
    assert normalise_returns(MEANS, 1.0, np.array([[5.0, 5.0], [5.0, 5.0]])).tolist() == [[[0.25, 0.75], [2.0, -0.25]]]
    with pytest.raises(ValueError, match="above low"):
        normalise_returns(MEANS, 0.0, BEST)


@pytest.mark.parametrize(
    ("share", "value"), [(0.25, 1.0), (0.5, 1.5), (1.0, 2.5), (0.1, 1.0), (0.375, (1 + 0.5 * 2) / 1.5)]
)
def test_cvar_is_the_mean_of_the_lowest_share(share: float, value: float) -> None:
    assert measure_cvar(np.array([4.0, 2.0, 1.0, 3.0]), share) == pytest.approx(value)


def test_the_interquartile_mean_leaves_a_quarter_out_at_each_end() -> None:
    assert interquartile_mean(np.array([[100.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, -100.0]])) == 3.5  # 2 3 4 5


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 8, 33])
def test_the_interquartile_mean_is_scipys(count: int) -> None:
    from scipy.stats import trim_mean  # here, as every worker imports this file, and this takes a second

    scores = np.random.default_rng(count).normal(size=(3, count)).round(1)
    assert interquartile_mean(scores) == trim_mean(scores, 0.25, axis=None)


def test_the_interval_holds_the_estimate_and_is_seeded() -> None:
    scores = np.random.default_rng(0).normal(5.0, 1.0, (5, 12))
    first, again = bootstrap_interval(scores, seed=1), bootstrap_interval(scores, seed=1)
    assert first == again and first.low < first.value < first.high
    wider = bootstrap_interval(np.concatenate([scores - 3, scores + 3]), seed=1)
    assert wider.high - wider.low > first.high - first.low
    assert bootstrap_interval(np.full((3, 4), 2.0)).low == 2.0 == bootstrap_interval(np.full((3, 4), 2.0)).high


def test_runs_are_resampled_within_tasks() -> None:
    """Tasks differ widely, runs not at all: without resampling tasks there is no spread."""
    scores = np.tile(np.arange(8.0) * 10, (4, 1))
    fixed = bootstrap_interval(scores, lambda sample: float(sample.mean()))
    assert (fixed.low, fixed.value, fixed.high) == (35.0, 35.0, 35.0)
    free = bootstrap_interval(scores, lambda sample: float(sample.mean()), over_tasks=True)
    assert free.low < 30 and free.high > 40


def test_units_are_drawn_with_all_that_they_have() -> None:
    """Two seeds, one 4 better beside each of 50 partners: half of all draws of two are of one seed alone."""
    scores = np.stack([np.full(100, 3.0), np.full(100, 7.0)])
    together = bootstrap_units(scores, lambda drawn: float(drawn.mean()))
    assert (together.value, together.low, together.high) == (5.0, 3.0, 7.0)
    assert bootstrap_units(scores, interquartile_mean) == bootstrap_units(scores, interquartile_mean)
    alone = bootstrap_units(scores[:1], interquartile_mean)
    assert alone.value == 3.0 and math.isnan(alone.low) and math.isnan(alone.high)
    with pytest.raises(ValueError, match="none"):
        bootstrap_units(np.zeros((0, 3)), interquartile_mean)


def test_intervals_of_units_hold_the_truth_about_as_often_as_they_say() -> None:
    """Each of 32 partners has a level of its own in both seats: seats drawn apart hold the mean far less often."""
    rng, held = np.random.default_rng(1), 0
    for _ in range(200):
        levels = rng.normal(5.0, 1.0, (32, 1)) + rng.normal(0.0, 0.1, (32, 2))
        found = bootstrap_units(levels, lambda drawn: float(drawn.mean()), repetitions=200)
        held += found.low <= 5.0 <= found.high
    assert 0.9 <= held / 200 <= 0.98


def test_one_run_has_no_interval_over_runs() -> None:
    with pytest.raises(ValueError, match="over_tasks"):
        bootstrap_interval(np.ones((1, 4)))
    assert bootstrap_interval(np.array([[1.0, 2.0, 3.0, 4.0]]), over_tasks=True).value == 2.5


def test_bad_arguments_are_refused() -> None:
    for call in (
        lambda: measure_cvar(np.ones(3), 0.0),
        lambda: measure_br_proximity(MEANS, BEST[:1]),
        lambda: bootstrap_interval(np.ones(4)),
        lambda: describe_spread(np.array([])),
    ):
        with pytest.raises(ValueError):
            call()
