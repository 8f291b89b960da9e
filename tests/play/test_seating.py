from __future__ import annotations

import numpy as np
import pytest
from support.scripted import ONE, STAY, TWO, Script

from popgen.play.rollout import Seating


def observation(time: int, batch: int) -> dict[str, np.ndarray]:
    return {"features": np.full((batch, 2, 2), time, np.float32), "clock": np.full((batch, 2, 1), time, np.float32)}


def test_every_policy_is_called_once_on_its_own_rows() -> None:
    a, b, unused = Script([ONE], [TWO]), Script([STAY, ONE], view="clock"), Script([ONE])
    seating = Seating([a, b, unused], np.array([[0, 0], [0, 1], [1, 0], [1, 1]]))
    seating.reset(3)
    assert seating.views == ("clock", "features")
    assert [a.resets[0][0], b.resets[0][0]] == [3, 3] and not unused.resets
    assert a.resets[0][1] != b.resets[0][1]
    np.testing.assert_array_equal(seating.act(observation(0, 4)), [[ONE, TWO], [ONE, STAY], [STAY, TWO], [STAY, STAY]])
    np.testing.assert_array_equal(seating.act(observation(1, 4)), [[ONE, TWO], [ONE, ONE], [ONE, TWO], [ONE, ONE]])
    assert len(a.calls) == len(b.calls) == 2 and not unused.calls
    # The second call shows what was really played, the other's actions included.
    np.testing.assert_array_equal(a.calls[1][1], [[ONE, TWO], [ONE, STAY], [STAY, TWO]])
    np.testing.assert_array_equal(b.calls[1][1], [[ONE, STAY], [STAY, TWO], [STAY, STAY]])
    assert a.calls[0][2].all() and not a.calls[1][2].any()


def test_ended_rows_start_anew() -> None:
    a = Script([ONE])
    seating = Seating([a], np.zeros((3, 2), int))
    seating.reset(0)
    assert seating.is_first.all()
    seating.act(observation(0, 3))
    assert not seating.is_first.any()
    seating.ended(np.array([False, True, False]))
    seating.act(observation(1, 3))
    np.testing.assert_array_equal(a.calls[1][2], [False, True, False])


def test_bad_seats_are_refused() -> None:
    a = Script([ONE])
    for policies, seats in (([a, a], [[0, 1]]), ([a], [[0, 1]]), ([a], [[0, -1]]), ([a], np.zeros((0, 2)))):
        with pytest.raises(ValueError):
            Seating(policies, np.asarray(seats))
    seating = Seating([a], np.zeros((3, 2), int))
    with pytest.raises(ValueError, match="observations"):
        seating.act(observation(0, 2))
