from __future__ import annotations

import numpy as np
import pytest
from support.scripted import HORIZON, ONE, QUIT, STAY, TWO, Script, TallyEnv

from popgen.envs import make_env
from popgen.play.episodes import Episodes
from popgen.play.rollout import Transition, play, play_teams
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.simple_policies import RandomPolicy


def test_sums_by_hand() -> None:
    alternating, twos, quitter = Script([ONE, STAY]), Script([TWO]), Script([STAY, STAY, QUIT])
    seats = np.array([[0, 1], [1, 0], [1, 1], [0, 2]])
    played = play(TallyEnv(4), [alternating, twos, quitter], seats, seed=0)
    # 6 steps; `alternating` plays `one` in three of them. The quitter ends its episode with the third step.
    np.testing.assert_array_equal(played.score, [3 * 1 + 6 * 20, 6 * 2 + 3 * 10, 6 * 22, 2])
    np.testing.assert_array_equal(played.reward, 2 * played.score)
    np.testing.assert_array_equal(played.events[0], [[3, 0], [0, 6]])
    np.testing.assert_array_equal(played.events[1], [[0, 6], [3, 0]])
    np.testing.assert_array_equal(played.events[3], [[2, 0], [0, 0]])
    np.testing.assert_array_equal(played.shaped, [[3, 30], [30, 3], [30, 30], [2, 0]])
    np.testing.assert_array_equal(played.length, [6, 6, 6, 3])
    np.testing.assert_array_equal(played.terminated, [False, False, False, True])
    assert played.steps == 4 * HORIZON
    np.testing.assert_array_equal(played.seats, seats)


def test_the_batch_ends_with_its_longest_episode() -> None:
    played = play(TallyEnv(3), [Script([STAY, QUIT])], np.zeros((3, 2), int), seed=0)
    assert played.steps == 3 * 2 and played.terminated.all()


def test_waiting_rows_are_reset_and_not_counted() -> None:
    quitter, other = Script([ONE, QUIT]), Script([ONE])
    seen: list[Transition] = []
    play(TallyEnv(2), [quitter, other], np.array([[0, 0], [1, 1]]), seed=0, record=seen.append)
    counted = np.stack([step.counted for step in seen])
    first = np.stack([step.is_first for step in seen])
    np.testing.assert_array_equal(counted.T, [[1, 1, 0, 0, 0, 0], [1] * 6])
    np.testing.assert_array_equal(first.T, [[1, 0, 1, 0, 1, 0], [1, 0, 0, 0, 0, 0]])
    np.testing.assert_array_equal([step.states[0, 0] for step in seen], [0, 1, 0, 1, 0, 1])
    for step in seen:
        np.testing.assert_array_equal(step.next_states[:, 0], step.states[:, 0] + 1)
    np.testing.assert_array_equal(np.stack([step.actions for step in seen])[:, 0], [[ONE] * 2, [QUIT] * 2] * 3)
    np.testing.assert_array_equal(np.stack([call[2][0] for call in quitter.calls]), first[:, 0])


def same(a: Episodes, b: Episodes) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in Episodes.__dataclass_fields__)


def test_the_seed_decides() -> None:
    env = make_env("rendezvous/mppmr", 6, start_noise=0.1)
    policies = [FeedForwardPolicy(env.spec.views["features"], 5, units=8), RandomPolicy(5)]
    seats = np.array([[0, 0], [0, 1], [1, 0], [1, 1], [0, 0], [1, 1]])
    first = play(env, policies, seats, seed=3)
    assert same(first, play(env, policies, seats, seed=3))
    fresh = [FeedForwardPolicy(env.spec.views["features"], 5, units=8), RandomPolicy(5)]
    assert same(first, play(make_env("rendezvous/mppmr", 6, seed=9, start_noise=0.1), fresh, seats, seed=3))
    assert not same(first, play(env, policies, seats, seed=4))


@pytest.mark.parametrize("max_envs", [1, 2, 5, 100])
def test_teams_in_batches_of_any_size(max_envs: int) -> None:
    made, reported = [], []

    def make(num_envs: int, seed: int) -> TallyEnv:
        made.append(num_envs)
        return TallyEnv(num_envs, seed)

    matches = [(0, 1), (1, 1), (1, 0)]
    policies = [Script([ONE]), Script([TWO])]
    played = play_teams(make, policies, matches, 3, seed=0, max_envs=max_envs, progress=lambda *at: reported.append(at))
    np.testing.assert_array_equal(played.seats, np.repeat(matches, 3, axis=0))
    np.testing.assert_array_equal(played.score, np.repeat([6 * 21, 6 * 22, 6 * 12], 3))
    assert sum(made) == 9 and max(made) <= max_envs and played.steps == 9 * HORIZON
    assert reported == sorted(reported) and {total for _, total in reported} == {9}
    assert {min(end, 9) for end in range(max_envs, 9 + max_envs, max_envs)} <= {done for done, _ in reported}
    if max_envs > 9:  # each step of nine environments is one and a half episodes of six
        assert [done for done, _ in reported] == [1, 3, 4, 6, 7, 9, 9]


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match="seats"):
        play(TallyEnv(2), [Script([ONE])], np.zeros((3, 2), int), seed=0)
    with pytest.raises(ValueError, match="episodes"):
        play_teams(TallyEnv, [Script([ONE])], [(0, 0)], 0, seed=0)
