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
    assert 1.0 <= sizes.member_bytes(config, spec) / (4 * numbers(*parts)) < 1.02


@pytest.mark.parametrize("overrides", [(), ("ppo.view=lossless", "ppo.cnn_kernels=[5,3,3]")], ids=" ".join)
@pytest.mark.parametrize(("method", "critics"), [("mappo", 1), ("lipo", 3), ("comedi", 5)])
def test_the_weights_of_the_baselines(method: str, critics: int, overrides: tuple[str, ...]) -> None:
    config, spec = configured(f"method={method}", "population.size=3", *overrides)
    ppo, view = config.ppo, spec.views[config.ppo.view]
    shape = Sizes(ppo.units, ppo.layers, ppo.activation, tuple(ppo.cnn_kernels), ppo.cnn_channels)
    actor = FeedForwardNet(view, spec.num_actions, 2, shape)
    critic = ValueNet(view, 2, shape, torch.Generator())
    real = 4 * (numbers(actor) + critics * numbers(critic))
    assert 1.0 <= sizes.member_bytes(config, spec) / real < 2.1  # a joint observation may be one player's


@pytest.mark.parametrize("method", ["xpm_wm", "xpm_sim"])
def test_the_buffers(method: str) -> None:
    config, spec = configured(f"method={method}", "scale=smoke", "replay.capacity=3000", "xpm_sim.capacity=3000")
    state = Replay(make_env(config.env.name, 1, **config.env.params), 3000, seed=0).state()["arrays"]
    # A buffer's arrays grow with what is in them: those of an empty one tell the bytes of a row.
    row = sum(array.dtype.itemsize * int(np.prod(array.shape[1:])) for array in state.values())
    assert row <= sizes.buffer_bytes(config, spec) / 6000 <= row + 8
    assert sizes.buffer_bytes(*configured("method=mappo")) == 0


def test_what_the_disk_must_hold() -> None:
    """Of two members: their checkpoints, that of the running one, and the population; MLflow's copy of it besides."""
    given = ("population.size=2", "replay.capacity=1000000")
    plain, spec = configured(*given, *OFF)
    buffers, weights = sizes.buffer_bytes(plain, spec), sizes.member_bytes(plain, spec)
    needed = sizes.disk_bytes(plain, spec)
    assert needed == 6 * buffers + (2 + 2 * 3 + 3 * 8) * weights + sizes.MARGIN
    assert sizes.disk_bytes(*configured(*given)) - needed == 2 * weights
    assert sizes.disk_bytes(*configured(*given, "tracking.uri=http://h")) == needed
    assert sizes.copy_bytes(plain, spec) - needed == 4 * buffers + 24 * weights


def test_a_copy_counts_where_buffers_are_written_whole() -> None:
    config, spec = configured("method=xpm_sim", "population.size=2", "xpm_sim.capacity=1000000", *OFF)
    small = config.model_copy(update={"xpm_sim": config.xpm_sim.model_copy(update={"capacity": 1})})
    grown = sizes.disk_bytes(config, spec) - sizes.disk_bytes(small, spec)
    assert grown == 3 * (sizes.buffer_bytes(config, spec) - sizes.buffer_bytes(small, spec)) > 0


def test_what_the_memory_must_hold() -> None:
    config, spec = configured("replay.capacity=1000000")
    more = config.model_copy(update={"replay": config.replay.model_copy(update={"capacity": 2_000_000})})
    buffers = sizes.buffer_bytes(config, spec)
    # In the replays, copied there for a checkpoint, in the object store on their way, and in the driver that writes it.
    assert sizes.memory_needed(more, spec) - sizes.memory_needed(config, spec) == 4 * buffers
    large = config.model_copy(update={"cluster": config.cluster.model_copy(update={"object_store_bytes": 2**34})})
    assert 2**34 + 3 * buffers <= sizes.memory_needed(large, spec) < 2**34 + 3 * buffers + 2**28


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
    sizes_of = ["ppo.envs=100", "ppo.steps=50", "diversity.xp_envs=8", "diversity.mp_envs=4", "population.size=3"]
    if "select" in overrides[-1]:
        sizes_of[:2] = ["ppo.envs=4", "ppo.steps=20"]
    config, spec = configured(*overrides, *sizes_of, "env.params.horizon=40")
    assert sizes.batch_bytes(config, spec) == steps * 2 * spec.views["features"].shape[0]


def test_a_finished_run_fits(model_run: Path) -> None:
    """A population on disk is no larger than was said."""
    config, spec = configured("scale=smoke", "population.size=2")
    found = sum(path.stat().st_size for path in (model_run / "population").rglob("*.safetensors"))
    assert 0 < found <= 2 * sizes.member_bytes(config, spec)
