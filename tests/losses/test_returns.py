from __future__ import annotations

import pytest
import torch

from popgen.losses.policy_losses import gae, lambda_return


def column(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64).unsqueeze(1)


# r_1..r_3 = 1, 2, 3; v_0..v_3 = 10, 20, 30, 40; discount 0.5 throughout:
#   R_2 = 3 + 0.5 * 40                               = 23, whatever lambda is: v_3 stands for both
#   R_1 = 2 + 0.5 * ((1 - l) * 30 + l * 23)          = 17 - 3.5 l
#   R_0 = 1 + 0.5 * ((1 - l) * 20 + l * R_1)         = 11 - 1.5 l - 1.75 l^2
@pytest.mark.parametrize("lam", [0.0, 0.25, 0.5, 0.95, 1.0])
def test_lambda_return_by_hand(lam: float) -> None:
    returns = lambda_return(column(1, 2, 3), column(10, 20, 30, 40), column(0.5, 0.5, 0.5), lam)
    expected = column(11 - 1.5 * lam - 1.75 * lam**2, 17 - 3.5 * lam, 23)
    torch.testing.assert_close(returns, expected)


def test_lambda_one_is_the_discounted_sum_and_zero_is_one_step_bootstrapping() -> None:
    reward, value, discount = column(1, 0, -4), column(7, 7, 7, 8), column(0.9, 0.8, 0.7)
    total = 1 + 0.9 * (0 + 0.8 * (-4 + 0.7 * 8))
    assert float(lambda_return(reward, value, discount, 1.0)[0]) == pytest.approx(total)
    torch.testing.assert_close(lambda_return(reward, value, discount, 0.0), reward + discount * value[1:])


def test_nothing_counts_after_the_end_of_an_episode() -> None:
    reward, discount = column(1, 2, 3), column(0.9, 0.0, 0.9)
    returns = lambda_return(reward, column(5, 5, 5, 5), discount, 0.95)
    again = lambda_return(column(1, 2, 100), column(5, 5, -50, 70), discount, 0.95)
    assert float(returns[1]) == 2.0
    torch.testing.assert_close(again[:2], returns[:2])


def test_gae_is_the_discounted_sum_of_temporal_differences() -> None:
    generator = torch.Generator().manual_seed(0)
    reward, value = torch.randn(4, 3, generator=generator), torch.randn(5, 3, generator=generator)
    discount, lam = torch.rand(4, 3, generator=generator), 0.7
    delta = reward + discount * value[1:] - value[:-1]
    expected = torch.zeros(4, 3)
    for start in range(4):
        weight = torch.ones(3)
        for t in range(start, 4):
            expected[start] += weight * delta[t]
            weight = weight * discount[t] * lam
    torch.testing.assert_close(gae(reward, value, discount, lam), expected)


def test_columns_do_not_mix() -> None:
    generator = torch.Generator().manual_seed(1)
    reward, value, discount = (torch.rand(n, 5, generator=generator) for n in (4, 5, 4))
    together = lambda_return(reward, value, discount, 0.9)
    alone = [lambda_return(reward[:, i : i + 1], value[:, i : i + 1], discount[:, i : i + 1], 0.9) for i in range(5)]
    torch.testing.assert_close(together, torch.cat(alone, 1))


@pytest.mark.parametrize("values", [3, 5])
def test_a_value_too_few_or_too_many_is_refused(values: int) -> None:
    with pytest.raises((ValueError, TypeError), match="shapes|Type-check"):
        lambda_return(torch.zeros(3, 2), torch.zeros(values, 2), torch.zeros(3, 2), 0.9)
