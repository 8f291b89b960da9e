"""Bytes that a run needs, against the networks, buffers and files themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.envs.contract import EnvSpec
from popgen.methods.xpm_wm.actor_critic import Actor, Critic
from popgen.methods.xpm_wm.replay import Replay
from popgen.methods.xpm_wm.world_model import WorldModel
from popgen.nets.feed_forward import FeedForwardNet, Sizes, ValueNet
from popgen.runs import sizes

OFF = ("tracking=off",)


def configured(*overrides: str) -> tuple[RunConfig, EnvSpec]:
    config = RunConfig.parse(compose(overrides))
    return config, make_env(config.env.name, 1, **config.env.params).spec


def numbers(*modules: nn.Module) -> int:
    """What a saved member holds of them."""
    return sum(tensor.numel() for module in modules for tensor in module.state_dict().values())


@pytest.mark.parametrize(
    "overrides",
    [("scale=smoke",), (), ("world_model.view=lossless",), ("world_model.recurrent_units=0", "population.size=5")],
    ids=" ".join,
)
def test_the_weights_of_a_world_model_and_its_agent(overrides: tuple[str, ...]) -> None:
    config, spec = configured(*overrides)
    parts: list[nn.Module] = [WorldModel(config.world_model, spec), Actor(config.agent, config.world_model, 6)]
    parts += [Critic(config.agent, config.world_model) for _ in range(config.population.size)]
    assert sizes.needs_of(config, spec).member == 4 * numbers(*parts)


@pytest.mark.parametrize("overrides", [(), ("ppo.view=lossless", "ppo.cnn_kernels=[5,3,3]")], ids=" ".join)
@pytest.mark.parametrize(("method", "critics"), [("mappo", 1), ("lipo", 3), ("comedi", 5)])
def test_the_weights_of_the_baselines(method: str, critics: int, overrides: tuple[str, ...]) -> None:
    config, spec = configured(f"method={method}", "population.size=3", *overrides)
    ppo, view = config.ppo, spec.views[config.ppo.view]
    shape = Sizes(ppo.units, ppo.layers, ppo.activation, tuple(ppo.cnn_kernels), ppo.cnn_channels)
    actor = FeedForwardNet(view, spec.num_actions, 2, shape)
    critic = ValueNet(view, 2, shape, torch.Generator())
    real = 4 * (numbers(actor) + critics * numbers(critic))
    # All but the three numbers of the statistics by which each critic normalises its returns.
    assert sizes.needs_of(config, spec).member == real - 4 * 3 * critics


@pytest.mark.parametrize(("method", "capacity"), [("xpm_wm", "replay.capacity"), ("xpm_sim", "xpm_sim.capacity")])
def test_the_buffers(method: str, capacity: str) -> None:
    config, spec = configured(f"method={method}", "scale=smoke", f"{capacity}=3000")
    state = Replay(make_env(config.env.name, 1, **config.env.params), 3000, seed=0).state()["arrays"]
    # A buffer's arrays grow with what is in them: those of an empty one tell the bytes of a row.
    row = sum(array.dtype.itemsize * int(np.prod(array.shape[1:])) for array in state.values())
    assert row <= sizes.needs_of(config, spec).buffers / 6000 <= row + 8
    assert sizes.needs_of(*configured("method=mappo")).buffers == 0


def on_disk(*overrides: str) -> int:
    config, spec = configured(*overrides)
    return sizes.disk_bytes(config, sizes.needs_of(config, spec))


def test_what_the_disk_must_hold() -> None:
    """Of two members: their checkpoints, that of the running one, and the population; MLflow's copy of it besides."""
    given = ("population.size=2", "replay.capacity=1000000")
    plain, spec = configured(*given, *OFF)
    needs = sizes.needs_of(plain, spec)
    buffers, weights = needs.buffers, needs.member
    needed = sizes.disk_bytes(plain, needs)
    assert needed == 6 * buffers + (2 + 2 * 3 + 3 * 8) * weights + sizes.MARGIN
    assert on_disk(*given) - needed == 2 * weights
    assert on_disk(*given, "tracking.uri=http://h") == needed
    assert sizes.copy_bytes(plain, needs) - needed == 4 * buffers + 24 * weights


def test_a_copy_counts_where_buffers_are_written_whole() -> None:
    given = ("method=xpm_sim", "population.size=2", *OFF)
    large, small = (sizes.needs_of(*configured(*given, f"xpm_sim.capacity={count}")) for count in (1_000_000, 1))
    grown = on_disk(*given, "xpm_sim.capacity=1000000") - on_disk(*given, "xpm_sim.capacity=1")
    assert grown == 3 * (large.buffers - small.buffers) > 0


def test_members_that_learn_together_are_checkpointed_together() -> None:
    together, alone = (sizes.needs_of(*configured(f"method={name}", "population.size=4")) for name in ("lipo", "mappo"))
    assert (together.together, alone.together) == (4, 1)


def test_what_the_memory_must_hold() -> None:
    config, spec = configured("replay.capacity=1000000")
    needs, twice = sizes.needs_of(config, spec), sizes.needs_of(*configured("replay.capacity=2000000"))
    # In the replays, copied there for a checkpoint, in the object store on their way, and in the driver that writes it.
    assert sizes.memory_needed(config, twice) - sizes.memory_needed(config, needs) == 4 * needs.buffers
    large = config.model_copy(update={"cluster": config.cluster.model_copy(update={"object_store_bytes": 2**34})})
    assert 2**34 + 3 * needs.buffers <= sizes.memory_needed(large, needs) < 2**34 + 3 * needs.buffers + 2**28


@pytest.mark.parametrize(
    ("overrides", "steps"),
    [
        (["method=mappo"], 2 * 51 * 100),
        (["method=lipo"], 2 * 51 * (3 * 100 + 3 * 8)),  # all together: three pairs
        (["method=lipo", "diversity.order=sequential"], 2 * 51 * (100 + 2 * 8)),
        (["method=comedi"], 2 * 51 * (100 + 2 * (8 + 4))),
        (["method=comedi", "diversity.lambda_mp=0"], 2 * 51 * (100 + 2 * 8)),
        (["method=comedi", "diversity.select_episodes=50"], 41 * 2 * 50 * 2),  # fresh episodes with two partners
    ],
)
def test_what_a_baseline_learns_from_at_once(overrides: list[str], steps: int) -> None:
    sizes_of = ["ppo.envs=100", "ppo.steps=50", "population.size=3"]
    if "method=mappo" not in overrides:
        sizes_of += ["diversity.xp_envs=8", "diversity.mp_envs=4"]
    if "select" in overrides[-1]:
        sizes_of[:2] = ["ppo.envs=4", "ppo.steps=20"]
    config, spec = configured(*overrides, *sizes_of, "env.params.horizon=40")
    assert sizes.needs_of(config, spec).batch == steps * 2 * spec.views["features"].shape[0]


def test_a_finished_run_fits(model_run: Path) -> None:
    """A population on disk is no larger than was said."""
    config, spec = configured("scale=smoke", "population.size=2")
    found = sum(path.stat().st_size for path in (model_run / "population").rglob("*.safetensors"))
    assert 0 < found <= 2 * sizes.needs_of(config, spec).member
