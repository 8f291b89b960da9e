from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from popgen.cli import main
from popgen.envs.overcooked import OvercookedEnv
from popgen.envs.overcooked import kernels as k
from popgen.errors import UserError
from popgen.methods.ego.ego_networks import EgoSizes
from popgen.methods.ego.ego_policy import EgoPolicy, HierarchicalEgoPolicy
from popgen.methods.registry import recipe
from popgen.methods.xpm_sim.encoded_policy import EncodedPolicy
from popgen.methods.xpm_wm.actor_critic import WorldModelPolicy
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.program_runner import ProgramRunner
from popgen.study import browser_check
from popgen.study.browser_check import check_ego, check_transitions, draw_transitions, open_kitchens
from popgen.study.script_engine import ScriptEngine, find_engine, open_engine

needs_engine = pytest.mark.skipif(find_engine() is None, reason="needs Node or Chromium")


@pytest.fixture(scope="module")
def engine() -> Iterator[ScriptEngine]:
    with open_engine() as found:
        yield found


@needs_engine
@pytest.mark.parametrize("cooking", browser_check.MODES)
@pytest.mark.parametrize("layout", ["cramped_room", "counter_circuit_o_1order", "m_shaped_s"])
def test_rules_of_the_browser_are_the_simulators(engine: ScriptEngine, layout: str, cooking: str) -> None:
    env = OvercookedEnv(layout, 1, cooking=cooking)
    found = check_transitions(engine, env, draw_transitions(env, 600, np.random.default_rng(0)))
    assert (found.transitions, found.differing) == (600, 0)


@needs_engine
def test_a_wrong_rule_is_found(engine: ScriptEngine, monkeypatch: pytest.MonkeyPatch) -> None:
    env = OvercookedEnv("cramped_room", 1)
    told = browser_check.export_kitchen(env)
    told["table"][k.COOK * 256 + k.FIRST_SOUP + 5] += 1  # one soup cooks a step longer
    monkeypatch.setattr(browser_check, "export_kitchen", lambda _: told)
    found = check_transitions(engine, env, draw_transitions(env, 2000, np.random.default_rng(0)))
    assert 0 < found.differing < 2000


def test_random_transitions_meet_every_event() -> None:
    env = OvercookedEnv("cramped_room", 1)
    played = draw_transitions(env, 4000, np.random.default_rng(0))
    _, result = env.simulate(played.states, played.actions)
    assert result.events.any((0, 1)).all() and result.score.max() >= 1
    assert (played.states[:, 0] != played.states[:, 1]).all()


def test_layouts_come_in_the_modes_that_they_allow() -> None:
    found = {(env.layout.name, env.cooking) for env in open_kitchens()}
    assert {("cramped_room", "auto"), ("cramped_room", "interact")} <= found and len(found) > 40
    with pytest.raises(UserError, match="unknown layout"):
        next(open_kitchens(["no_such_layout"]))


@needs_engine
def test_the_command_counts(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["study", "check-browser", "--layout", "cramped_room", "--transitions", "100", "--no-people", "--json"]
    assert main(words) == 0
    told = SimpleNamespace(**json.loads(capsys.readouterr().out))
    assert (told.transitions, told.differing, len(told.kitchens)) == (100, 0, 2)


def test_an_engine_that_is_none_is_named() -> None:
    with open_engine("/bin/false") as broken, pytest.raises(UserError, match="false: gave no answer"):
        broken.run_task("transitions", {})


ENV = OvercookedEnv("coordination_ring", 1, horizon=50)


def make_world_model() -> Any:
    config: Any = recipe("xpm_wm", "overcooked/coordination_ring", "smoke")
    return WorldModelPolicy(config.world_model, config.agent, ENV.spec)


FAMILIES: dict[str, Callable[[], Any]] = {
    "feed_forward": lambda: FeedForwardPolicy(ENV.spec.views["features"], 6, units=16),
    "encoded": lambda: EncodedPolicy(
        ENV.spec.views["features"], 6, latent=8, encoder_units=16, encoder_layers=1, units=16
    ),
    "ego": lambda: EgoPolicy(EgoSizes(units=16), ENV.spec),
    "hierarchical_ego": lambda: HierarchicalEgoPolicy(
        EgoSizes(units=16, skills=3), ENV.spec, duration_least=3, duration_most=6
    ),
    "world_model": make_world_model,
}


def sharpen_weights(policy: Any) -> None:
    """So that actions are far from equally likely."""
    generator = torch.Generator().manual_seed(0)
    net = policy._parts if hasattr(policy, "_parts") else policy.net
    for parameter in net.parameters():
        parameter.data.add_(0.2 * torch.randn(parameter.shape, generator=generator))


@needs_engine
@pytest.mark.parametrize("family", FAMILIES)
def test_egos_act_in_the_browser_as_here(engine: ScriptEngine, family: str) -> None:
    policy = FAMILIES[family]()
    sharpen_weights(policy)
    found = check_ego(engine, ENV, policy, 2, 0)
    assert (found.states, found.differing, found.network) == (100, 0, 0) and found.furthest < 1e-5


@needs_engine
def test_another_ego_is_found(engine: ScriptEngine, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, other = (FeedForwardPolicy(ENV.spec.views["features"], 6, units=16, seed=seed) for seed in (0, 1))
    monkeypatch.setattr(browser_check, "ProgramRunner", lambda *_: ProgramRunner(other.to_program(), 6))
    assert check_ego(engine, ENV, policy, 1, 0).differing == 50
