from __future__ import annotations

import numpy as np
import pytest

from popgen.study.counterbalance import Design, choose_slot, measure_imbalance, order_layouts, simulate_history

LAYOUTS = ("a", "b", "c", "d", "e")
DESIGN = Design(LAYOUTS, ("A", "B", "C"))


def test_a_row_by_hand() -> None:
    pairs = [sorted((p.seat, "".join(p.egos)) for p in DESIGN.plan_slot(slot) if p.layout == "a") for slot in range(3)]
    assert pairs == [[(0, "AB"), (1, "CA")], [(0, "BC"), (1, "AB")], [(0, "CA"), (1, "BC")]]


@pytest.mark.parametrize("egos", [2, 3, 4, 5])
@pytest.mark.parametrize("pairs", [1, 2, 3, 4])
def test_cells_are_equal_after_each_round_of_rows_and_differ_little_within(egos: int, pairs: int) -> None:
    design = Design(LAYOUTS[:3], tuple("ABCDE"[:egos]), pairs)
    found = [measure_imbalance(design, range(slots)) for slots in range(4 * egos * (egos - 1) + 1)]
    assert max(found) <= (1 if pairs < 3 else 2)
    if pairs % 2 == 0:
        assert set(found[::egos]) == {0}
    else:
        assert set(found[:: 2 * egos * (egos - 1)]) == {0}


def test_all_ordered_pairs_come_equally_often_in_both_seats() -> None:
    found = [(p.layout, p.seat, p.egos) for slot in range(6) for p in DESIGN.plan_slot(slot)]
    assert len(set(found)) == len(found) == 6 * 5 * 2


@pytest.mark.parametrize("size", [2, 3, 4, 5, 6])
def test_each_layout_follows_each_other_one_equally_often(size: int) -> None:
    rows = size if size % 2 == 0 else 2 * size
    orders = [order_layouts(number, size) for number in range(rows)]
    assert all(sorted(order) == list(range(size)) for order in orders)
    follows = [pair for order in orders for pair in zip(order, order[1:], strict=False)]
    counts = {pair: follows.count(pair) for pair in follows}
    assert len(counts) == size * (size - 1) and len(set(counts.values())) == 1


def test_a_layouts_second_pair_does_not_follow_its_first() -> None:
    for slot in range(30):
        layouts = [pair.layout for pair in DESIGN.plan_slot(slot)]
        assert all(one != other for one, other in zip(layouts, layouts[1:], strict=False))


def test_slots_that_came_back_go_first() -> None:
    assert [choose_slot(set(), 4), choose_slot({3, 1}, 4)] == [4, 1]


def test_random_histories_stay_balanced() -> None:
    rng = np.random.default_rng(0)
    found = [simulate_history(DESIGN, 40, rng) for _ in range(150)]
    assert max(one.within for one in found) == 0 and max(one.final for one in found) <= 1
    assert 0.1 < np.mean([one.dropped / (one.dropped + 40) for one in found]) < 0.3
    assert np.mean([one.overall <= 2 for one in found]) > 0.7
