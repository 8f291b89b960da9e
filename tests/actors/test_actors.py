"""The actors as plain objects, without Ray."""

from __future__ import annotations

import numpy as np
import pytest
from support.small import kitchen, random_play

from popgen.actors.replay_actor import ReplayActor
from popgen.actors.sampler_actor import PolicySnapshot, SamplerActor
from popgen.config.sections import EnvConfig
from popgen.methods.xpm_wm.replay import Query
from popgen.methods.xpm_wm.window_requests import Request
from popgen.play.sampler import Match
from popgen.types import RANDOM_MEMBER, Kind

ENV = EnvConfig(params={"horizon": 20})
RANDOM = PolicySnapshot("random", {"probabilities": None}, {})


def test_a_retried_segment_is_stored_once_and_only_its_kinds_are_kept() -> None:
    replay = ReplayActor(ENV, 1000, seed=0)
    segments = random_play(kitchen(3), 10)
    assert replay.add(segments, 1, ("XP",)) == 0
    assert replay.add(segments, 1, ("random", "SP")) == 30
    assert replay.add(segments, 1, ("random", "SP")) == 30


def test_a_restored_replay_actor_draws_the_same_and_knows_what_it_has() -> None:
    replay = ReplayActor(ENV, 1000, seed=0)
    segments = random_play(kitchen(3), 40)
    replay.add(segments, 1, ("random",))
    requests = (Request(Query(), 4, event_fraction=0.5), Request(Query(owner=7), 4))
    replay.draw(requests, 5, "features", 3)
    restored = ReplayActor(ENV, 1000, seed=9)
    restored.load_state(replay.state())
    assert restored.add(segments, 1, ("random",)) == 120
    for one, two in zip(*(each.draw(requests, 5, "features", 2) for each in (replay, restored)), strict=True):
        assert one[1] is two[1] is None and one[0] is not None and two[0] is not None
        assert all(np.array_equal(getattr(one[0], name), getattr(two[0], name)) for name in vars(one[0]))


def test_segment_numbers_go_on_when_other_teams_sit_down() -> None:
    sampler = SamplerActor(ENV, "sampler0.1", threads=1)
    with pytest.raises(RuntimeError, match="open before collect"):
        sampler.collect(1)
    keys = []
    for matches in (
        [Match(Kind.RANDOM, (RANDOM_MEMBER, RANDOM_MEMBER), 2)],
        [Match(Kind.SP, (1, 1), 1), Match(Kind.XP, (1, 2), 3)],
    ):
        sampler.open(matches, dict.fromkeys({m for t in matches for m in t.members}, RANDOM), seed=0, stagger=False)
        for _ in range(2):
            segments, said = sampler.collect(5)
            assert said.sampler == "sampler0.1"
            assert said.counts == [(s.kind, s.members, s.sequence, s.steps) for s in segments]
            assert [s.steps for s in segments] == [5 * match.envs for match in matches]
            keys += [(s.sampler, s.sequence) for s in segments]
    assert keys == [("sampler0.1", number) for number in range(6)]
