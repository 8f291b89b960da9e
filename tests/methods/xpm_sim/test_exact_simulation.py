"""Simulated trajectories: exact, from the right states, cut where they must be, acted by the right policies."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from support.exact import CONFIG, filled, kitchen
from torch import Tensor

from popgen.envs import BatchedEnv, make_env
from popgen.envs.reward import training_reward
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_sim.simulation import BatchColumns, Partner, SimulatedBatch, Simulator
from popgen.methods.xpm_sim.simulation_starts import StartStates


def always(action: int, actions: int) -> Callable[[Tensor, Tensor], Tensor]:
    """Logits that leave one action."""

    def logits(obs: Tensor, seats: Tensor) -> Tensor:
        out = torch.full((len(obs), actions), -1e9)
        out[:, action] = 0.0
        return out

    return logits


def evenly(actions: int) -> Callable[[Tensor, Tensor], Tensor]:
    return lambda obs, seats: torch.zeros(len(obs), actions)


def simulate(
    env: BatchedEnv, layout: BatchColumns, partner: int | None = 1, own: int | None = None
) -> tuple[SimulatedBatch, object]:
    starts = filled(env)
    simulator = Simulator(CONFIG, starts, 5)
    actions = env.spec.num_actions
    mine = evenly(actions) if own is None else always(own, actions)
    return simulator.run(layout, mine, None if partner is None else Partner(partner, always(2, actions))), simulator


def test_layout_names_the_columns_and_halves_the_seats() -> None:
    layout = BatchColumns(3, 2, 5)
    assert (layout.started, layout.restarted, layout.cross_play) == (slice(0, 3), slice(3, 5), slice(5, 10))
    assert layout.seats.tolist() == [0, 0, 0, 1, 1]


def test_every_row_is_what_the_simulator_gives() -> None:
    env = kitchen()
    batch, _ = simulate(env, BatchColumns(3, 2, 4))
    assert batch.obs.shape == (11, 9, 2, *env.spec.views["features"].shape) and batch.steps == 90
    again = 0
    for t in range(9):
        # Features do not hold the time, which does not matter before the end.
        states = env.features_to_states(batch.obs[t, :, 0].numpy())
        following, result = env.simulate(states, batch.actions[t].numpy())
        np.testing.assert_array_equal(training_reward(env.spec, result), batch.reward[t].numpy())
        going_on = ~(batch.cut[t] | batch.terminated[t]).numpy()
        np.testing.assert_array_equal(env.encode(following)[going_on], batch.obs[t + 1].numpy()[going_on])
        again += int(going_on.sum())
    assert again > 50


def test_trajectories_end_after_their_own_horizon_and_bootstrap_from_where_they_ended() -> None:
    env = kitchen()
    batch, _ = simulate(env, BatchColumns(3, 2, 4))
    cut = batch.cut.numpy()
    assert np.flatnonzero(cut[:, 3]).tolist() == [2, 5, 8]  # restarted self-play, 3 steps
    assert np.flatnonzero(cut[:, 5]).tolist() == [3, 7]  # cross-play, 4 steps
    assert not batch.terminated.any()
    rows, columns = np.nonzero(cut)
    for number, (t, n) in enumerate(zip(rows, columns, strict=True)):
        states = env.features_to_states(batch.obs[t, n : n + 1, 0].numpy())
        following, _ = env.simulate(states, batch.actions[t, n : n + 1].numpy())
        np.testing.assert_array_equal(env.encode(following)[0], batch.cut_obs[number].numpy())


def test_leaving_the_bounds_is_terminal_and_not_cut() -> None:
    env = make_env("rendezvous/mppmr", 2)
    config = XpmSimConfig(horizon=50, unroll=50, restart_horizon=50, xp_horizon=50, sims_sp=2)
    simulator = Simulator(config, StartStates(config, env, 1, 0), 0)
    batch = simulator.run(BatchColumns(2, 0, 0), always(1, 5), None)  # both go left
    assert batch.terminated.any() and not batch.cut[batch.terminated].any()
    first = int(batch.terminated[:, 0].nonzero()[0])
    np.testing.assert_allclose(batch.obs[first + 1, 0, 0, 0], 0.3)  # starts again
    assert batch.reward[first, 0] < -4.0
    assert batch.covered[first, 0] == 50 - first  # itself and those that were left
    assert batch.covered[~batch.terminated].unique().tolist() == [1.0]


def test_cross_play_and_restarts_rest_after_leaving_so_that_each_start_weighs_the_same() -> None:
    env = make_env("rendezvous/mppmr", 2)
    config = XpmSimConfig(horizon=50, unroll=50, restart_horizon=25, xp_horizon=50)
    simulator = Simulator(config, StartStates(config, env, 2, 0), 0)
    batch = simulator.run(BatchColumns(1, 1, 1), always(1, 5), Partner(1, always(1, 5)))  # all go left, from the start
    valid = batch.valid.numpy()
    steps = int(valid[:, 2].sum())
    assert valid[:, 0].all()  # self-play starts anew at once
    assert 0 < steps < 25 and valid[:steps, 2].all() and batch.terminated[steps - 1, 2]
    assert np.flatnonzero(valid[:, 1]).tolist() == [*range(steps), *range(25, 25 + steps)]
    assert not batch.cut[:, 1:].any()


def test_a_column_whose_time_is_over_starts_anew_and_has_no_value_beyond() -> None:
    env = make_env("rendezvous/mppmr", 2)
    config = XpmSimConfig(horizon=50, unroll=50, restart_horizon=25, xp_horizon=50, xp_initial=1.0)
    starts = StartStates(config, env, 2, 0)
    late = env.get_state()
    late[:, 8] = 40.0  # ten steps before the horizon
    starts.cross_play = lambda count, partner: np.repeat(late[:1], count, 0)  # type: ignore[method-assign]
    batch = Simulator(config, starts, 0).run(BatchColumns(1, 0, 1), always(0, 5), Partner(1, always(0, 5)))
    assert np.flatnonzero(batch.terminated[:, 1]).tolist() == [9, 19, 29, 39, 49]
    assert batch.valid[:, 1].all() and not batch.cut.any()
    assert np.flatnonzero(batch.terminated[:, 0]).tolist() == [49]


def test_the_partner_sits_in_the_other_seat_of_cross_play_only() -> None:
    batch, _ = simulate(kitchen(), BatchColumns(3, 2, 4), own=5)
    assert (batch.actions[:, :5] == 5).all()
    own, other = [0, 0, 1, 1], [1, 1, 0, 0]
    columns = torch.arange(5, 9)
    assert (batch.actions[:, columns, own] == 5).all() and (batch.actions[:, columns, other] == 2).all()


def test_log_prob_is_of_the_drawn_action_and_draws_follow_the_policy() -> None:
    env = kitchen()
    simulator = Simulator(CONFIG, filled(env), 5)
    bias = torch.tensor([0.0, 1.0, 2.0, 0.0, 0.0, -1.0])
    batch = simulator.run(BatchColumns(3, 2, 0), lambda obs, seats: bias.expand(len(obs), -1).clone(), None)
    expected = torch.log_softmax(bias, -1)
    torch.testing.assert_close(batch.log_prob, expected[batch.actions])
    noise = Simulator(CONFIG, filled(env), 7)
    many = noise.run(BatchColumns(300, 0, 0), lambda obs, seats: bias.expand(len(obs), -1).clone(), None).actions
    share = torch.bincount(many.flatten(), minlength=6) / many.numel()
    assert (share - expected.exp()).abs().max() < 0.02


def test_self_play_goes_on_in_the_next_batch_and_a_state_restores_it() -> None:
    env = kitchen()
    starts = filled(env)
    simulator = Simulator(CONFIG, starts, 5)
    layout, logits = BatchColumns(3, 2, 0), evenly(6)
    first = simulator.run(layout, logits, None)
    saved, drawn = simulator.state(), starts.state()
    second = simulator.run(layout, logits, None)
    np.testing.assert_array_equal(second.obs[0, :3], first.obs[-1, :3])
    fresh = filled(env)
    other = Simulator(CONFIG, fresh, 99)
    fresh.load_state(drawn)
    other.load_state(saved)
    torch.testing.assert_close(other.run(layout, logits, None).obs, second.obs, rtol=0, atol=0)


def test_score_counts_each_trajectory_to_its_end() -> None:
    env = make_env("rendezvous/mppmr", 1)
    simulator = Simulator(CONFIG, StartStates(CONFIG, env, 1, 0), 0)
    states = np.repeat(env.get_state(), 3, 0)
    total, reward, going_on = np.zeros(3), 0.0, True
    here = states
    for _ in range(40):
        here, result = env.simulate(here, np.ones((3, 2), np.int64))
        reward += float(result.score[0]) if going_on else 0.0
        going_on &= not result.done[0]
    total += reward
    np.testing.assert_allclose(simulator.score(states, 40, always(1, 5)), total, rtol=1e-6)
    assert not going_on
