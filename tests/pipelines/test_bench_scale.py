"""The model that extrapolates to more samplers, with numbers worked out by hand."""

from __future__ import annotations

import pytest

from popgen.pipelines.bench_scale import NETWORK, Costs

COSTS = Costs(steps=6400.0, sampler=1.0, driver=0.1, model=0.5, agent=2.0, data=1e6)


def test_the_slowest_of_what_goes_on_side_by_side_sets_the_pace() -> None:
    assert COSTS.predict(1, overlap=4) == {"steps_per_second": 3200.0, "idle_model": 0.0, "idle_agent": 0.0}
    assert COSTS.predict(8, overlap=4)["steps_per_second"] == 8 * 6400 / 2.0
    # From 20 samplers on the driver is the bottleneck, which takes 0.1 s for each.
    assert COSTS.predict(40, overlap=4)["steps_per_second"] == pytest.approx(6400 / 0.1)


def test_a_learner_is_idle_where_it_may_not_go_further_ahead() -> None:
    told = COSTS.predict(40, overlap=4)  # the samplers' round takes 4 s
    assert told["idle_model"] == pytest.approx(1 - 4 * 0.5 / 4.0) and told["idle_agent"] == 0.0
    assert COSTS.predict(40, overlap=1)["idle_agent"] == pytest.approx(0.5)


def test_shared_cores_are_shared() -> None:
    # 2 samplers: (2 (1 + 0.1) + 0.5 + 2) / 2 cores = 2.35 s a round.
    assert COSTS.predict(2, overlap=4, cores=2.0)["steps_per_second"] == pytest.approx(2 * 6400 / 2.35)


def test_the_network_bounds_what_the_replays_receive() -> None:
    heavy = Costs(steps=1.0, sampler=0.1, driver=0.0, model=0.1, agent=0.1, data=NETWORK)
    assert heavy.predict(10, overlap=4)["steps_per_second"] == pytest.approx(1.0)
