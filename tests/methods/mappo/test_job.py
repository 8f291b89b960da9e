"""Who plays with whom, and how environments are shared."""

from __future__ import annotations

import numpy as np
import pytest

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.config.sections import EnvConfig
from popgen.errors import UserError
from popgen.methods.mappo.config import DiversityConfig, PpoConfig
from popgen.methods.mappo.training_job import Job, policy_config
from popgen.play.rollout import Match, share_of_each
from popgen.types import Kind

ENV = EnvConfig()
PPO = PpoConfig(envs=10)
DIVERSITY = DiversityConfig(xp_envs=6, mp_envs=4)


def summary(job: Job) -> list[tuple[str, tuple[int, int], int, int]]:
    return [(str(group.kind), group.members, group.envs, group.owner) for group in job.matches()]


def test_self_play_alone() -> None:
    job = Job(ENV, PPO, None, (3,), seed=0)
    assert summary(job) == [("SP", (3, 3), 10, 3)]
    assert job.partners(3) == [] and job.critics(3) == ["SP"]


def test_members_that_learn_together_share_their_cross_play() -> None:
    job = Job(ENV, PPO, DIVERSITY, (1, 2, 3), seed=0)
    pairs = [entry for entry in summary(job) if entry[0] == "XP"]
    assert sorted(members for _, members, *_ in pairs) == [(1, 2), (1, 3), (2, 1), (2, 3), (3, 1), (3, 2)]
    assert all(envs == 3 and owner == max(members) for _, members, envs, owner in pairs)
    assert job.critics(2) == ["SP", "XP_1", "XP_3"]


def test_a_later_member_meets_frozen_ones_in_both_seats() -> None:
    job = Job(ENV, PPO, DIVERSITY, (3,), seed=0, frozen={1: {}, 2: {}}, mixed=True, fresh=True)
    assert summary(job) == [
        ("SP", (3, 3), 10, 3),
        *[("XP", pair, 3, 3) for pair in ((3, 1), (1, 3), (3, 2), (2, 3))],
        *[("MP", pair, 2, 3) for pair in ((3, 1), (1, 3), (3, 2), (2, 3))],
    ]
    assert job.critics(3) == ["SP", "XP_1", "XP_2", "MP_1", "MP_2"]


def test_confederates_meet_the_best_responses_of_others_alone() -> None:
    """Three pairs: 1 to 3 are best responses, 4 to 6 their confederates."""
    job = Job(ENV, PPO, DIVERSITY, (1, 2, 3, 4, 5, 6), seed=0, pairs={1: 4, 2: 5, 3: 6}, all_partners=True)
    assert [job.partners(member) for member in (1, 2, 5)] == [[5, 6], [4, 6], [1, 3]]
    cross = [entry for entry in summary(job) if entry[0] == "XP"]
    wanted = {(best, confederate) for best in (1, 2, 3) for confederate in (4, 5, 6) if confederate != best + 3}
    assert {members for _, members, *_ in cross} == wanted | {(b, a) for a, b in wanted} and len(cross) == 12
    assert all(envs == 3 and owner == max(members) for _, members, envs, owner in cross)
    own = [members for kind, members, *_ in summary(job) if kind == "SP"]
    assert own == [(1, 4), (4, 1), (2, 5), (5, 2), (3, 6), (6, 3)]
    assert job.critics(5) == ["SP", "XP_1", "XP_3"]


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_parts_have_every_environment_once(parts: int) -> None:
    groups = [Match(Kind.SP, (1, 1), 10, 1), Match(Kind.XP, (1, 2), 3, 2), Match(Kind.XP, (2, 1), 1, 2)]
    shares = np.array([[group.envs for group in share_of_each(groups, parts, part)] for part in range(parts)])
    assert shares.sum(0).tolist() == [10, 3, 1]
    assert (np.ptp(shares, axis=0) <= 1).all() and np.ptp(shares.sum(1)) <= 2


def test_policies_are_saved_with_the_sizes_they_were_trained_with() -> None:
    assert policy_config(PpoConfig(units=32, layers=1)) == {"units": 32, "layers": 1, "greedy": False}
    paper = policy_config(PpoConfig(view="lossless", cnn_kernels=(5, 3), activation="leaky_relu"))
    assert paper["name"] == "lossless" and paper["kernels"] == [5, 3] and paper["activation"] == "leaky_relu"


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"minibatches": 7000}, "minibatches"),
        ({"runners": 65}, "runners"),
        ({"view": "lossless"}, "cnn_kernels"),
        ({"cnn_kernels": (3,)}, "cnn_kernels"),
        ({"view": "lossless", "cnn_kernels": (4,)}, "cnn_kernels"),
    ],
)
def test_recipes_that_cannot_be_are_refused(values: dict, field: str) -> None:
    with pytest.raises(ValueError) as caught:
        PpoConfig(**values)
    cause = caught.value.errors()[0]["ctx"]["error"]
    assert isinstance(cause, UserError) and cause.field == field


def test_both_seatings_need_an_even_number_of_environments() -> None:
    with pytest.raises(ValueError, match="multiple of 2"):
        DiversityConfig(xp_envs=3)


@pytest.mark.parametrize(
    ("env", "entropy"),
    [
        ("overcooked/counter_circuit_o_1order", (0.2, 0.1)),
        ("overcooked/cramped_room", (0.01, 1.0)),
        ("rendezvous/mppmr", (0.01, 1.0)),
    ],
)
def test_the_laptop_explores_more_where_deliveries_are_far_from_the_pots(
    env: str, entropy: tuple[float, float]
) -> None:
    ppo = RunConfig.parse(compose(["scale=laptop", "method=mappo", f"env={env}"])).ppo
    assert (ppo.entropy, ppo.entropy_end) == entropy
