"""A member's time is that of all attempts which its result is of."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from popgen.envs import make_env
from popgen.methods.registry import recipe
from popgen.methods.training import Checkpoint, Ready
from popgen.methods.xpm_sim import train as xpm_sim
from popgen.methods.xpm_sim.agent import make_actor
from popgen.methods.xpm_wm import member_training as xpm_wm
from popgen.methods.xpm_wm.phase2 import LaterMemberProgress
from popgen.methods.xpm_wm.real_play import Candidate, MemberWeights
from popgen.runs.checkpoints import resolve_handles

WEIGHTS = {"w": np.zeros(2)}


def open_world_model() -> Any:
    """Member 2, after a round."""
    config = recipe("xpm_wm", "overcooked/cramped_room", "smoke")
    work = MagicMock(put=Ready)
    work.state.return_value = {}
    work.published_form.return_value = dict.fromkeys(("acting", "model", "critics"), WEIGHTS)
    training = xpm_wm.XpmWmTraining(config, make_env(config.env.name, 1).spec, work)  # type: ignore[arg-type]
    training.begin(2)
    assert isinstance(training.progress, LaterMemberProgress)
    training.progress.best = Candidate(MemberWeights(*(Ready(WEIGHTS) for _ in range(3))), 1.0, 0.0)
    return training


def open_simulation() -> Any:
    config = recipe("xpm_sim", "rendezvous/mppmr", "smoke")
    spec = make_env(config.env.name, 1).spec
    work = MagicMock(put=Ready)
    work.state.return_value = {}
    work.begin_member.return_value = Ready(make_actor(config.xpm_sim, spec).weights())  # type: ignore[attr-defined]
    training = xpm_sim.XpmSimTraining(config, spec, "run.1", work)  # type: ignore[arg-type]
    training.begin(1)
    return training


@pytest.mark.parametrize(("module", "opened"), [(xpm_wm, open_world_model), (xpm_sim, open_simulation)])
def test_seconds_go_on_after_an_interruption(module: Any, opened: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """30 s to the checkpoint, an hour of nothing, 5 s more."""
    clock = SimpleNamespace(now=100.0, time=lambda: clock.now)
    monkeypatch.setattr(module, "time", clock)
    before = opened()
    clock.now = 130.0
    state = resolve_handles(before.checkpoint())
    clock.now = 3730.0
    after = opened()
    after.restore(Checkpoint(state))
    clock.now = 3735.0
    assert after.checkpoint()["seconds"] == pytest.approx(35.0)
