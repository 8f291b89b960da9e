"""Rollouts and critics small enough to work out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from popgen.envs.contract import ViewSpec
from popgen.methods.mappo.slots import Rollout
from popgen.nets.feed_forward import Sizes, ValueNet
from popgen.play.rollout import Match
from popgen.types import Kind

VIEW = ViewSpec((1,), "float32", False, swap=(0,))
"""One number for both players; a critic of it reads player 0's."""


def reads_observation() -> ValueNet:
    """The critic v = the observed number."""
    net = ValueNet(VIEW, 2, Sizes(layers=0), torch.Generator())
    with torch.no_grad():
        net[0].weight.copy_(torch.tensor([[1.0, 0.0, 0.0]]))
        net[0].bias.zero_()
    return net


def rollout(steps: int, *groups: Match, seed: int = 0, **given: Any) -> Rollout:
    """Random where nothing is given; the matches sit as they are, without switches or ends of episodes."""
    rng = np.random.default_rng(seed)
    count = sum(group.envs for group in groups)
    match = np.repeat([group.members for group in groups], [group.envs for group in groups], axis=0)
    values: dict[str, Any] = {
        "obs": rng.normal(size=(steps + 1, count, 2, 1)).astype(np.float32),
        "cut_at": np.zeros((0, 2), np.int64),
        "cut_obs": np.zeros((0, 2, 1), np.float32),
        "actions": rng.integers(0, 3, (steps, count, 2)).astype(np.uint8),
        "log_prob": rng.normal(size=(steps, count, 2)).astype(np.float32) - 2,
        "reward": rng.normal(size=(steps, count)).astype(np.float32),
        "score": np.zeros((steps, count), np.float32),
        "terminated": np.zeros((steps, count), bool),
        "truncated": np.zeros((steps, count), bool),
        "seats": np.broadcast_to(match, (steps, count, 2)).astype(np.int32),
        "episodes": (),
        "events": np.zeros((steps, count, 2, 0), np.uint8),
        "covered": np.ones((steps, count), np.float32),
    }
    return Rollout(matches=tuple(groups), **(values | given))


def sp(member: int, envs: int = 4) -> Match:
    return Match(Kind.SP, (member, member), envs, member)


def xp(first: int, second: int, envs: int = 2) -> Match:
    return Match(Kind.XP, (first, second), envs, max(first, second))


def mp(first: int, second: int, envs: int = 2) -> Match:
    return Match(Kind.MP, (first, second), envs, max(first, second))
