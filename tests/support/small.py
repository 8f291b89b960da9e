"""Small sizes, environments and random data for the tests of the learning core."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from popgen.envs import BatchedEnv, make_env
from popgen.methods.xpm_wm.config import AgentConfig, WorldModelConfig
from popgen.methods.xpm_wm.latent_filter import Latent
from popgen.methods.xpm_wm.replay import Query, Replay, Windows
from popgen.play.rollout import Match, Sampler
from popgen.policies.simple_policies import RandomPolicy
from popgen.types import RANDOM_MEMBER, Kind

MODEL = WorldModelConfig(
    encoder_layers=1,
    decoder_layers=1,
    head_layers=1,
    units=16,
    deter=8,
    recurrent_units=12,
    groups=6,
    joint_groups=2,
    classes=4,
    batch=6,
    length=5,
    imagination="sample",
)
AGENT = AgentConfig(
    units=16, layers=1, horizon=3, starts_sp=6, starts_xp=4, bins=15, partner_random=0.0, precision="float32"
)
PRIVATE = ((2, 3), (4, 5))
"""Groups of MODEL that belong to player 0 and to player 1; 0 and 1 are joint."""


def kitchen(num_envs: int = 1, horizon: int = 20, **params: Any) -> BatchedEnv:
    return make_env("overcooked/cramped_room", num_envs, horizon=horizon, **params)


def random_latent(*lead: int, model: WorldModelConfig = MODEL, seed: int = 0) -> Latent:
    """States of a model of these sizes, with z one-hot."""
    generator = torch.Generator().manual_seed(seed)
    classes = torch.randint(model.classes, (*lead, model.groups), generator=generator)
    z = torch.nn.functional.one_hot(classes, model.classes).transpose(-1, -2).flatten(-2).float()
    return Latent(torch.randn(*lead, model.deter, generator=generator), z)


def with_other_group(latent: Latent, group: int, model: WorldModelConfig = MODEL) -> Latent:
    """The same states with the classes of one latent group moved on by one."""
    z = latent.z.clone().unflatten(-1, (model.classes, model.groups))
    z[..., group] = z[..., group].roll(1, dims=-1)
    return Latent(latent.h, z.flatten(-2))


def random_probs(*shape: int, seed: int = 0) -> Tensor:
    """Probabilities over the second to last dimension."""
    return torch.softmax(torch.randn(*shape, generator=torch.Generator().manual_seed(seed)), -2)


def random_play(env: BatchedEnv, steps: int, seed: int = 0) -> list:
    """One segment of uniformly random play in all environments of the batch."""
    match = Match(Kind.RANDOM, (RANDOM_MEMBER, RANDOM_MEMBER), env.num_envs)
    policies = {RANDOM_MEMBER: RandomPolicy(env.spec.num_actions)}
    return Sampler(env, [match], policies, name="random", seed=seed).collect(steps)[0]


def random_windows(count: int, length: int, *, view: str = "features", seed: int = 0) -> Windows:
    """Windows of random play in the cramped room."""
    replay = Replay(kitchen(), 2000, seed)
    for segment in random_play(kitchen(8), 60, seed):
        replay.add(segment, 1)
    return replay.windows(replay.sample(count, length, Query()), length, view)
