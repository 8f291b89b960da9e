"""What cannot work is refused before anything starts."""

from __future__ import annotations

from typing import Any

import pytest

from popgen.envs import make_env
from popgen.errors import UserError
from popgen.methods.registry import recipe
from popgen.methods.xpm_wm.config import XpmWmRun
from popgen.methods.xpm_wm.needs import check_run

ROOM, HORIZON = "overcooked/cramped_room", 40
SPEC = make_env(ROOM, 1, horizon=HORIZON).spec


def smoke(size: int, **changes: dict[str, Any]) -> XpmWmRun:
    """With 2 episodes of self-play in a round, and 2 of cross-play or one in each seating with each partner."""
    values = recipe("xpm_wm", ROOM, "smoke").as_dict()
    values["population"]["size"] = size
    for section, fields in changes.items():
        values[section] |= fields
    config = XpmWmRun.parse(values)
    assert isinstance(config, XpmWmRun)
    return config


@pytest.mark.parametrize(("size", "one"), [(2, 4 * HORIZON), (3, 6 * HORIZON)])
def test_a_later_members_steps_hold_a_round(size: int, one: int) -> None:
    check_run(smoke(size, phase2={"max_steps": one}), SPEC)
    with pytest.raises(UserError, match=rf"^phase2.max_steps: is less than the {one}"):
        check_run(smoke(size, phase2={"max_steps": one - 1}), SPEC)
    check_run(smoke(1, phase2={"max_steps": 1}), SPEC)


def test_a_buffer_holds_the_cross_play_of_a_round_with_all_partners() -> None:
    """16 partners in both seatings: 32 episodes of 41 rows are more than the segment of member 1."""
    small, rows = {"phase1": {"prefill_steps": 400}}, 32 * (HORIZON + 1)
    check_run(smoke(17, replay={"capacity": rows}, **small), SPEC)
    with pytest.raises(UserError, match=rf"^replay.capacity: cannot hold the {rows:,} steps"):
        check_run(smoke(17, replay={"capacity": rows - 1}, **small), SPEC)
