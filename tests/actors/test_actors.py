"""The actors as plain objects, without Ray."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.small import kitchen, random_play

from popgen.actors.samplers import SamplerActor
from popgen.config.sections import EnvConfig
from popgen.methods.training import InlineTransport, PolicySnapshot, Ready
from popgen.methods.xpm_wm.actor_critic import WorldModelPolicy
from popgen.methods.xpm_wm.config import AgentConfig, DiscoveryConfig, WorldModelConfig
from popgen.methods.xpm_wm.replay import Query, ReplayActor, Request
from popgen.play.rollout import Match
from popgen.types import RANDOM_MEMBER, Kind

ENV = EnvConfig(params={"horizon": 20})
RANDOM = PolicySnapshot("random", {"probabilities": None}, Ready({}))


def test_a_retried_segment_is_stored_once() -> None:
    replay = ReplayActor(ENV, 1000, seed=0)
    segments = Ready(random_play(kitchen(3), 10))
    assert replay.ingest(segments, 1) == 30
    assert replay.ingest(segments, 1) == 30


def test_a_restored_replay_actor_draws_the_same_and_knows_what_it_has() -> None:
    replay = ReplayActor(ENV, 1000, seed=0)
    segments = Ready(random_play(kitchen(3), 40))
    replay.ingest(segments, 1)
    requests = (Request(Query(), 4, event_fraction=0.5), Request(Query(owner=7), 4))
    replay.draw(requests, 5, "features", 3)
    restored = ReplayActor(ENV, 1000, seed=9)
    restored.load_state(Ready(replay.state()))
    assert restored.ingest(segments, 1) == 120
    for one, two in zip(*(each.draw(requests, 5, "features", 2) for each in (replay, restored)), strict=True):
        assert one[1] is two[1] is None and one[0] is not None and two[0] is not None
        assert all(np.array_equal(getattr(one[0], name), getattr(two[0], name)) for name in vars(one[0]))


def test_what_steps_on_end_have_earned_is_told_at_the_pay_of_imagination() -> None:
    segment, spec = random_play(kitchen(3), 10)[0], kitchen().spec
    segment.events[:] = 0
    segment.events[4, 1, 0, 0] = segment.events[5, 1, 1, 3] = 1
    replay = ReplayActor(ENV, 1000, seed=0)
    replay.ingest(Ready([segment]), 1)
    first, soup = spec.event_weights[0], spec.event_weights[3]
    assert replay.most_paid(DiscoveryConfig(), 2).tolist() == [soup, first + soup]
    doubled = DiscoveryConfig(event_factors={spec.event_names[3]: 2.0})
    assert replay.most_paid(doubled, 2).tolist() == [2.0 * soup, first + 2.0 * soup]


def test_segment_numbers_continue_over_matches_and_segments_are_handed_on_by_kind() -> None:
    sampler = SamplerActor(ENV, "sampler0.1", 1, InlineTransport())
    with pytest.raises(RuntimeError, match="open before collect"):
        sampler.collect(1)
    keys = []
    for matches in (
        [Match(Kind.RANDOM, (RANDOM_MEMBER, RANDOM_MEMBER), 2)],
        [Match(Kind.SP, (1, 1), 1), Match(Kind.XP, (1, 2), 3), Match(Kind.XP, (2, 1), 2)],
    ):
        sampler.open(matches, dict.fromkeys({m for t in matches for m in t.members}, RANDOM), seed=0)
        for _ in range(2):
            sampled = sampler.collect(5)
            assert sampled.collected.sampler == "sampler0.1"
            segments = [segment for part in sampled.segments.values() for segment in part.result()]
            assert all({s.kind for s in part.result()} == {kind} for kind, part in sampled.segments.items())
            counts = [(s.kind, s.members, s.sequence, s.steps) for s in segments]
            assert sampled.collected.counts == counts
            assert [s.steps for s in segments] == [5 * match.envs for match in matches]
            assert sampled.collected.steps == 5 * sum(match.envs for match in matches)
            keys += [(s.sampler, s.sequence) for s in segments]
    assert keys == [("sampler0.1", number) for number in range(8)]


def member_snapshot(seed: int, units: int = 8) -> PolicySnapshot:
    """A fresh world-model policy as it travels."""
    model, agent = WorldModelConfig(deter=16, units=units, groups=4, joint_groups=2), AgentConfig(units=units)
    torch.manual_seed(seed)
    policy = WorldModelPolicy(model, agent, kitchen().spec)
    return PolicySnapshot(policy.kind, policy.config(), Ready(policy.weights()))


def test_a_policy_that_a_sampler_keeps_plays_its_new_weights_like_a_fresh_one() -> None:
    matches = [Match(Kind.SP, (1, 1), 3)]
    used = SamplerActor(ENV, "s", 1, InlineTransport())
    used.open(matches, {1: member_snapshot(1)}, seed=5)
    used.collect(7)
    kept = used.sampler and used.sampler.policies[1]
    for units in (8, 12):  # with the same sizes it is kept, with others it is built anew
        fresh = SamplerActor(ENV, "s", 1, InlineTransport())
        fresh.sequence = used.sequence
        played = []
        for sampler in (used, fresh):
            sampler.open(matches, {1: member_snapshot(2, units)}, seed=6)
            played.append(sampler.collect(9).segments[Kind.SP].result())
        assert used.sampler is not None and (used.sampler.policies[1] is kept) == (units == 8)
        for one, two in zip(*played, strict=True):
            assert one.sequence == two.sequence and np.array_equal(one.actions, two.actions)
