from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.scripted import ONE, STAY, TWO, Script, TallyEnv

from popgen.envs import make_env
from popgen.evaluation.holdout_players import Player
from popgen.evaluation.partner_diversity import _find_mate, count_events, measure_partners
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy


def players(*scripts: list[int]) -> list[Player]:
    return [
        Player("g", "here", n, str(n), lambda script=script: Script(script))  # type: ignore[misc]
        for n, script in enumerate(scripts, start=1)
    ]


def test_events_are_those_of_the_member_or_of_its_response() -> None:
    """Six steps; the events are ONE and TWO by whoever plays them."""
    partners = players([ONE], [TWO], [STAY])
    counts, steps = count_events(TallyEnv, partners, None, 2, 0)  # type: ignore[arg-type]
    assert counts.tolist() == [[6, 0], [0, 6], [0, 0]] and steps == 3 * 2 * 2 * 6
    counts, _ = count_events(TallyEnv, partners, players([TWO], [TWO, STAY], [ONE]), 2, 0)  # type: ignore[arg-type]
    assert counts.tolist() == [[0, 6], [0, 3], [6, 0]]


def test_those_of_a_pair_are_counted_beside_each_other_and_spread_by_role() -> None:
    """ONE beside TWO in both seats, STAY beside ONE; three members of TWO kinds by role."""
    made = players([ONE], [TWO], [STAY], [ONE], [TWO, STAY])
    parts = [("biased", 1), ("partner", 1), ("biased", 2), ("partner", 2), ("biased", 0)]
    paired = [replace(one, part=part, pair=pair) for one, (part, pair) in zip(made, parts, strict=True)]
    assert [_find_mate(paired, k) for k in range(5)] == [1, 0, 3, 2, 4]
    got = measure_partners(TallyEnv, paired, None, 1, 0)  # type: ignore[arg-type]
    assert got.counts.tolist() == [[6, 0], [0, 6], [0, 0], [6, 0], [0, 3]]
    assert set(got.spreads) == {("g", "all"), ("g", "biased"), ("g", "partner")}
    assert got.spreads["g", "partner"].value == pytest.approx(2.0, rel=1e-3)
    biased = got.spreads["g", "biased"]  # distances 1, 3/2 and 1/2: without one of them 1/2, 3/2 and 1
    assert biased.value == pytest.approx(1.0, rel=1e-3)
    assert biased.high - biased.value == pytest.approx(2 * math.sqrt(2 / 3 * 0.5), rel=1e-3)


def test_the_most_diverse_are_chosen() -> None:
    """Two of ONE and one of TWO: the pair that differs."""
    got = measure_partners(TallyEnv, players([ONE], [ONE], [TWO]), None, 1, 0, choose=2)  # type: ignore[arg-type]
    assert got.chosen in ((0, 2), (1, 2)) and got.diversity.log_determinant == -math.inf
    assert got.diversity.effective_rank == pytest.approx(math.exp(-(2 / 3) * math.log(2 / 3) - math.log(1 / 3) / 3))
    assert got.chosen_diversity.effective_rank == pytest.approx(2.0)
    assert got.chosen_diversity.determinant == pytest.approx(1.0, abs=1e-3)
    with pytest.raises(ValueError, match="cannot be chosen"):
        measure_partners(TallyEnv, players([ONE]), None, 1, 0, choose=2)  # type: ignore[arg-type]


def test_in_a_kitchen_the_events_are_those_of_transitions() -> None:
    def make(num_envs: int, seed: int) -> object:
        return make_env("overcooked/cramped_room", num_envs, horizon=20, seed=seed)

    names = make_env("overcooked/cramped_room", 1).spec.action_names
    idle = Player("idle", "here", 1, None, lambda: IdlePolicy(names))
    rand = Player("random", "here", 1, None, lambda: RandomPolicy(6))
    counts, _ = count_events(make, [idle, rand], None, 3, 0)  # type: ignore[arg-type]
    assert counts.shape == (2, 17) and counts[0].sum() == counts[0].max() == 20  # nothing but staying
    assert (counts[1] > 0).sum() > 2
    np.testing.assert_array_equal(counts, count_events(make, [idle, rand], None, 3, 0)[0])  # type: ignore[arg-type]
