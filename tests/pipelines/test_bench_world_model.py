"""Speed of XPM-WM's learners: parts add up, operations are those of the products."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.pipelines.bench_world_model import bench_world_model, measure_update, part_of


def test_operators_are_sorted_by_what_they_do() -> None:
    wanted = {
        "aten::addmm": "products",
        "aten::mm": "products",
        "aten::_fused_adam_": "optimiser",
        "aten::copy_": "casts and copies",
        "aten::cat": "joining",
        "aten::silu": "other",
    }
    assert {operator: part_of(operator) for operator in wanted} == wanted


def test_operations_are_those_of_the_products_of_one_update() -> None:
    """A product of (7, 5) and (5, 3): 2 * 7 * 5 * 3."""
    layer, inputs = nn.Linear(5, 3, bias=False).requires_grad_(False), torch.ones(7, 5)
    measured = measure_update(lambda: layer(inputs), 0.0)
    assert measured.operations == 210 and sum(measured.shares.values()) == pytest.approx(1.0)
    row = measured.as_row(1e9)
    assert sum(row["parts"].values()) == pytest.approx(row["milliseconds"])
    assert row["share_of_peak"] == pytest.approx(row["flops"] / 1e9)


@pytest.mark.end_to_end
def test_both_learners_are_measured_in_every_size() -> None:
    config = RunConfig.parse(compose(["method=xpm_wm", "scale=smoke"]))
    result = bench_world_model({"small": config}, seconds=0.01)  # type: ignore[dict-item]
    assert set(result["peaks"]) == {"float32", "bfloat16"} and min(result["peaks"].values()) > 0
    for learner in ("world_model", "agent"):
        row = result["sizes"]["small"][learner]
        assert row["milliseconds"] > 0 and row["parts"]["products"] > 0 and row["parts"]["optimiser"] > 0
