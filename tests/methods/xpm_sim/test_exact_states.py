"""Start states: from the right buffer, partner and episodes."""

from __future__ import annotations

import numpy as np
from support.exact import CONFIG, filled, kitchen, segment

from popgen.envs import make_env
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_sim.simulation_starts import StartStates


def rows_of(states: np.ndarray) -> set[bytes]:
    return {row.tobytes() for row in states}


def test_without_buffered_states_everything_starts_at_the_start() -> None:
    env = kitchen()
    starts = StartStates(CONFIG, env, 2, 0)
    env.reset()
    start = rows_of(env.get_state())
    for found in (starts.self_play(7), starts.restart(3), starts.cross_play(5, 1)):
        assert rows_of(found) == start
    assert starts.self_play(0).shape == (0, env.spec.state_size)


def test_each_kind_draws_from_its_own_buffer_and_cross_play_from_its_partner() -> None:
    env = kitchen()
    config = CONFIG.model_copy(update={"starts_initial": 0.0})
    starts = filled(env, config)
    assert rows_of(starts.self_play(60)) <= rows_of(starts.sp.states[: starts.sp.size])
    stored, partner = starts.xp.states[: starts.xp.size], starts.xp.partner[: starts.xp.size]
    with_one, with_two = rows_of(stored[partner == 1]), rows_of(stored[partner == 2])
    found = rows_of(starts.cross_play(200, 1))
    assert found <= with_one and found - with_two
    assert rows_of(starts.restart(400)) & (with_two - with_one) and rows_of(starts.restart(400)) & (with_one - with_two)


def test_a_share_starts_at_the_start() -> None:
    env = kitchen()
    starts = filled(env, CONFIG.model_copy(update={"xp_initial": 0.25}))
    times = env.time(starts.cross_play(2000, 1))
    fresh = np.isin(times, 0).mean()
    assert 0.25 < fresh < 0.25 + 3 * 0.75 / 12  # those drawn from the buffer are at time 0 in one of 12 rows


def test_only_recent_rows_that_are_not_terminal_serve() -> None:
    env = make_env("rendezvous/mppmr", 2, horizon=20, bounds=0.8, landmark_distance=0.4)
    config = XpmSimConfig(recent=1, starts_initial=0.0)
    starts = StartStates(config, env, 1, 0)
    rng = np.random.default_rng(0)
    for number in range(3):
        starts.add([segment(env, (1, 1), rng, 60, number)])
    assert starts.sp.terminal[: starts.sp.size].any()
    recent = starts.sp.states[starts.sp.size - 20 : starts.sp.size]
    found = starts.self_play(300)
    assert rows_of(found) <= rows_of(recent)
    assert (np.abs(env.positions(found)) <= 0.8).all()
