from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from popgen.envs.overcooked import OvercookedEnv
from popgen.humans.clone_policy import ClonePolicy, CloneSettings
from popgen.methods.ego.ego_networks import EgoSizes
from popgen.methods.ego.ego_policy import EgoPolicy
from popgen.policies import portable_kernels as k
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.portable_program import ProgramWriter, read_program, write_program
from popgen.policies.program_runner import ProgramRunner
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy

ENV = OvercookedEnv("cramped_room", 1, horizon=30)


def run_program(program: Any, steps: int, actions: int = 6, seed: int = 0) -> list[int]:
    runner = ProgramRunner(program, actions)
    runner.begin(0, seed)
    obs = ENV.encode(ENV.kitchen.start[None])[0]
    return [runner.act(obs, np.zeros(2, np.uint8), first=step == 0) for step in range(steps)]


def test_the_arithmetic_is_that_of_the_library() -> None:
    x = np.linspace(-30, 30, 601)
    for number, wanted in enumerate((np.tanh(x), np.where(x >= 0, x, x * k.LEAK), x / (1 + np.exp(-x)))):
        found = x.copy()
        k.apply_activation(number, found)
        np.testing.assert_allclose(found, wanted, rtol=1e-14, atol=1e-16)
    logits, out = np.array([0.0, -1.0, -np.inf, -800.0]), np.zeros(4)
    k.fill_probabilities(logits, 0.0, out)
    np.testing.assert_allclose(out, [1 / (1 + np.exp(-1)), 1 / (1 + np.e), 0, 0], rtol=1e-15)


def test_sums_keep_the_order_of_their_terms() -> None:
    weight = np.array([[1e8], [1.0], [-1e8]], np.float32)
    out = np.zeros(1)
    k.apply_linear(weight, np.array([1.0], np.float32), np.array([1.0, 1e-9, 1.0]), out)
    assert out[0] == ((1.0 + 1e8) + 1e-9) - 1e8  # 1.0: the small term is lost on the way


@pytest.mark.parametrize(("uniform", "action"), [(0.0, 1), (0.2499, 1), (0.25, 3), (0.9999999, 3)])
def test_an_action_by_hand(uniform: float, action: int) -> None:
    assert k.invert_distribution(np.array([0.0, 0.25, 0.0, 0.75, 0.0]), uniform) == action


def test_a_grus_step_is_pytorchs() -> None:
    torch.manual_seed(0)
    gru, inputs, memory = torch.nn.GRU(3, 4), torch.randn(3), torch.randn(4)
    wanted = gru(inputs.view(1, 1, 3), memory.view(1, 1, 4))[1].flatten().detach().numpy()
    parts = [gru.get_parameter(f"{name}_l0").detach().double() for name in ("weight_ih", "bias_ih")]
    other = [gru.get_parameter(f"{name}_l0").detach().double() for name in ("weight_hh", "bias_hh")]
    found = memory.double().numpy()
    gates = [(weight @ value.double() + bias).numpy() for (weight, bias), value in ((parts, inputs), (other, memory))]
    k.advance_gru(*gates, found)
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_a_file_holds_the_whole_program() -> None:
    written = write_program(FeedForwardPolicy(ENV.spec.views["features"], 6, units=8, seed=1))
    again = read_program(written.to_bytes())
    assert again.operations == written.operations and again.memories == written.memories
    assert run_program(again, 20) == run_program(written, 20)
    with pytest.raises(ValueError, match="no program"):
        read_program(b"\x02\x00\x00\x00\x00\x00\x00\x00{}")


def test_simple_policies_as_programs() -> None:
    assert run_program(write_program(IdlePolicy(ENV.spec.action_names)), 5) == [4] * 5
    drawn = run_program(write_program(RandomPolicy(6, [0.5, 0.0, 0.0, 0.0, 0.0, 0.5])), 200)
    assert set(drawn) == {0, 5} and 70 < drawn.count(0) < 130


def test_a_held_entry_stays_for_its_steps() -> None:
    writer = ProgramWriter()
    logits = writer.add_linear("seat", torch.zeros(2, 2))
    held = writer.add_operation("hold", logits, least=3, most=3)
    program = writer.finish(writer.add_linear(held, 50.0 * torch.eye(2)))  # the action is the entry
    drawn = run_program(program, 300, actions=2)
    assert all(len(set(drawn[start : start + 3])) == 1 for start in range(0, 300, 3)) and len(set(drawn)) == 2


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda: EgoPolicy(EgoSizes("conv_lstm", units=8), ENV.spec), "'conv_lstm' has no program"),
        (lambda: ClonePolicy(ENV.spec, CloneSettings()), "'human_clone' have no program"),
        (
            lambda: FeedForwardPolicy(ENV.spec.views["lossless"], 6, kernels=[3], units=8, name="lossless"),
            "reads the view 'lossless'",
        ),
    ],
    ids=["conv_lstm", "human_clone", "grid"],
)
def test_what_has_no_program_says_why(make: Any, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        write_program(make())
