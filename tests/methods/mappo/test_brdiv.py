"""BRDiv: the weights that its objective has, whom a pair meets, and for whom steps count."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.rollouts import VIEW, reads_observation, rollout, xp

from popgen.config.run_config import RunConfig
from popgen.config.sections import EnvConfig
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.methods.mappo.brdiv import BrdivTraining, cross_play_weight
from popgen.methods.mappo.config import DiversityConfig, PpoConfig
from popgen.methods.mappo.needs import check_brdiv, estimate_brdiv
from popgen.methods.mappo.play_record import PlayRecord
from popgen.methods.mappo.pooling import Plan, PooledBatch, pool
from popgen.methods.mappo.training_job import Job
from popgen.play.rollout import Match
from popgen.types import Kind

SPEC = make_env("overcooked/cramped_room", 1).spec
OWN = Match(Kind.SP, (1, 4), 4, 1)


def objective(returns: np.ndarray, alpha: float) -> float:
    """The sum of the docstring, term by term."""
    pairs = range(len(returns))
    differences = [2 * returns[i, i] - returns[i, j] - returns[j, i] for i in pairs for j in pairs if i != j]
    return float(np.trace(returns) + alpha * sum(differences))


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("pairs", [2, 3, 5])
def test_cross_plays_weight_is_that_of_the_objective(alpha: float, pairs: int) -> None:
    """The objective is linear: what one more of C_00 and of each C_0j is worth, by difference."""
    returns = np.random.default_rng(0).normal(size=(pairs, pairs))
    worth = []
    for cells in ([(0, 0)], [(0, j) for j in range(1, pairs)]):
        more = returns.copy()
        for cell in cells:
            more[cell] += 1.0
        worth.append(objective(more, alpha) - objective(returns, alpha))
    assert cross_play_weight(alpha, pairs) == pytest.approx(-worth[1] / worth[0], abs=1e-6)


def config_of(size: int, **brdiv: Any) -> Any:
    return RunConfig.parse({"method": "brdiv", "population": {"size": size}, "brdiv": brdiv})


def make_training(members: str, size: int, **brdiv: Any) -> BrdivTraining:
    training = BrdivTraining(config_of(size, members=members, **brdiv), SPEC, "test.1")
    training.learning = tuple(range(1, size + 1))
    return training


def test_members_are_pairs_of_a_confederate_and_its_best_response() -> None:
    training = make_training("both", 6)
    assert [training.trained_as(member) for member in training.learning] == [4, 1, 5, 2, 6, 3]
    assert [training.member_of(trained) for trained in range(1, 7)] == [2, 4, 6, 1, 3, 5]
    assert [make_training("confederates", 3).trained_as(member) for member in (1, 2, 3)] == [4, 5, 6]
    assert [make_training("confederates", 3).member_of(trained) for trained in range(1, 7)] == [1, 2, 3, 1, 2, 3]


def test_everyone_is_trained_on_its_cross_play_with_all_others() -> None:
    job = make_training("both", 6, warmup=2).make_job()
    record = PlayRecord(job)
    full = cross_play_weight(1.0, 3) / 2
    assert record.plan(1, 5) == Plan(5, pytest.approx(full), mate=4, others=(6,))
    assert record.plan(6, 0) == Plan(1, pytest.approx(full / 2), mate=3, others=(2,))
    assert all(record.is_played(match, {}) for match in job.matches())


def learned(plan: Plan, *crossed: Match) -> PooledBatch:
    critics = {name: reads_observation() for name in ("SP", "XP_5", "XP_6")}
    options: dict[str, Any] = {"discount": 0.5, "lam": 0.5, "value_decay": 0.0}
    found = pool([rollout(6, OWN, *crossed)], 1, plan, critics, VIEW, **options)
    assert found is not None
    return found


def test_each_of_the_others_pushes_with_its_own_mean() -> None:
    """Rows of both come from the member's seat, each kind's weights sum to one, and figures are means over them."""
    crossed = xp(1, 5), xp(6, 1, envs=4)
    both = learned(Plan(5, 0.3, mate=4, others=(6,)), *crossed)
    alone = [learned(Plan(partner, 0.3, mate=4), *crossed) for partner in (5, 6)]
    rows = [int(part.cross.sum()) for part in alone]
    assert rows == [6 * 2, 6 * 4] and int(both.cross.sum()) == sum(rows)
    torch.testing.assert_close(both.advantage[both.cross], torch.cat([part.advantage[part.cross] for part in alone]))
    assert [float(part.sum()) for part in both.weight.split([24, *rows])] == pytest.approx([1.0] * 3)
    assert set(both.critics) == {"SP", "XP_5", "XP_6"}
    rewards = [part.figures["xp_reward"] for part in alone]
    assert both.figures["xp_reward"] == pytest.approx(np.mean(rewards)) and rewards[0] != rewards[1]


def test_without_weight_a_pair_learns_from_its_own_play_alone() -> None:
    plan = PlayRecord(make_training("both", 6, alpha=0.0).make_job()).plan(1, 50)
    assert plan.sources(1) == [(Kind.SP, 4, 1.0)]


def test_without_weight_pairs_do_not_meet_and_end_at_their_target() -> None:
    training = make_training("both", 4, alpha=0.0)
    job = training.make_job()
    matches = [(match.kind, match.members, match.envs) for match in job.matches()]
    assert matches == [(Kind.SP, pair, 32) for pair in ((1, 3), (3, 1), (2, 4), (4, 2))]
    assert [job.critics(member) for member in job.learning] == [["SP"]] * 4
    assert training.plan()[0].cost < make_training("both", 4).plan()[0].cost
    record = PlayRecord(job)
    for pair in (1, 2):
        assert not record.finished
        record.own[pair].extend([job.ppo.target_score] * job.ppo.window)
    assert record.finished
    crossed, alone = (estimate_brdiv(config_of(4, alpha=alpha), SPEC) for alpha in (1.0, 0.0))
    assert alone.batch * 3 == crossed.batch * 2 and alone.member < crossed.member


def test_half_pairs_and_single_ones_are_refused() -> None:
    with pytest.raises(UserError, match=r"population.size: 5 is no multiple of 2.*set it to 6"):
        check_brdiv(config_of(5), SPEC)
    with pytest.raises(UserError, match=r"population.size: 2 leaves a pair nobody"):
        check_brdiv(config_of(2), SPEC)
    check_brdiv(config_of(3, members="confederates"), SPEC)
    assert estimate_brdiv(config_of(8), SPEC).together == 8


def test_pairs_meet_across_in_both_seatings() -> None:
    ppo, diversity = PpoConfig(envs=4), DiversityConfig(xp_envs=6)
    job = Job(EnvConfig(), ppo, diversity, (1, 2, 3, 4), seed=0, pairs={1: 3, 2: 4}, all_partners=True)
    crossed = [(match.members, match.envs) for match in job.matches() if match.kind is Kind.XP]
    assert crossed == [((4, 1), 3), ((1, 4), 3), ((3, 2), 3), ((2, 3), 3)]
