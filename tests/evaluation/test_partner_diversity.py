from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.scripted import ONE, STAY, TWO, Script, TallyEnv

from popgen.envs import make_env
from popgen.envs.player_events import BR_DIV_EVENTS
from popgen.errors import UserError
from popgen.evaluation.holdout_players import Player, find_mates
from popgen.evaluation.partner_diversity import count_events, measure_partners
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


def test_copies_of_a_policy_are_played_once() -> None:
    """Two random players have counts of their own; one of them twice has not."""
    made = [Player("g", "here", n, str(n), lambda: RandomPolicy(4)) for n in (1, 2, 3)]
    counts, steps = count_events(TallyEnv, made, None, 4, 0)  # type: ignore[arg-type]
    assert steps == 3 * 2 * 4 * 6 and len({tuple(row) for row in counts}) == 3
    copies = [replace(one, identity=name) for one, name in zip(made, ("a", "b", "a"), strict=True)]
    counts, steps = count_events(TallyEnv, copies, None, 4, 0)  # type: ignore[arg-type]
    assert steps == 2 * 2 * 4 * 6 and counts[0].tolist() == counts[2].tolist() != counts[1].tolist()
    assert measure_partners(TallyEnv, copies, None, 4, 0).diversity.rank < 3  # type: ignore[arg-type]


def test_those_of_a_pair_are_counted_beside_each_other_and_spread_by_role() -> None:
    """ONE beside TWO in both seats, STAY beside ONE; three members of TWO kinds by role."""
    made = players([ONE], [TWO], [STAY], [ONE], [TWO, STAY])
    parts = [("biased", 1), ("partner", 1), ("biased", 2), ("partner", 2), ("biased", 0)]
    paired = [replace(one, part=part, pair=pair) for one, (part, pair) in zip(made, parts, strict=True)]
    assert find_mates(paired) == (1, 0, 3, 2, 4)
    got = measure_partners(TallyEnv, paired, None, 1, 0)  # type: ignore[arg-type]
    assert got.counts.tolist() == [[6, 0], [0, 6], [0, 0], [6, 0], [0, 3]]
    assert set(got.spreads) == {("g", "all"), ("g", "biased"), ("g", "partner")}
    assert got.spreads["g", "partner"].value == pytest.approx(2.0, rel=1e-3)
    biased = got.spreads["g", "biased"]  # distances 1, 3/2 and 1/2: without one of them 1/2, 3/2 and 1
    assert biased.value == pytest.approx(1.0, rel=1e-3)
    assert biased.high - biased.value == pytest.approx(2 * math.sqrt(2 / 3 * 0.5), rel=1e-3)


def test_a_mate_that_was_not_chosen_plays_and_is_not_counted() -> None:
    """ONE beside TWO: the counts are those of ONE alone."""
    one, two = players([ONE], [TWO])
    got = measure_partners(TallyEnv, [replace(one, pair=1, mate=two)], None, 1, 0)  # type: ignore[arg-type]
    assert got.counts.tolist() == [[6, 0]]
    counts, _ = count_events(
        *(TallyEnv, [replace(one, pair=1, mate=two)], players([TWO]), 1, 0)  # type: ignore[arg-type]
    )
    assert counts.tolist() == [[0, 6]], "of its response, beside it and not beside the mate"


def test_the_most_diverse_are_chosen() -> None:
    """Two of ONE and one of TWO: the pair that differs."""
    got = measure_partners(TallyEnv, players([ONE], [ONE], [TWO]), None, 1, 0, choose=2)  # type: ignore[arg-type]
    assert got.chosen in ((0, 2), (1, 2)) and got.diversity.log_determinant == -math.inf
    assert got.diversity.effective_rank == pytest.approx(math.exp(-(2 / 3) * math.log(2 / 3) - math.log(1 / 3) / 3))
    assert got.chosen_diversity.effective_rank == pytest.approx(2.0)
    assert got.chosen_diversity.determinant == pytest.approx(4.0, abs=0.01), "two columns of 1 each, one a seat"
    with pytest.raises(ValueError, match="cannot be chosen"):
        measure_partners(TallyEnv, players([ONE]), None, 1, 0, choose=2)  # type: ignore[arg-type]


def test_br_div_keeps_the_seats_apart() -> None:
    """ONE in one seat and TWO in the other: over both seats these two do the same, seat by seat nothing in common."""
    scripts = (([ONE], [TWO]), ([TWO], [ONE]))
    made = [Player("g", "here", n, str(n), lambda s=s: Script(*s)) for n, s in enumerate(scripts)]  # type: ignore[misc]
    got = measure_partners(TallyEnv, made, None, 2, 0)  # type: ignore[arg-type]
    assert got.counts.tolist() == [[3, 3], [3, 3]] and got.kinds.tolist() == [[6, 0, 0, 6], [0, 6, 6, 0]]
    assert got.diversity.effective_rank == pytest.approx(2.0) and got.diversity.rank == 2
    assert got.spreads["g", "all"].value == 0.0


def test_more_than_are_independent_cannot_be_chosen() -> None:
    """Two events give three partners a rank of two, whatever they do; the third direction would be rounding."""
    mixed = players([ONE], [TWO], [ONE, TWO])
    got = measure_partners(TallyEnv, mixed, None, 1, 0)  # type: ignore[arg-type]
    assert (got.diversity.rank, got.diversity.determinant, got.chosen) == (2, 0.0, (0, 1, 2))
    assert measure_partners(TallyEnv, mixed, None, 1, 0, choose=2).chosen == (0, 1)  # type: ignore[arg-type]
    told = "--choose: is 3, but by their own events only 2 of 3 partners are linearly independent; choose 2 or fewer"
    with pytest.raises(UserError) as caught:
        measure_partners(TallyEnv, mixed, None, 1, 0, choose=3)  # type: ignore[arg-type]
    assert str(caught.value) == told
    with pytest.raises(UserError, match="by their best responses' events only 1 of 3"):
        measure_partners(TallyEnv, mixed, players([ONE], [ONE], [ONE]), 1, 0, choose=2)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="only 0 of 1 partners are .*; give partners that do something"):
        measure_partners(TallyEnv, players([STAY]), None, 1, 0, choose=1)  # type: ignore[arg-type]


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
    got = measure_partners(make, [idle, rand], None, 3, 0)  # type: ignore[arg-type]
    assert got.kinds.shape == (2, 28) and got.counts.tolist() == counts.tolist()
    stays = BR_DIV_EVENTS.index("STAY")
    assert got.kinds[0].nonzero()[0].tolist() == [stays, 14 + stays] and set(got.kinds[0]) == {0.0, 20.0}
