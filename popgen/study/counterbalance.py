"""Who plays what: slots that balance egos, layouts, seats and positions, and how they are given out.

A slot is what one participant plays: a few pairs of games in each layout; within a pair the layout and the seat stay
and the ego changes. With n egos, n slots in turn are a row: in every layout and seat a row has each ego once as first
and once as second of a pair, so that all cells (ego, layout, seat, position in the pair) are equal after each row,
and differ by one at most within it. The next row pairs each ego with another one. Layouts come in the order of a
Williams square (each one as often after each other one); a layout's second pair never follows its first at once.

A slot whose participant leaves is given to the next one who comes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

POSITIONS = 2
SEATS = 2


@dataclass(frozen=True)
class PairPlan:
    """Two games in a row: the same layout and seat of the person, two egos.

    Attributes:
        layout, seat: of both games.
        egos: names of the first and the second.
    """

    layout: str
    seat: int
    egos: tuple[str, str]


@dataclass(frozen=True)
class Design:
    """What is to be balanced.

    Attributes:
        layouts: their names, different ones.
        egos: names, two at least.
        pairs: of games in each layout and slot.
    """

    layouts: tuple[str, ...]
    egos: tuple[str, ...]
    pairs: int = 2

    def plan_slot(self, number: int) -> tuple[PairPlan, ...]:
        """All pairs of slot `number` (from 0), in the order in which they are played."""
        order = order_layouts(number, len(self.layouts))
        return tuple(self._plan_pair(number, layout, turn) for turn in range(self.pairs) for layout in order)

    def _plan_pair(self, number: int, layout: int, turn: int) -> PairPlan:
        size = len(self.egos)
        row, place = divmod(number, size)
        apart = 1 + (row + turn // 2) % (size - 1)
        first = place + layout - (apart if turn % 2 else 0)
        cycles = 0 if size % 2 == 0 else row // (size - 1)  # else an ego's partner would always meet one seat first
        seat = (turn + row + cycles) % SEATS
        return PairPlan(self.layouts[layout], seat, (self.egos[first % size], self.egos[(first + apart) % size]))

    def count_cells(self, number: int) -> np.ndarray:
        """Games of a slot by (ego, layout, seat, position): (E, L, 2, 2) int."""
        counts = np.zeros((len(self.egos), len(self.layouts), SEATS, POSITIONS), np.int64)
        for pair in self.plan_slot(number):
            for position, ego in enumerate(pair.egos):
                counts[self.egos.index(ego), self.layouts.index(pair.layout), pair.seat, position] += 1
        return counts


def order_layouts(number: int, size: int) -> list[int]:
    """A row of the Williams square of `size` treatments; all rows are used in turn."""
    rows = size if size % 2 == 0 else 2 * size
    row = (number + number // rows) % rows
    zigzag = [(place + 1) // 2 if place % 2 else -(place // 2) for place in range(size)]
    order = [(step + row) % size for step in zigzag]
    return order[::-1] if row >= size else order


def choose_slot(free: Iterable[int], begun: int) -> int:
    """The slot of the next participant: the earliest that was given back, else a new one.

    Args:
        free: slots given back and not taken since.
        begun: slots that were ever given out: 0 to `begun` - 1.
    """
    return min(free, default=begun)


def measure_imbalance(design: Design, slots: Sequence[int]) -> int:
    """Largest difference between cells of one layout, over the games of these slots."""
    counts = sum((design.count_cells(slot) for slot in slots), np.zeros(1, np.int64))
    if counts.ndim == 1:
        return 0
    by_layout = np.moveaxis(counts, 1, 0).reshape(len(design.layouts), -1)
    return int((by_layout.max(1) - by_layout.min(1)).max())


@dataclass(frozen=True)
class History:
    """How balanced a study was whose participants came and left at random.

    Attributes:
        within: largest imbalance at any time over all rows that were complete, whoever has finished or still plays.
        overall: largest imbalance at any time over all who have finished or still play.
        final: of those who finished, when recruiting ended.
        dropped: participants who left.
    """

    within: int
    overall: int
    final: int
    dropped: int


def simulate_history(design: Design, wanted: int, rng: np.random.Generator, drop_outs: float = 0.2) -> History:
    """Participants come at random times, play for random times and leave at random; recruiting ends at `wanted`.

    Args:
        design: of the study.
        wanted: participants who finish.
        rng: of all draws.
        drop_outs: probability that one leaves before the end.
    """
    size, cells = len(design.egos), _Cells(design)
    held: list[int] = []
    free: set[int] = set()
    done: list[int] = []
    begun = dropped = within = overall = 0
    together = int(rng.integers(1, 21))
    while len(done) < wanted:
        missing = wanted - len(done) - len(held)
        if missing > 0 and (not held or (len(held) < together and rng.random() < 0.5)):
            slot = choose_slot(free, begun)
            free.discard(slot)
            begun = max(begun, slot + 1)
            held.append(slot)
        else:
            slot = held.pop(int(rng.integers(len(held))))
            if rng.random() < drop_outs:
                free.add(slot)
                dropped += 1
            else:
                done.append(slot)
        present = {*held, *done}
        rows = [row for row in range(begun // size) if present.issuperset(range(row * size, (row + 1) * size))]
        within = max(within, cells.imbalance([slot for row in rows for slot in range(row * size, (row + 1) * size)]))
        overall = max(overall, cells.imbalance(sorted(present)))
    return History(within, overall, cells.imbalance(done), dropped)


class _Cells:
    """Counts of slots, each worked out once."""

    def __init__(self, design: Design) -> None:
        self._design = design
        self._counts: dict[int, np.ndarray] = {}

    def imbalance(self, slots: Sequence[int]) -> int:
        total = np.zeros((len(self._design.layouts), len(self._design.egos) * SEATS * POSITIONS), np.int64)
        for slot in slots:
            if slot not in self._counts:
                counts = np.moveaxis(self._design.count_cells(slot), 1, 0)
                self._counts[slot] = counts.reshape(len(self._design.layouts), -1)
            total += self._counts[slot]
        return int((total.max(1) - total.min(1)).max())
