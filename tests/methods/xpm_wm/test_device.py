"""Learners on a device that this machine need not have: every tensor that they make is told where to be."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from support.small import AGENT, MODEL, kitchen, random_windows
from torch.overrides import TorchFunctionMode

from popgen.actors.actor_setup import device_of
from popgen.errors import UserError
from popgen.methods.xpm_wm.actor_critic import Actor
from popgen.methods.xpm_wm.agent import AgentLearner
from popgen.methods.xpm_wm.config import OPEN_LOOP
from popgen.methods.xpm_wm.imagination import NEW_XP, OLD
from popgen.methods.xpm_wm.model_report import model_report
from popgen.methods.xpm_wm.world_model import ModelLearner, Starts
from popgen.nets import weights as w

SPEC = kitchen().spec
MAKERS = {getattr(torch, n) for n in ("zeros", "ones", "full", "empty", "eye", "arange", "linspace", "tensor", "rand")}
_from_numpy = torch.from_numpy


class Loose(AssertionError):
    """A tensor was made wherever torch makes them."""


class DeviceRequired(TorchFunctionMode):
    """Refuses to make a tensor without a device."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in MAKERS and (kwargs or {}).get("device") is None:
            raise Loose(func.__name__)
        return func(*args, **(kwargs or {}))


class Array:
    """Stands in for a tensor on an array's memory: it has to be moved before anything else."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array

    def to(self, device: Any, *more: Any) -> torch.Tensor:
        assert isinstance(device, torch.device)
        return _from_numpy(self.array).to(device, *more)


@pytest.fixture
def devices_given(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(torch, "from_numpy", Array)
    with DeviceRequired():
        yield


def agent() -> AgentLearner:
    learner = AgentLearner(AGENT, MODEL, SPEC, member=2, seed=0, device="cpu")
    learner.add_partner(1, w.weights_of(Actor(AGENT, MODEL, SPEC.num_actions)))
    count = 40
    pool = np.resize([OLD, NEW_XP], count).astype(np.uint8)
    z = np.zeros((count, MODEL.groups), np.uint8)
    partner = (pool == NEW_XP).astype(np.int16)
    learner.set_starts(Starts(np.zeros((count, MODEL.deter), np.float32), z, pool, partner), 0.5)
    return learner


@pytest.fixture(scope="module")
def learners() -> tuple[AgentLearner, ModelLearner]:
    """With a partner and a predecessor, so that all terms are there."""
    model = ModelLearner(MODEL.model_copy(update={"kl_predecessors": 1.0, "predecessors": "all"}), SPEC, 0, "cpu")
    model.add_predecessor(1, w.weights_of(model.model.filter))
    return agent(), model


def test_the_agent_makes_its_tensors_on_its_device(
    learners: tuple[AgentLearner, ModelLearner], devices_given: None
) -> None:
    assert learners[0].update()["partner"] == 1.0


def test_the_world_model_makes_its_tensors_on_its_device(
    learners: tuple[AgentLearner, ModelLearner], devices_given: None
) -> None:
    learner, windows = learners[1], random_windows(6, MODEL.length + OPEN_LOOP)
    learner.set_biases(windows)
    _, seen = learner.update(windows)
    learner.starts(seen, windows, 8, pool=OLD)
    model_report(learner, windows, context=MODEL.length)


def test_a_tensor_made_anywhere_would_be_noticed(devices_given: None) -> None:
    with pytest.raises(Loose, match="zeros"):
        torch.zeros(3)
    with pytest.raises(AttributeError):
        torch.from_numpy(np.zeros(3)).float()


def test_a_learner_without_a_card_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert device_of(0.0) == "cpu"
    with pytest.raises(UserError, match="torch sees none"):
        device_of(0.5)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert device_of(1.0) == "cuda"
