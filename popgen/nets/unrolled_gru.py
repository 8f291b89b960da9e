"""A GRU over many time steps, with rows that forget at given steps, for a processor.

`torch.nn.GRU` on a processor takes each step's gradients apart in dozens of small operations, and a row that begins
anew ends its call. Here only the product with the recurrent weights is one of each step; gates' factors and the
gradients of the weights are of all steps at once. Values and gradients are those of `torch.nn.GRU`.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn


def run_gru(
    gru: nn.GRU, inputs: Float[Tensor, "T R I"], state: Float[Tensor, "R U"], is_first: Bool[Tensor, "T R"]
) -> Float[Tensor, "T R U"]:
    """Outputs of a GRU of one layer, the last of which is its next state; a row's memory is 0 before each step where
    `is_first`."""
    names = ("weight_ih_l0", "bias_ih_l0", "weight_hh_l0", "bias_hh_l0")
    of_input, input_bias, of_state, state_bias = (gru.get_parameter(name) for name in names)
    projected = F.linear(inputs, of_input, input_bias)
    outputs: object = _UnrolledGru.apply(  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
        projected, of_state, state_bias, state, is_first
    )
    assert isinstance(outputs, Tensor)
    return outputs


class _UnrolledGru(torch.autograd.Function):
    """h' = n + z (h - n), n = tanh(a_n + r g_n), r and z = sigmoid(a + g), where g = W h + b and a is of the inputs."""

    @staticmethod
    def forward(ctx: Any, projected: Tensor, weight: Tensor, bias: Tensor, state: Tensor, is_first: Tensor) -> Tensor:
        """(T, R, U) outputs; projected is (T, R, 3 U), in torch's order r, z, n."""
        time, rows, wide = projected.shape
        units = wide // 3
        anew: list[bool] = is_first.any(1).tolist()  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
        keep = (~is_first).to(projected.dtype).unsqueeze(-1)
        recurrent = projected.new_empty(time, rows, wide)
        gates, new = projected.new_empty(time, rows, 2 * units), projected.new_empty(time, rows, units)
        outputs = projected.new_empty(time, rows, units)
        transposed, hidden = weight.t(), state
        for t in range(time):
            if anew[t]:
                hidden = hidden * keep[t]
            torch.addmm(bias, hidden, transposed, out=recurrent[t])
            torch.add(projected[t, :, : 2 * units], recurrent[t, :, : 2 * units], out=gates[t]).sigmoid_()
            torch.addcmul(projected[t, :, 2 * units :], gates[t, :, :units], recurrent[t, :, 2 * units :], out=new[t])
            new[t].mul_(2.0).sigmoid_().mul_(2.0).sub_(1.0)  # tanh, which alone takes longer
            torch.lerp(new[t], hidden, gates[t, :, units:], out=outputs[t])
            hidden = outputs[t]
        before = torch.cat([state.unsqueeze(0), outputs[:-1]]).mul_(keep)
        ctx.save_for_backward(weight, before, gates, new, recurrent[..., 2 * units :], keep)
        ctx.anew = anew
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, gradient: Tensor
    ) -> tuple[Tensor | None, ...]:
        """Of projected, weight, bias and state."""
        weight, before, gates, new, recurrent_new, keep = ctx.saved_tensors
        time, rows, units = new.shape
        reset, update = gates.split(units, -1)
        # what a gradient of h' is multiplied by on its way to the sums inside of n, r, z and of the recurrent part of n
        to_new = (1.0 - update) * (1.0 - new * new)
        factors = torch.stack(
            [to_new * recurrent_new * reset * (1.0 - reset), (before - new) * update * (1.0 - update), to_new * reset],
            2,
        )
        spread, arrived = torch.empty_like(factors), torch.empty_like(new)
        carried = torch.zeros_like(new[0])
        for t in reversed(range(time)):
            torch.add(gradient[t], carried, out=arrived[t])
            torch.mul(factors[t], arrived[t].unsqueeze(1), out=spread[t])
            carried = torch.addmm(arrived[t] * update[t], spread[t].flatten(1), weight)
            if ctx.anew[t]:
                carried *= keep[t]
        flat = spread.view(time * rows, 3 * units)
        of_weight, of_bias = flat.t() @ before.flatten(0, 1), flat.sum(0)
        spread[:, :, 2] = arrived * to_new
        return spread.view(time, rows, 3 * units), of_weight, of_bias, carried, None
