"""Advantages over cut and terminal trajectories by hand, and the weights of groups."""

from __future__ import annotations

import torch
from torch import Tensor

from popgen.methods.xpm_sim.advantages import Actions, batch_advantages
from popgen.methods.xpm_sim.simulation import BatchColumns, SimulatedBatch


def batch_of(
    reward: list[list[float]], cut: list[list[int]], terminated: list[list[int]], columns: BatchColumns
) -> SimulatedBatch:
    """Observations are the state's number: 10 t + n, 100 + 10 t + n where a trajectory was cut, 200 + n at the end."""
    rewards = torch.tensor(reward)
    time, count = rewards.shape
    numbers = 10.0 * torch.arange(time)[:, None] + torch.arange(count)
    ends = torch.tensor(cut, dtype=torch.bool)
    shown = torch.cat([numbers, 200.0 + torch.arange(count)[None]])
    return SimulatedBatch(
        columns=columns,
        obs=shown[..., None, None].expand(time + 1, count, 2, 1).clone(),
        cut_at=ends.nonzero(),
        actions=torch.arange(time * count * 2).view(time, count, 2) % 3,
        log_prob=-torch.arange(time * count * 2.0).view(time, count, 2),
        reward=rewards,
        score=rewards,
        covered=torch.ones_like(rewards),
        terminated=torch.tensor(terminated, dtype=torch.bool),
        cut=ends,
        cut_obs=(100.0 + numbers)[ends][:, None, None].expand(-1, 2, 1).clone(),
        valid=torch.ones_like(ends),
        count=0,
    )


def value(obs: Tensor, columns: Tensor) -> Tensor:
    """v = a tenth of the state's number, checked against its column."""
    number = obs[:, 0, 0]
    assert (number.long() % 10 == columns + 1).all()
    return number / 10.0


def test_a_cut_bootstraps_from_where_it_ended_and_a_terminal_state_is_worth_nothing() -> None:
    # Column 0 is another group's and must not matter. Column 1: cut after row 0. Column 2: terminal in row 1.
    reward = [[9.0, 1.0, 2.0], [9.0, 3.0, 4.0], [9.0, 5.0, 6.0]]
    cut = [[1, 1, 0], [0, 0, 0], [1, 0, 0]]
    terminated = [[0, 0, 0], [0, 0, 1], [0, 0, 0]]
    batch = batch_of(reward, cut, terminated, BatchColumns(1, 0, 2))
    advantage, returns = batch_advantages(batch, slice(1, 3), lambda o, c: value(o, c), discount=0.5, lam=1.0)
    # lambda = 1: discounted sums. Column 1: 1 + .5 v(101) = 6.05 | 3 + .5 (5 + .5 v(201)) = 10.525, 5 + .5 * 20.1.
    expected = torch.tensor([[6.05, 2.0 + 0.5 * 4.0], [3.0 + 0.5 * 15.05, 4.0], [15.05, 6.0 + 0.5 * 20.2]])
    torch.testing.assert_close(returns, expected)
    torch.testing.assert_close(advantage, expected - torch.tensor([[0.1, 0.2], [1.1, 1.2], [2.1, 2.2]]))


def test_one_step_advantages_use_the_next_state() -> None:
    batch = batch_of([[1.0, 1.0], [2.0, 2.0]], [[0, 0], [0, 0]], [[0, 0], [0, 0]], BatchColumns(1, 1, 0))
    advantage, _ = batch_advantages(batch, slice(1, 2), lambda o, c: value(o, c), discount=0.9, lam=0.0)
    torch.testing.assert_close(advantage, torch.tensor([[1.0 + 0.9 * 1.1 - 0.1], [2.0 + 0.9 * 20.1 - 1.1]]))


def test_actions_of_seats_come_with_their_own_advantage() -> None:
    batch = batch_of([[0.0] * 3] * 2, [[0] * 3] * 2, [[0] * 3] * 2, BatchColumns(1, 0, 2))
    found = Actions.of_seats(batch, slice(1, 3), torch.tensor([1, 0]), torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    assert found.obs.squeeze(-1).tolist() == [1.0, 2.0, 11.0, 12.0]
    assert found.seat.tolist() == [1, 0, 1, 0] and found.advantage.tolist() == [1.0, 2.0, 3.0, 4.0]
    flat = batch.actions.view(2, 3, 2)
    assert found.action.tolist() == [flat[0, 1, 1], flat[0, 2, 0], flat[1, 1, 1], flat[1, 2, 0]]


def test_steps_of_no_trajectory_have_no_weight_and_the_mean_advantage() -> None:
    batch = batch_of([[1.0, 3.0], [2.0, 50.0]], [[0, 0], [0, 0]], [[0, 1], [1, 1]], BatchColumns(1, 0, 1))
    batch.valid[1, 1] = False
    advantage, _ = batch_advantages(batch, slice(0, 2), lambda o, c: torch.zeros(len(o)), discount=0.5, lam=1.0)
    torch.testing.assert_close(advantage, torch.tensor([[2.0, 3.0], [2.0, 7.0 / 3.0]]))
    found = Actions.of_seats(batch, slice(0, 2), torch.tensor([0, 0]), advantage)
    assert found.weight.tolist() == [1.0, 1.0, 1.0, 0.0]


def test_groups_enter_with_the_weight_of_their_mean_whatever_their_size() -> None:
    def group(values: list[float]) -> Actions:
        x = torch.tensor(values)
        return Actions(x[:, None], x.long(), x.long(), x, x, torch.ones_like(x))

    joined = Actions.join([(group([1.0, 2.0, 3.0, 6.0]), 1.0), (group([10.0]), 0.5), (group([]), 7.0)])
    assert float((joined.weight * joined.advantage).mean()) == 3.0 + 0.5 * 10.0
    twice = Actions.join([(joined, 2.0)])
    assert abs(float((twice.weight * twice.advantage).mean()) - 16.0) < 1e-5
