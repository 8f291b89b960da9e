"""FCP, MEP and TrajeDi: what they add to self-play, and that nothing is left of it where it weighs nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.rollouts import VIEW, reads_observation, rollout, sp

from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.methods.mappo.mep import SurpriseBonus
from popgen.methods.mappo.needs import check_fcp
from popgen.methods.mappo.pooling import Plan, gather, pool
from popgen.methods.mappo.population_bonus import joint_log_probs
from popgen.methods.mappo.trajedi import DivergenceBonus
from popgen.methods.registry import METHODS
from popgen.methods.skill_checkpoints import KEPT, SkillCheckpoint, SkillCheckpoints
from popgen.nets.feed_forward import FeedForwardNet, Sizes
from popgen.play.trajectories import Trajectories
from popgen.types import Kind

OPTIONS: dict[str, Any] = {"discount": 0.5, "lam": 0.5, "value_decay": 0.0}


def actors(count: int) -> dict[int, FeedForwardNet]:
    torch.manual_seed(3)
    return {member: FeedForwardNet(VIEW, 6, 2, Sizes(8, 1)) for member in range(1, count + 1)}


def self_play() -> Trajectories:
    found = gather([rollout(7, sp(2))], Kind.SP, 2, 2)
    assert found is not None
    return found.steps


def test_log_probs_are_those_of_each_members_actor_at_each_seat() -> None:
    nets, steps = actors(3), self_play()
    found = joint_log_probs(steps, 2, nets)
    assert found.own == 1 and found.seats.shape == (3, *steps.actions.shape)
    for k, member in enumerate(nets):
        for t, column, seat in np.ndindex(*steps.actions.shape):
            logits = nets[member](steps.obs[t, column, seat][None], torch.eye(2)[seat][None])[0]
            expected = torch.log_softmax(logits, -1)[int(steps.actions[t, column, seat])]
            torch.testing.assert_close(found.seats[k, t, column, seat], expected)


@pytest.mark.parametrize("bonus", [SurpriseBonus(0.3, 1e-5), DivergenceBonus(0.3, 0.5)])
def test_a_bonus_is_a_reward_before_advantages(bonus: Any) -> None:
    """The batch equals that of a rollout whose reward had the plan's share of the bonus in it."""
    nets = actors(3)
    whole = bonus(joint_log_probs(self_play(), 2, nets))
    paid = 0.25 * whole
    assert paid.shape == self_play().reward.shape and float(paid.abs().sum()) > 0
    richer = rollout(7, sp(2), reward=(self_play().reward + paid).numpy())
    plan = Plan(bonus=0.25)
    by_bonus = pool([rollout(7, sp(2))], 2, plan, {"SP": reads_observation()}, VIEW, bonus=lambda _: whole, **OPTIONS)
    by_reward = pool([richer], 2, Plan(), {"SP": reads_observation()}, VIEW, **OPTIONS)
    assert by_bonus is not None and by_reward is not None
    torch.testing.assert_close(by_bonus.advantage, by_reward.advantage)
    torch.testing.assert_close(by_bonus.critics["SP"].target, by_reward.critics["SP"].target)
    assert by_bonus.figures["bonus"] == pytest.approx(float(paid.mean()))


def test_what_the_bonus_pays_by_hand() -> None:
    """One member alone: its surprise is its own, and it diverges from nobody."""
    nets, steps = {2: actors(2)[2]}, self_play()
    played = joint_log_probs(steps, 2, nets)
    torch.testing.assert_close(SurpriseBonus(0.5, 1e-9)(played), -0.5 * played.seats[0].sum(-1))
    assert float(DivergenceBonus(0.5, 0.5)(played).abs().max()) < 1e-6


def test_skill_checkpoints_keep_the_first_and_spread_over_scores() -> None:
    """Forty policies, most of them near 10 dishes: one near 5 survives."""
    kept = SkillCheckpoints()
    for step, score in enumerate([0.0, *np.linspace(0, 10, 10), *(10 + np.linspace(0, 0.1, 29))]):
        kept.add(SkillCheckpoint(step, float(score), {}))
    assert len(kept.kept) == KEPT and kept.kept[0].steps == 0
    assert kept.nearest(5.0).score == pytest.approx(40 / 9)  # 50 / 9 is as near, and later
    again = SkillCheckpoints.from_state(kept.state())
    assert again == kept


def test_of_two_equally_near_the_earlier_is_the_half_trained_and_the_first_is_none() -> None:
    kept = SkillCheckpoints([SkillCheckpoint(0, 5.0, {}), SkillCheckpoint(9, 6.0, {}), SkillCheckpoint(5, 4.0, {})])
    assert kept.nearest(5.0).steps == 5


@pytest.mark.parametrize(
    ("first", "final", "steps"),
    [
        (0.0, 8.0, 2),  # nearest to 4
        (1.0, 8.0, 2),  # dishes by chance are no reason to go further
        (-60.0, -20.0, 5),  # nearest to -40; half of -20 would be the last one
    ],
)
def test_half_trained_is_half_way_of_scores_above_and_below_zero(first: float, final: float, steps: int) -> None:
    scores = {1: -55.0, 5: -42.0, 9: -21.0} if final < 0 else {1: 1.5, 2: 3.9, 3: 4.5}
    kept = [SkillCheckpoint(step, score, {}) for step, score in {0: first, **scores}.items()]
    assert SkillCheckpoints(kept).half_trained(final).steps == steps


def test_fcp_wants_whole_seeds() -> None:
    spec = make_env("overcooked/cramped_room", 1).spec
    config = RunConfig.parse({"method": "fcp", "population": {"size": 4}})
    with pytest.raises(UserError, match=r"population.size: 4 is no multiple of 3.*set it to 6"):
        check_fcp(config, spec)  # type: ignore[arg-type]
    METHODS["fcp"].check(RunConfig.parse({"method": "fcp", "population": {"size": 6}}), spec)
