from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from support.small import kitchen

from popgen.envs import BatchedEnv, make_env
from popgen.play.episodes import Episode
from popgen.play.rollout import Match, Sampler, split_matches
from popgen.policies.simple_policies import RandomPolicy
from popgen.types import RANDOM_MEMBER, Kind, Segment

TEAMS = [Match(Kind.SP, (1, 1), 2), Match(Kind.XP, (1, 2), 3), Match(Kind.XP, (2, 1), 2)]
COUNT = 7


class Scripted:
    """Plays `base + seat` and remembers what it was shown."""

    kind, view = "scripted", "features"

    def __init__(self, base: int) -> None:
        self.base = base
        self.seen: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def reset(self, batch: int, seed: int) -> None:
        self.batch = batch

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        self.seen.append((obs.copy(), previous_actions.copy(), is_first.copy()))
        return np.tile(np.array([self.base, self.base + 1], np.uint8), (len(obs), 1))


def narrow_rendezvous(num_envs: int) -> BatchedEnv:
    """A square so small that random players leave it about as often as their time runs out."""
    return make_env(
        "rendezvous/mppmr", num_envs, seed=1, bounds=0.8, landmark_distance=0.5, horizon=15, start_noise=0.2
    )


def random_sampler(env: BatchedEnv, matches: list[Match] = TEAMS, **options: Any) -> Sampler:
    policies = {m: RandomPolicy(env.spec.num_actions) for match in matches for m in match.members}
    return Sampler(env, matches, policies, name="sampler0", seed=3, **options)  # type: ignore[arg-type]


def joined(collected: list[list[Segment]], match: int) -> Segment:
    """One match's segments, one after the other, as one."""
    parts = [segments[match] for segments in collected]
    arrays = ("states", "next_states", "actions", "reward", "score", "events", "terminated", "truncated")
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays}
    return Segment(parts[0].kind, parts[0].members, **columns, sampler="", sequence=0)


@pytest.mark.parametrize(
    "make", [lambda n: kitchen(n, horizon=13), narrow_rendezvous], ids=["overcooked", "rendezvous"]
)
def test_segments_replay_exactly_and_episodes_go_on_over_calls(make: Any) -> None:
    env = make(COUNT)
    sampler = random_sampler(env)
    collected = [sampler.collect(steps)[0] for steps in (9, 1, 20)]
    for match in range(len(TEAMS)):
        segment = joined(collected, match)
        following, batch = env.simulate(segment.states, segment.actions)
        assert np.array_equal(following, segment.next_states)
        for field in fields(batch):
            assert np.array_equal(getattr(batch, field.name), getattr(segment, field.name)), field.name
        done = (segment.terminated | segment.truncated)[:-1]
        assert np.array_equal(segment.next_states[:-1][~done], segment.states[1:][~done])
        assert done.any() and (env.time(segment.states[1:][done]) == 0).all()
        assert (env.time(segment.states[0]) == 0).all()
    if "rendezvous" in env.spec.name:
        whole = [joined(collected, match) for match in range(len(TEAMS))]
        assert sum(s.terminated.sum() for s in whole) > 10  # its horizon is an end like leaving the square
        assert not any(s.truncated.any() for s in whole)


