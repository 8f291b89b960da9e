"""A Gymnasium environment whose other seat is a member's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from support.small import kitchen

import popgen
from popgen.errors import UserError
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy
from popgen.population import PopulationWriter, load_population

HORIZON = 12


@pytest.fixture
def population(tmp_path: Path) -> Path:
    """A member that interacts, and one that stays."""
    spec = kitchen(horizon=HORIZON).spec
    writer = PopulationWriter(tmp_path / "two", spec, method="mappo", config_digest="0" * 64, seed=0)
    for policy in (RandomPolicy(6, [0.0] * 5 + [1.0]), IdlePolicy(spec.action_names)):
        writer.add_member(policy, seed=0, steps={})
    return tmp_path / "two"


@pytest.mark.filterwarnings("ignore")
def test_gymnasium_accepts_it(population: Path) -> None:
    check_env(popgen.make_partner_env(population), skip_render_check=True)


def test_every_member_plays_in_both_seats_and_a_seed_repeats_them(population: Path) -> None:
    env = popgen.make_partner_env(population)
    met = [env.reset(seed=7 if n == 0 else None)[1] for n in range(40)]
    again = [env.reset(seed=7 if n == 0 else None)[1] for n in range(40)]
    assert met == again
    assert {(info["member"], info["seat"]) for info in met} == {(1, 0), (1, 1), (2, 0), (2, 1)}


@pytest.mark.parametrize("seat", [0, 1])
def test_a_step_is_the_environments_with_the_partners_action(population: Path, seat: int) -> None:
    env, kitchen_ = popgen.make_partner_env(population), kitchen(horizon=HORIZON)
    seen, info = env.reset(options={"partner": 0, "seat": seat})
    assert info["seat"] == seat and info["member"] == 1
    for step in range(HORIZON):
        assert np.array_equal(seen, np.append(kitchen_.observe()[0, seat], np.eye(2)[seat]))
        joint = np.full((1, 2), 5, np.uint8)
        joint[0, seat] = step % 4
        result = kitchen_.step(joint)
        seen, reward, terminated, truncated, info = env.step(step % 4)
        assert reward == (result.events[0] * kitchen_.spec.event_weights).sum() and info["score"] == result.score[0]
        assert (terminated, truncated) == (False, step == HORIZON - 1)


def test_chosen_members_alone_play(population: Path) -> None:
    env = popgen.make_partner_env(f"{population}:2", population)
    met = [env.reset(options={"partner": n})[1]["member"] for n in range(3)]
    assert met == [2, 1, 2]
    with pytest.raises(UserError, match="has no member 3"):
        popgen.make_partner_env(f"{population}:3")


@pytest.mark.parametrize("action", [6, -1, 260, 1.7, np.int64(260), np.float64(1.0)])
def test_no_other_action_takes_the_place_of_one_that_there_is_not(population: Path, action: int) -> None:
    env = popgen.make_partner_env(population)
    env.reset()
    with pytest.raises(ValueError, match="need a whole number below 6"):
        env.step(action)


def test_what_cannot_work_is_refused(population: Path) -> None:
    for wrong in ({"view": "lossless"}, {"reward": "none"}, {"render_mode": "human"}):
        with pytest.raises(UserError):
            popgen.make_partner_env(population, **wrong)
    with pytest.raises(ValueError, match="no partner 2"):
        popgen.make_partner_env(load_population(population)).reset(options={"partner": 2})
    with pytest.raises(UserError):
        popgen.make_partner_env()
