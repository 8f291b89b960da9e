from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from popgen.nets import weights as w


def net(seed: int) -> nn.Sequential:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4))


def test_weights_are_copies_and_load_back() -> None:
    source, target = net(0), net(1)
    saved = w.weights_of(source)
    with torch.no_grad():
        source[0].weight.zero_()
    w.load_weights(target, saved)
    assert saved["0.weight"].any()
    assert all(np.array_equal(value, saved[name]) for name, value in w.weights_of(target).items())
    with torch.no_grad():
        target[0].weight.zero_()
    assert saved["0.weight"].any()


def test_read_only_arrays_load() -> None:
    saved = w.weights_of(net(0))
    for array in saved.values():
        array.setflags(write=False)
    w.load_weights(net(1), saved)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"0.bias": None}, r"tensor '0\.bias' is missing"),
        ({"extra": np.zeros(1, np.float32)}, r"tensor 'extra' is not one of the policy's"),
        ({"0.bias": np.zeros(5, np.float32)}, r"tensor '0\.bias' has shape \(5,\), expected \(4,\)"),
        ({"0.bias": np.zeros(4)}, r"tensor '0\.bias' is torch\.float64, expected torch\.float32"),
    ],
)
def test_weights_that_do_not_fit_are_named_and_change_nothing(change: dict[str, Any], message: str) -> None:
    module, given = net(0), w.weights_of(net(1)) | change
    before = w.weights_of(module)
    with pytest.raises(ValueError, match=message):
        w.load_weights(module, {name: value for name, value in given.items() if value is not None})
    assert all(np.array_equal(value, before[name]) for name, value in w.weights_of(module).items())


def test_cast_brings_weights_to_the_modules_precision() -> None:
    module, saved = net(0).to(torch.bfloat16), w.weights_of(net(1))
    with pytest.raises(ValueError, match="float32, expected torch.bfloat16"):
        w.load_weights(module, saved)
    w.load_weights(module, saved, cast=True)
    torch.testing.assert_close(module[0].weight.float(), torch.from_numpy(saved["0.weight"]), rtol=0.01, atol=0)


def test_prefixes() -> None:
    merged = w.prefixed("filter", {"a": np.ones(1)}) | w.prefixed("filters", {"a": np.zeros(1)})
    assert merged.keys() == {"filter.a", "filters.a"}
    assert w.under("filter", merged) == {"a": np.ones(1)}


def test_an_optimiser_goes_on_where_it_was() -> None:
    def step(module: nn.Module, optimiser: torch.optim.Optimizer, seed: int) -> None:
        optimiser.zero_grad()
        module(torch.randn(5, 3, generator=torch.Generator().manual_seed(seed))).square().sum().backward()
        optimiser.step()

    first = net(0)
    optimiser = torch.optim.Adam(first.parameters(), lr=0.1)
    for seed in range(3):
        step(first, optimiser, seed)
    second = net(1)
    w.load_weights(second, w.weights_of(first))
    again = torch.optim.Adam(second.parameters(), lr=0.1)
    w.load_optimiser_state(again, w.optimiser_state(optimiser))
    step(first, optimiser, 7)
    step(second, again, 7)
    assert all(
        np.array_equal(a, b) for a, b in zip(w.weights_of(first).values(), w.weights_of(second).values(), strict=True)
    )


@pytest.mark.parametrize(("most", "left"), [(0.0, [3.0, 4.0]), (10.0, [3.0, 4.0]), (1.0, [0.6, 0.8])])
def test_a_gradient_is_scaled_down_to_the_bound_and_0_is_none(most: float, left: list[float]) -> None:
    parameter = nn.Parameter(torch.zeros(2))
    parameter.grad = torch.tensor([3.0, 4.0])
    assert float(w.clip_gradients([parameter], most)) == 5.0
    torch.testing.assert_close(parameter.grad, torch.tensor(left), atol=1e-6, rtol=0)


def test_a_fused_optimiser_steps_like_the_plain_one_and_goes_on_from_its_state() -> None:
    """Of 60 steps, 30 from the plain one's moments; the order of additions differs."""
    plain, fused = (torch.nn.Parameter(torch.linspace(-1.0, 1.0, 50)) for _ in range(2))
    one, other = torch.optim.Adam([plain], lr=0.01), torch.optim.Adam([fused], lr=0.01, fused=True)
    for step in range(60):
        if step == 30:
            w.load_optimiser_state(other, w.optimiser_state(one))
        for parameter, optimiser in ((plain, one), (fused, other)):
            optimiser.zero_grad()
            (parameter - 0.3).pow(2).sum().backward()
            optimiser.step()
    assert torch.allclose(plain, fused, atol=1e-5)
