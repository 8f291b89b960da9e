"""FCP: which policies a seed leaves behind, each with the score of its own play, and whose the time is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.stand_in_mappo import StandInMappo

from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.methods.mappo import train as module
from popgen.methods.mappo.fcp import FcpTraining
from popgen.methods.mappo.play_record import Counted
from popgen.methods.skill_checkpoints import SkillCheckpoint
from popgen.methods.training import Checkpoint, Round, TrainedMember
from popgen.types import SKILLS, Kind

SPEC = make_env("overcooked/cramped_room", 1, horizon=40).spec
STEPS = 80
RATES = (0.0, 1.0, 3.0, 6.0, 9.0, 10.0)
"""Dishes an episode of the policy that plays iteration 1, 2, ..."""
TOLD = (0.0, 0.0, 0.5, 2.0, 4.5, 8.0)
"""What the latest episodes say then: those of older policies."""


def play_at(rate: float, steps: int = STEPS) -> Counted:
    """An iteration in which a policy of this score plays; none of its figures but `earned` tells the score."""
    return Counted(0, 3, Kind.SP, steps, 2, 0.0, earned=rate * steps / 40, covered=float(steps))


def make_training(monkeypatch: pytest.MonkeyPatch) -> FcpTraining:
    config: Any = RunConfig.parse({"method": "fcp", "population": {"size": 3}, "ppo": {"units": 8, "layers": 1}})
    training = FcpTraining(config, SPEC, "test.1")
    stand_in = StandInMappo(SPEC, config.ppo, (3,), [[play_at(rate)] for rate in RATES], {3: TOLD})
    monkeypatch.setattr(module, "build_algorithm", lambda *given: stand_in)
    assert training.begin(1) == (1, 2, 3)
    return training


def members_of(training: FcpTraining) -> list[TrainedMember]:
    return [record for record in training.train() if isinstance(record, TrainedMember)]


def updates_behind(member: TrainedMember) -> float:
    """The stand-in's actors are filled with the number of updates before them."""
    values = {float(value) for array in member.policy.weights().values() for value in np.unique(array)}
    assert len(values) == 1
    return values.pop()


def test_the_half_trained_member_is_the_policy_that_played_its_score(monkeypatch: pytest.MonkeyPatch) -> None:
    """The final one has 8: half of it is 4, and the policy with 3 is nearest, which played iteration 3 after two
    updates. By the latest episodes it would be the one after five updates."""
    initial, half, final = members_of(make_training(monkeypatch))
    assert [updates_behind(one) for one in (initial, half, final)] == [0.0, 2.0, 6.0]
    assert (half.extra["sp"], half.extra["at_steps"]) == (3.0, 2 * STEPS)
    assert (initial.extra["sp"], initial.extra["at_steps"]) == (0.0, 0)
    assert [one.extra["skill"] for one in (initial, half, final)] == list(SKILLS) and final.extra["sp"] == 8.0


def test_every_policy_is_kept_with_the_steps_before_it_and_its_own_score(monkeypatch: pytest.MonkeyPatch) -> None:
    training = make_training(monkeypatch)
    members_of(training)
    kept: list[SkillCheckpoint] = training.skills.kept
    assert [(one.steps, one.score) for one in kept] == [(number * STEPS, rate) for number, rate in enumerate(RATES)]
    assert [float(next(iter(one.actor.values())).flat[0]) for one in kept] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_the_untrained_and_the_half_trained_took_no_time_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A seed's time is that of its final member: the sum over all three is known."""
    training = make_training(monkeypatch)
    monkeypatch.setattr(training, "_count_seconds", lambda: 30.0)
    assert [one.extra["seconds"] for one in members_of(training)] == [0.0, 0.0, 30.0]


def test_an_iteration_that_nobody_played_keeps_no_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    training = make_training(monkeypatch)
    algorithm: Any = training.algorithm
    algorithm.iterations = [[play_at(0.0)], [], [play_at(2.0)]]
    members_of(training)
    assert [(one.steps, one.score) for one in training.skills.kept] == [(0, 0.0), (STEPS, 2.0)]


def test_a_seed_goes_on_from_its_checkpoint_with_the_same_policies(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = make_training(monkeypatch)
    members_of(whole)
    early = make_training(monkeypatch)
    next(record for record in early.train() if isinstance(record, Round) and record.number == 3)
    again = make_training(monkeypatch)
    again.restore(Checkpoint(early.checkpoint()))
    members_of(again)
    for one, other in zip(whole.skills.kept, again.skills.kept, strict=True):
        assert (one.steps, one.score) == (other.steps, other.score)
        assert all((one.actor[name] == other.actor[name]).all() for name in one.actor)
