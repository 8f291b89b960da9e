"""Hold-out figures against numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from popgen.evaluation.holdout_metrics import (
    bootstrap_crossed,
    bootstrap_gain,
    bootstrap_interval,
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
    clipped, unclipped = measure_br_proximity(MEANS, BEST), measure_br_proximity(MEANS, BEST, clip=False)
    np.testing.assert_array_equal(clipped, [[[0.5, 0.5], [1.0, math.nan]]])
    np.testing.assert_array_equal(unclipped, [[[0.5, 0.5], [1.5, math.nan]]])
    assert math.isnan(measure_br_proximity(MEANS - 9, BEST - 9)[0, 1, 1])  # nor a share of less than nothing


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


def mean_of(drawn: np.ndarray) -> float:
    return float(drawn.mean())


def test_runs_and_partners_are_drawn_with_all_that_they_have() -> None:
    """Two seeds, one 4 better beside each of 50 partners: half of all draws of two are of one seed alone."""
    scores = np.stack([np.full((50, 2), 3.0), np.full((50, 2), 7.0)])
    together = bootstrap_crossed(scores, [0] * 50, mean_of)
    assert (together.value, together.low, together.high) == (5.0, 3.0, 7.0)
    again = [bootstrap_crossed(scores, [0] * 50, interquartile_mean) for _ in range(2)]
    assert again[0] == again[1]
    alone = bootstrap_crossed(scores[:1, :1], [0], interquartile_mean)
    assert alone.value == 3.0 and math.isnan(alone.low) and math.isnan(alone.high)
    for wrong, groups in ((np.zeros((0, 3, 2)), [0] * 3), (scores, [0] * 49), (scores[0], [0] * 50)):
        with pytest.raises(ValueError, match="values"):
            bootstrap_crossed(wrong, groups, mean_of)


def test_partners_are_drawn_within_their_groups() -> None:
    """Eight partners at 4 and eight at 8: as two groups no draw differs, as one the share of either does."""
    scores = np.repeat([4.0, 8.0], 8)[None, :, None].repeat(2, axis=2)
    apart = bootstrap_crossed(scores, [0] * 8 + [1] * 8, mean_of)
    assert (apart.low, apart.value, apart.high) == (6.0, 6.0, 6.0)
    mixed = bootstrap_crossed(scores, [0] * 16, mean_of)
    assert mixed.low < 5.25 and mixed.high > 6.75
    single = bootstrap_crossed(scores[:, [0, 8]], [0, 1], mean_of)  # nothing is drawn: one of each group, one run
    assert single.value == 6.0 and math.isnan(single.low)
    gain = bootstrap_gain(scores, scores - 1.0, [0] * 8 + [1] * 8)
    assert (gain.low, gain.value, gain.high) == (1.0, 1.0, 1.0)
    nothing = bootstrap_gain(scores[:, [0, 8]], scores[:, [0, 8]], [0, 1])
    assert nothing.value == 0.0 and math.isnan(nothing.low)


def test_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    """Each of 32 partners has a level of its own in both seats: seats drawn apart hold the mean far less often."""
    rng, held = np.random.default_rng(1), 0
    for _ in range(200):
        levels = rng.normal(5.0, 1.0, (1, 32, 1)) + rng.normal(0.0, 0.1, (1, 32, 2))
        found = bootstrap_crossed(levels, [0] * 32, mean_of, repetitions=200)
        held += found.low <= 5.0 <= found.high
    assert 0.9 <= held / 200 <= 0.98


def test_one_run_has_no_interval_over_runs() -> None:
    with pytest.raises(ValueError, match="over_tasks"):
        bootstrap_interval(np.ones((1, 4)))
    assert bootstrap_interval(np.array([[1.0, 2.0, 3.0, 4.0]]), over_tasks=True).value == 2.5


def test_a_gain_draws_the_seeds_of_both_sides_each_on_their_own() -> None:
    """Seeds of 0 and 8 and a control of 5, at all partners: a quarter of the draws has two seeds of 0, a quarter two of
    8. With a control of two seeds, 1 and 9, the extremes are 0 - 9 and 8 - 1, a sixteenth of the draws each."""
    own = np.stack([np.zeros((6, 2)), np.full((6, 2), 8.0)])
    one = bootstrap_gain(own, np.full((1, 6, 2), 5.0))
    assert (one.value, one.low, one.high) == (-1.0, -5.0, 3.0)
    swapped = bootstrap_gain(np.full((1, 6, 2), 5.0), own)
    assert (swapped.value, swapped.low, swapped.high) == (1.0, -3.0, 5.0)
    both = bootstrap_gain(own, np.stack([np.ones((6, 2)), np.full((6, 2), 9.0)]))
    assert (both.value, both.low, both.high) == (-1.0, -9.0, 7.0)


def test_a_gain_draws_the_partners_of_both_sides_together() -> None:
    """Beside one partner 10 more, beside the other as much: a quarter of the draws is of one partner alone. What both
    sides have in common, a partner with whom everybody scores 100 more, widens nothing."""
    own, base = np.array([[[10.0, 10.0], [100.0, 100.0]]]), np.array([[[0.0, 0.0], [100.0, 100.0]]])
    gain = bootstrap_gain(own, base)
    assert (gain.value, gain.low, gain.high) == (5.0, 0.0, 10.0)
    alone = bootstrap_gain(own[:, :1], base[:, :1])
    assert alone.value == 10.0 and math.isnan(alone.low) and math.isnan(alone.high)
    seats = bootstrap_gain(np.array([[[10.0, 0.0]]]), np.zeros((2, 1, 2)))  # of two seeds that are alike
    assert (seats.value, seats.low, seats.high) == (5.0, 5.0, 5.0)


def test_a_gain_of_one_seed_over_one_is_bootstrapped_over_partners_alone() -> None:
    own, base = np.random.default_rng(3).normal(size=(2, 1, 7, 2))
    of_units = bootstrap_crossed(own - base, [0] * 7, mean_of)
    gain = bootstrap_gain(own, base)
    for mine, theirs in ((gain.value, of_units.value), (gain.low, of_units.low), (gain.high, of_units.high)):
        assert mine == pytest.approx(theirs)
    assert gain == bootstrap_gain(own, base)


def test_bad_arguments_are_refused() -> None:
    for call in (
        lambda: bootstrap_gain(np.ones((2, 3, 2)), np.ones((2, 4, 2))),
        lambda: bootstrap_gain(np.ones((0, 3, 2)), np.ones((2, 3, 2))),
        lambda: bootstrap_gain(np.ones((3, 2)), np.ones((3, 2))),
        lambda: measure_cvar(np.ones(3), 0.0),
        lambda: measure_br_proximity(MEANS, BEST[:1]),
        lambda: bootstrap_interval(np.ones(4)),
        lambda: describe_spread(np.array([])),
    ):
        with pytest.raises(ValueError):
            call()