def test_segments_carry_their_team_and_are_numbered() -> None:
    sampler = random_sampler(kitchen(COUNT), sequence=5)
    for first in (5, 8):
        segments, _ = sampler.collect(4)
        assert [(s.kind, s.members, s.steps // 4) for s in segments] == [(t.kind, t.members, t.envs) for t in TEAMS]
        assert [s.sequence for s in segments] == [first, first + 1, first + 2]
        assert all(s.sampler == "sampler0" for s in segments) and sum(s.steps for s in segments) == 4 * COUNT
    assert sampler.sequence == 11


def test_everyone_sits_where_the_team_says() -> None:
    players = {1: Scripted(0), 2: Scripted(3)}
    sampler = Sampler(kitchen(COUNT), TEAMS, players, name="s", seed=0)  # type: ignore[arg-type]
    segments, _ = sampler.collect(3)
    wanted = [(0, 1), (0, 4), (3, 1)]
    for segment, pair in zip(segments, wanted, strict=True):
        assert (segment.actions == pair).all()
    assert (players[1].batch, players[2].batch) == (COUNT, 5)


def test_policies_see_the_state_the_last_actions_and_the_beginnings() -> None:
    env, player = kitchen(2, horizon=3), Scripted(0)
    sampler = Sampler(env, [Match(Kind.XP, (1, 2), 2)], {1: player, 2: Scripted(3)}, name="s", seed=0)  # type: ignore[arg-type,dict-item]
    (segment,) = sampler.collect(7)[0]
    for t, (obs, previous, first) in enumerate(player.seen):
        assert np.array_equal(obs, env.encode(segment.states[t]))
        assert first.tolist() == [t % 3 == 0] * 2
        if t % 3:
            assert (previous == (0, 4)).all()


def recount(env: BatchedEnv, segment: Segment, match: Match, partial: np.ndarray) -> list[tuple[Any, ...]]:
    """Whole episodes of a segment, column by column; the first of a column does not count where `partial`."""
    found = []
    weights = np.array(env.spec.event_weights)
    for column in range(segment.reward.shape[1]):
        score, counts, skip = 0.0, np.zeros((2, env.spec.num_events)), bool(partial[column])
        for t in range(len(segment.reward)):
            score += segment.score[t, column]
            counts += segment.events[t, column]
            if segment.terminated[t, column] or segment.truncated[t, column]:
                if not skip:
                    found.append(
                        (t, column, match.members, round(score, 3), float((counts * weights).sum()), counts.tolist())
                    )
                score, counts, skip = 0.0, np.zeros_like(counts), False
    return found


def shown(episodes: list[Episode]) -> list[tuple[Any, ...]]:
    return sorted((e.members, round(e.score, 3), e.shaped, e.events.tolist()) for e in episodes)


@pytest.mark.parametrize("stagger", [False, True])
@pytest.mark.parametrize(
    "make", [lambda n: kitchen(n, horizon=60), narrow_rendezvous], ids=["overcooked", "rendezvous"]
)
def test_episodes_are_counted_whole(make: Any, stagger: bool) -> None:
    env = make(COUNT)
    sampler = random_sampler(env, stagger=stagger)
    collected, episodes = [], []
    for steps in (31, 1, 70, 60):
        segments, ended = sampler.collect(steps)
        collected.append(segments)
        episodes += ended
    expected, first = [], 0
    for number, match in enumerate(TEAMS):
        partial = np.array([stagger and first + i > 0 for i in range(match.envs)])
        expected += [e[2:] for e in recount(env, joined(collected, number), match, partial)]
        first += match.envs
    assert len(expected) >= 10 and shown(episodes) == sorted(expected)
    if "overcooked" in env.spec.name:
        assert any(e.events.any() for e in episodes)


def test_stagger_spreads_the_first_ends_over_the_horizon() -> None:
    sampler = random_sampler(
        kitchen(4, horizon=20), [Match(Kind.RANDOM, (RANDOM_MEMBER, RANDOM_MEMBER), 4)], stagger=True
    )
    (segment,) = sampler.collect(20)[0]
    assert [np.flatnonzero(segment.truncated[:, i]).tolist() for i in range(4)] == [[19], [14], [9], [4]]


def test_the_same_seed_gives_the_same_play() -> None:
    runs = [random_sampler(kitchen(COUNT)).collect(25)[0] for _ in range(2)]
    for one, two in zip(*runs, strict=True):
        assert np.array_equal(one.states, two.states) and np.array_equal(one.actions, two.actions)


def test_teams_must_fill_the_batch() -> None:
    with pytest.raises(ValueError, match="matches ask for 7 environments, the batch has 6"):
        random_sampler(kitchen(6))


def test_teams_are_split_evenly_and_in_order() -> None:
    for parts in (1, 2, 3, 4, 7, 9):
        shares = split_matches(TEAMS, parts)
        sizes = [sum(match.envs for match in share) for share in shares]
        assert sum(sizes) == COUNT and max(sizes) - min(sizes) <= 1 and sizes == sorted(sizes, reverse=True)
        seats = [match.members for share in shares for match in share for _ in range(match.envs)]
        assert seats == [match.members for match in TEAMS for _ in range(match.envs)]
        assert all(match.envs > 0 for share in shares for match in share)
    assert split_matches(TEAMS, 1) == [TEAMS]
    assert split_matches(TEAMS, 2) == [[TEAMS[0], Match(Kind.XP, (1, 2), 2)], [Match(Kind.XP, (1, 2), 1), TEAMS[2]]]


class Pacing:
    """Turns through the actions; it must remember where it is."""

    kind, view = "pacing", "features"

    def reset(self, batch: int, seed: int) -> None:
        self.turn = np.arange(batch) + seed % 5

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        self.turn += 1
        return np.stack([self.turn % 5, (self.turn // 2) % 5], -1).astype(np.uint8)

    def memory(self) -> dict[str, Any]:
        return {"turn": self.turn.copy()}

    def load_memory(self, memory: dict[str, Any]) -> None:
        self.turn = np.array(memory["turn"])


def test_a_restored_sampler_goes_on_in_the_middle_of_its_episodes() -> None:
    """In a task whose resets are random, with a policy that remembers."""

    def make() -> Sampler:
        env = narrow_rendezvous(COUNT)
        return Sampler(env, TEAMS, {1: Pacing(), 2: Pacing()}, name="s", seed=3, stagger=True)  # type: ignore[dict-item]

    sampler, restored = make(), make()
    sampler.collect(37)
    restored.load_state(sampler.state())
    for _ in range(2):
        (segments, episodes), (again, episodes_again) = sampler.collect(30), restored.collect(30)
        for one, two in zip(segments, again, strict=True):
            assert np.array_equal(one.states, two.states) and np.array_equal(one.actions, two.actions)
        assert [e.score for e in episodes] == [e.score for e in episodes_again] and len(episodes) > 10
