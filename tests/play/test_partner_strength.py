from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
from support.small import AGENT, MODEL, kitchen

from popgen.methods.xpm_wm.agent import AgentLearner
from popgen.play.partner_strength import PartnerStrength, any_or_strongest, any_then_strongest, strongest_partner

ROUNDS = ({1: [10.0, 20.0], 2: [4.0]}, {1: [1.0, 2.0], 2: [8.0, 8.0, 5.0]}, {1: [], 2: [6.0]})
WANTED = {"max_window": {1: 1.5, 2: 6.0}, "max_buffer": {1: 33.0 / 4, 2: 31.0 / 5}}
STRONGEST = {"max_window": 2, "max_buffer": 1}


@pytest.mark.parametrize("rule", WANTED)
def test_windows_know_the_last_episodes_and_buffers_all(rule: str) -> None:
    returns = PartnerStrength(rule)  # type: ignore[arg-type]
    assert returns.scores() == {}
    for number, found in enumerate(ROUNDS):
        if number == 2:  # a run that was interrupted goes on with the same
            state = json.loads(json.dumps(returns.state()))
            returns = PartnerStrength(rule)  # type: ignore[arg-type]
            returns.load_state(state)
        for partner, scores in found.items():
            returns.add(partner, scores)
    assert returns.scores() == pytest.approx(WANTED[rule])


@pytest.mark.parametrize("rule", WANTED)
def test_the_learner_picks_the_strongest_but_first_one_not_seen(rule: str) -> None:
    learner = AgentLearner(AGENT, MODEL, kitchen().spec, member=4, seed=0)
    weights = learner.actor_weights()
    for partner in (1, 2, 3):
        learner.add_partner(partner, weights)
    returns = PartnerStrength(rule)  # type: ignore[arg-type]
    for found in ROUNDS:
        for partner, scores in found.items():
            returns.add(partner, scores)
        learner.partner_scores = returns.scores()
        assert learner.choose_partner() == 3
    returns.add(3, [0.5])
    learner.partner_scores = returns.scores()
    assert learner.choose_partner() == STRONGEST[rule]


PARTNERS = (1, 2, 4)


def latest(window: int | None = 2) -> PartnerStrength:
    strength = PartnerStrength("max_latest", window)
    for partner, reward in ((1, 5.0), (2, 9.0), (4, 1.0)):
        strength.add(partner, [reward], [reward / 10])
    return strength


def strongest(strength: PartnerStrength) -> int:
    return strongest_partner(PARTNERS, strength.scores())


def test_the_highest_mean_return_of_the_window_wins() -> None:
    strength = latest()
    assert strongest(strength) == 2
    for reward in (7.0, 12.0):  # the 5.0 has left the window of two
        strength.add(1, [reward], [0.0])
    assert strongest(strength) == 1 and strength.mean_scores() == {1: 0.0, 2: 0.9, 4: 0.1}


def test_one_without_episodes_comes_first() -> None:
    strength = latest()
    strength.forget(4)
    assert strongest(strength) == 4 and 4 not in strength.mean_scores()
    assert strongest_partner((1, 4, 6), strength.scores(), {4: 1.0, 6: 2.0}) == 6  # the guess leads among them
    assert strongest_partner((1, 4, 6), strength.scores(), {6: 2.0}) == 4  # no guess at all comes before that


def test_without_a_window_every_episode_since_the_last_choice_counts() -> None:
    strength = PartnerStrength("max_latest")
    for reward in range(100):
        strength.add(1, [float(reward)])
    strength.add(2, [60.0])
    assert strongest_partner((1, 2), strength.scores()) == 2  # 49.5 of all hundred; the latest alone would be more
    strength.forget(2)
    strength.add(2, [49.0])
    assert strongest_partner((1, 2), strength.scores()) == 1


@pytest.mark.parametrize("choose", [any_or_strongest, any_then_strongest])
def test_a_share_of_choices_is_any_partner(choose: Callable[..., int]) -> None:
    rng, scores = np.random.default_rng(0), latest().scores()
    chosen = [choose(PARTNERS, scores, 0.3, rng) for _ in range(3000)]
    shares = np.bincount(chosen, minlength=5)[[1, 2, 4]] / 3000
    np.testing.assert_allclose(shares, [0.1, 0.8, 0.1], atol=0.02)
    assert {choose(PARTNERS, scores, 0.0, rng) for _ in range(50)} == {2}


def test_continuing_from_a_state() -> None:
    strength, other = latest(), PartnerStrength("max_latest", 2)
    other.add(1, [100.0], [0.0])
    other.load_state(json.loads(json.dumps(strength.state())))
    assert other.state() == strength.state() and strongest(other) == 2
    assert other.returns[1].maxlen == 2


def test_nobody_to_choose_from() -> None:
    with pytest.raises(ValueError):
        strongest_partner((), {})
