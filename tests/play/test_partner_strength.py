from __future__ import annotations

import json

import pytest
from support.small import AGENT, MODEL, kitchen

from popgen.methods.xpm_wm.agent import AgentLearner
from popgen.play.partner_strength import PartnerStrength

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
