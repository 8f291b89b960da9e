"""XPM-Sim's loop with workers that only answer: which records it yields, and what it asks for in which order."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.methods.training import Collected, Phase, Progress, Ready, Round, Sampled, SegmentCount, TrainedMember
from popgen.methods.xpm_sim.agent import make_actor
from popgen.methods.xpm_sim.train import XpmSimTraining
from popgen.methods.xpm_sim.workers import Learned, RestartCheck
from popgen.play.episodes import Episode
from popgen.types import Kind

HANDLE = Ready([])
"""Of segments, into which the loop must not look."""


class Answers:
    """Workers that notice what they are asked for."""

    def __init__(self, weights: dict[str, np.ndarray]) -> None:
        self.weights, self.asked = Ready(weights), list[Any]()

    def put(self, weights: Any) -> Any:
        return Ready(weights)

    def begin_member(self, member: int, seed: int, partners: Any, encoder: Any) -> Any:
        self.asked.append(("begin", member, sorted(partners)))
        return self.weights

    def play(self, matches: Any, policies: Any, seed: int, steps: int) -> list[Sampled]:
        self.asked.append(("play", seed))
        counts = [SegmentCount(m.kind, m.members, 0, steps * m.envs) for m in matches]
        episodes = [Episode(m.kind, m.members, 3.0 if m.kind is Kind.SP else 1.0, 0.5) for m in matches]
        return [Sampled(Collected("s", counts, episodes), {Kind.SP: HANDLE, Kind.XP: HANDLE})]

    def ingest(self, segments: Any, strength: dict[int, float], multipliers: dict[int, float]) -> Any:
        assert all(part is HANDLE for by_kind in segments for part in by_kind.values())
        self.asked.append(("ingest", strength, multipliers))
        return Ready(None)

    def learn(self, updates: int) -> Any:
        self.asked.append(("learn", updates))
        return Ready(Learned(self.weights, {"entropy": 1.0}, 40, 4))

    def check(self) -> Any:
        return Ready(RestartCheck({"score_sp": 2.0}, 10))

    def critics(self) -> Any:
        return Ready({})

    def encoder(self) -> Any:
        return Ready(None)


def trained(schedule: str, *further: str) -> tuple[list[Any], list[Any]]:
    """Records of member 2, five updates of which two are in a round; what was asked for."""
    changes = ["xpm_sim.updates=5", "xpm_sim.updates_per_round=2", f"run.schedule={schedule}", *further]
    config = RunConfig.parse(compose(["method=xpm_sim", "scale=smoke", "seed=3", *changes]))
    spec = make_env(config.env.name, 1, **config.env.params).spec
    workers: Any = Answers(make_actor(config.xpm_sim, spec).weights())
    training = XpmSimTraining(config, spec, "run.7", workers)
    training.adopt({1: workers.weights.value}, {})
    assert training.begin(2) == (2,)
    return list(training.train()), workers.asked


def test_records_of_a_member_in_order() -> None:
    records, _ = trained("sync")
    kinds = [Phase, *[Progress, Round] * 3, Progress, TrainedMember]
    assert [type(record) for record in records] == kinds
    assert all(not one.segments for record in records[1:7:2] for one in record.sampled)  # a checkpoint needs no log
    rounds = records[2:7:2]
    assert [(r.number, r.done, r.at_rest) for r in rounds] == [(1, 2, True), (2, 4, True), (3, 5, True)]
    # Figures are of the policy that played the round's episodes: before its updates.
    assert [(r.figures["updates"], r.figures["simulated_steps"]) for r in rounds] == [(0, 0), (2, 40), (4, 80)]
    assert [(r.counted[0].sampler, r.counted[0].sequence) for r in rounds] == [("simulator.7", n) for n in range(3)]
    assert rounds[0].figures["real_sp"] == 3.0 and rounds[0].figures["real_xp"] == rounds[0].figures["real_xp/1"] == 1.0
    last = records[-1]
    assert last.extra["simulated_steps"] == 3 * 40 + 10 and (last.extra["sp"], last.extra["xp"]) == (3.0, 1.0)


@pytest.mark.parametrize(
    ("schedule", "order"),
    [
        ("sync", ["play", "ingest", "learn"] * 3),
        ("async", ["play", "ingest", "learn", *["learn", "play", "ingest"] * 2]),
    ],
)
def test_updates_overlap_with_episodes_where_told(schedule: str, order: list[str]) -> None:
    _, asked = trained(schedule)
    assert [name for name, *_ in asked] == ["begin", *order]
    assert [count for name, count, *_ in asked if name == "learn"] == [2, 2, 1]
    ingested = [arguments for name, *arguments in asked if name == "ingest"]
    assert ingested == [[{1: 0.5}, {1: 1.0}]] * 3  # the shaped return, not the score; no constraint


def test_the_multiplier_of_a_partner_follows_its_score() -> None:
    """Self-play 3, cross-play 1: with a limit of 2 each round takes a whole step's share of -1 off."""
    _, asked = trained("sync", "xpm_sim.xp_limit=2.0", "xpm_sim.multiplier_step=0.25")
    assert [multipliers for name, *_, multipliers in asked if name == "ingest"] == [{1: 0.75}, {1: 0.5}, {1: 0.25}]
