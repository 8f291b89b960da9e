"""What a run says when imagination and reality part, on figures by hand."""

from __future__ import annotations

from popgen.methods.xpm_wm.config import WatchConfig
from popgen.methods.xpm_wm.real_play import Watch

CONFIG = WatchConfig(imagined_factor=4.0, precision_share=0.7, precision_reports=2)


def pay(watch: Watch, imagined: float, real: float) -> str:
    return watch.look({"agent/imagined_shaped_sp": imagined, "real_shaped_sp": real}, {}, CONFIG, 3)


def precision(watch: Watch, value: float) -> str:
    return watch.look({}, {"report/event_precision_step1": value}, CONFIG, 3)


def test_a_reward_that_only_imagination_pays_is_told_once_after_some_rounds_in_a_row() -> None:
    watch = Watch()
    assert [bool(pay(watch, 0.41, 0.1)) for _ in range(5)] == [False, False, True, False, False]
    assert not pay(watch, 0.4, 0.1) and watch.gap == 0  # then it may be said again
    assert [bool(pay(watch, 0.41, 0.1)) for _ in range(3)] == [False, False, True]
    line = pay(Watch(gap=2), 0.41, 0.1)
    assert "0.41 a step and real self-play 0.10 for 3 rounds" in line and "discovery.trust" in line


def test_little_is_not_farmed_and_nothing_is_compared_with_nothing() -> None:
    watch = Watch()
    assert not any(pay(watch, 0.05, 0.0) for _ in range(9))
    assert not watch.look({"agent/imagined_shaped_sp": 9.0}, {}, CONFIG, 1)
    assert not watch.look(
        {"agent/imagined_shaped_sp": 9.0, "real_shaped_sp": 0.0}, {}, WatchConfig(imagined_factor=0), 1
    )


def test_precision_is_measured_by_its_own_best() -> None:
    watch = Watch()
    said = [bool(precision(watch, value)) for value in (0.5, 0.9, 0.63, 0.62, 0.62, 0.62, 0.7, 0.6, 0.6)]
    assert said == [False, False, False, False, True, False, False, False, True]
    assert "62% of the events" in precision(Watch(best_precision=0.9, imprecise=1), 0.62)
    assert not Watch(best_precision=0.9, imprecise=1).look(
        {}, {"report/event_precision_step1": 0.1}, WatchConfig(precision_share=0.0), 1
    )


def test_a_watch_comes_back_from_a_checkpoint() -> None:
    watch = Watch(3, 0.9, 1, True, False)
    assert Watch.from_state(watch.to_state()) == watch
