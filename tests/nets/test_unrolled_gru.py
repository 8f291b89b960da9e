"""The GRU that is unrolled in one go: values and gradients of torch's own, with and without rows that begin anew."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from popgen.nets.unrolled_gru import run_gru

TIME, ROWS, INPUTS, UNITS = 9, 4, 5, 6


def run_step_by_step(gru: nn.GRU, inputs: Tensor, state: Tensor, is_first: Tensor) -> Tensor:
    outputs = []
    for values, first in zip(inputs, is_first, strict=True):
        output, hidden = gru(values.unsqueeze(0), (state * (~first).float().unsqueeze(-1)).unsqueeze(0))
        outputs.append(output)
        state = hidden.squeeze(0)
    return torch.cat(outputs)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_values_and_gradients_are_those_of_torch(share: float) -> None:
    generator = torch.Generator().manual_seed(0)
    gru = nn.GRU(INPUTS, UNITS)
    for parameter in gru.parameters():
        nn.init.normal_(parameter, generator=generator)
    is_first = torch.rand(TIME, ROWS, generator=generator) < share
    weights = torch.randn(TIME, ROWS, UNITS, generator=generator)
    found = []
    for run in (run_gru, run_step_by_step):
        inputs = torch.randn(TIME, ROWS, INPUTS, generator=torch.Generator().manual_seed(1), requires_grad=True)
        state = torch.randn(ROWS, UNITS, generator=torch.Generator().manual_seed(2), requires_grad=True)
        gru.zero_grad()
        outputs = run(gru, inputs, state, is_first)
        (outputs * weights).sum().backward()
        gradients = [inputs.grad, state.grad, *(parameter.grad for parameter in gru.parameters())]
        found.append([outputs.detach(), *(None if part is None else part.clone() for part in gradients)])
    for got, expected in zip(*found, strict=True):
        torch.testing.assert_close(got, expected, atol=1e-5, rtol=1e-5)
