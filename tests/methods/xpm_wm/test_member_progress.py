"""The rules that end a phase, on progress records alone; records go to a checkpoint and come back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from popgen.methods.training import InlineTransport, Ready
from popgen.methods.xpm_wm import phase1, phase2
from popgen.methods.xpm_wm.config import DiscoveryConfig, Phase1Config, Phase2Config
from popgen.methods.xpm_wm.phase1 import FirstMemberProgress
from popgen.methods.xpm_wm.phase2 import LaterMemberProgress
from popgen.methods.xpm_wm.real_play import (
    Candidate,
    MemberWeights,
    Tally,
    goes_by_tally,
    rare_events,
    seed_of_round,
)
from popgen.methods.xpm_wm.world_model import Starts
from popgen.play.episodes import Episode
from popgen.play.partner_strength import PartnerConstraint, PartnerStrength
from popgen.runs.checkpoints import resolve_handles
from popgen.types import Kind

AFTER = 0.5


def weights(value: float) -> MemberWeights:
    return MemberWeights(*(Ready({"w": np.full(2, value)}) for _ in range(3)))


LATEST, PLAYED = weights(1.0), weights(2.0)


def member() -> FirstMemberProgress:
    """Its window is 16 episodes; no step has been taken yet."""
    return FirstMemberProgress(16, playing_weights=PLAYED, published=LATEST)


def play(progress: FirstMemberProgress, phase: Phase1Config, *scores: float) -> None:
    progress.add_scores(scores, scores)
    phase1.keep_best(progress, phase, AFTER)


def test_patience_begins_when_there_is_a_window_to_judge_by() -> None:
    first, phase = member(), Phase1Config(patience=3, target_score=9.0)
    for _ in range(15):
        play(first, phase, 1.0)
        assert not phase1.should_stop(first, phase) and first.since_best == 0 and first.best is None
    for waited in range(3):
        play(first, phase, 1.0)
        assert first.since_best == waited and not phase1.should_stop(first, phase)
    play(first, phase, 1.0)
    assert first.since_best == 3 and phase1.should_stop(first, phase)
    play(first, phase, *[2.0] * 16)
    assert first.since_best == 0 and not phase1.should_stop(first, phase)


def test_scores_foretell_when_the_target_is_reached() -> None:
    """0 at 300 steps, 5 of 8 at 400: 3 more take 60; nothing below half of it, or where a plateau ends it."""
    first, phase = member(), Phase1Config(target_score=8.0, prefill_steps=200, max_steps=1000)
    for steps, score in ((300, 0.1), (360, 3.0), (400, 5.0)):
        first.steps = steps
        play(first, phase, *[score] * 16)
        ended = phase1.describe_first_round(first, phase, "dishes")
        assert ended.ends_at == (pytest.approx(260.0) if steps == 400 else None)
    first.steps = 950
    assert phase1.foresee_end(first, phase) == 800.0, "the budget ends it"
    assert phase1.foresee_end(first, Phase1Config(target_score=8.0, plateau=10)) is None


@pytest.mark.parametrize("target", [0.0, -2.0])
@pytest.mark.parametrize("score", [0.0, -1.0, 1.0])
def test_a_target_that_anybody_reaches_needs_no_rise_to_be_foretold(target: float, score: float) -> None:
    """From no score nothing can be foretold; one above such a target ends the phase where it is."""
    first, phase = member(), Phase1Config(target_score=target, prefill_steps=200, max_steps=1000)
    first.steps = 400
    play(first, phase, score)
    assert phase1.foresee_end(first, phase) == (200.0 if score > 0.0 else None)


def test_the_target_needs_a_whole_window_and_the_budget_does_not() -> None:
    first, phase = member(), Phase1Config(target_score=5.0, max_steps=100)
    first.add_scores([8.0] * 15, [])
    assert not phase1.should_stop(first, phase)
    first.add_scores([8.0], [])
    assert phase1.should_stop(first, phase) and phase1.reached_target(first, phase)
    first = member()
    first.steps = 100
    assert phase1.should_stop(first, phase) and not phase1.reached_target(first, phase)


@pytest.mark.parametrize(("last", "wanted"), [(9.6, LATEST), (9.4, PLAYED)])
def test_the_last_weights_are_taken_unless_those_that_played_best_were_better(
    last: float, wanted: MemberWeights
) -> None:
    first, phase = member(), Phase1Config()
    play(first, phase, *[10.0] * 16)
    play(first, phase, *[last] * 16)
    assert phase1.choose_first(first).weights is wanted


def test_without_a_whole_window_the_last_weights_are_all_there_is() -> None:
    first, phase = member(), Phase1Config()
    assert phase1.choose_first(first) == Candidate(LATEST, 0.0, 0.0)
    play(first, phase, 4.0, 2.0)
    assert phase1.choose_first(first) == Candidate(LATEST, 3.0, 0.0)


def test_self_play_has_started_once_a_whole_window_reached_its_share_of_the_target() -> None:
    first, phase = member(), Phase1Config(target_score=10.0)
    play(first, phase, *[5.0] * 15)
    assert not first.self_play_has_begun
    play(first, phase, 4.0)
    assert not first.self_play_has_begun  # 4.94 of 5
    play(first, phase, 6.0)
    assert first.self_play_has_begun
    play(first, phase, *[0.0] * 16)
    assert first.self_play_has_begun  # for good


def test_the_last_policy_must_reach_the_target_by_itself() -> None:
    """9.69 of 10 is too little, 9.7 enough; then it is taken although the best window was another's."""
    phase = Phase1Config(target_score=10.0)
    assert not phase1.is_confirmed(9.69, 10.0) and phase1.is_confirmed(9.7, 10.0)
    first = member()
    play(first, phase, *[20.0] * 16)
    first.add_scores([9.7] * 16, [])
    assert phase1.choose_first(first).weights is PLAYED
    first.confirmed = True
    chosen = phase1.choose_first(first)
    assert chosen.weights is LATEST and chosen.sp == pytest.approx(9.7)


def test_with_a_plateau_a_member_goes_on_past_its_target_until_it_no_longer_gains() -> None:
    """Windows of 10.0, 10.1 and 10.19 are no gains of 2 % over 10.0; 10.2 is one."""
    first, phase = member(), Phase1Config(target_score=10.0, plateau=3)
    play(first, phase, *[4.0] * 16)
    assert (first.mark, first.since_gain, first.self_play_has_begun) == (0.0, 0, False)
    for score, since in ((10.0, 0), (10.1, 1), (10.19, 2), (10.2, 0), (10.2, 1), (10.2, 2)):
        play(first, phase, *[score] * 16)
        assert (first.since_gain, phase1.should_stop(first, phase)) == (since, False)
    play(first, phase, *[10.2] * 16)
    assert phase1.has_levelled_off(first, phase) and phase1.should_stop(first, phase)


def test_a_member_that_does_not_play_has_not_levelled_off() -> None:
    first, phase = member(), Phase1Config(target_score=10.0, plateau=1)
    for _ in range(5):
        play(first, phase, *[4.9] * 16)
    assert not phase1.should_stop(first, phase)


def test_a_plateaus_policy_is_measured_by_its_own_best_and_waits_anew_if_it_fails() -> None:
    phase = Phase1Config(target_score=20.0, plateau=2)
    for score, taken in ((9.7, True), (9.69, False)):
        first = member()
        first.self_play_has_begun, first.mark, first.since_gain = True, 10.0, 2
        episodes = [Episode(Kind.SP, (1, 1), score, score)] * 16
        assert phase1.confirm_policy(first, episodes, phase) == pytest.approx(score)
        assert first.confirmed is taken and not phase1.is_done(first, phase)


def test_a_confirmation_needs_room_in_the_budget() -> None:
    first, phase = member(), Phase1Config(envs=16, max_steps=1000)
    for steps, room in ((840, True), (841, False)):
        first.steps = steps
        assert phase1.may_confirm(first, phase, horizon=10) is room


def test_actor_and_critics_restart_once_and_only_if_wanted() -> None:
    first = member()
    assert not phase1.restart_is_due(first, Phase1Config())
    phase = Phase1Config(restart_after=100, restart_updates=5)
    assert not phase1.restart_is_due(first, phase)
    first.steps = 100
    assert phase1.restart_is_due(first, phase)
    first.restarted = True
    assert not phase1.restart_is_due(first, phase)


@pytest.mark.parametrize(("steps", "rounds"), [(None, 7), (1_000_000, 7), (800, 5), (799, 4), (1, 1)])
def test_rounds_of_a_later_member_end_with_its_steps(steps: int | None, rounds: int) -> None:
    phase = Phase2Config(rounds=7, max_rounds=1, max_steps=steps, episodes_sp=2)
    assert phase2.most_rounds(phase, 2, horizon=40) == rounds  # (2 + 2) episodes of 40 steps each


def test_only_a_weak_member_plays_further_rounds() -> None:
    phase = Phase2Config(rounds=2, max_rounds=4, target_score=5.0)
    assert phase2.most_rounds(phase, 2, horizon=40) == 4
    for sp, wanted in ((4.9, 4), (5.0, 2)):
        progress = LaterMemberProgress(PartnerStrength("max_window"), best=Candidate(LATEST, sp, 0.0))
        while phase2.wants_another_round(progress, phase, 4):
            progress.rounds += 1
        assert progress.rounds == wanted


def test_with_a_plateau_a_later_member_goes_on_while_it_improves() -> None:
    phase = Phase2Config(rounds=2, max_rounds=6, target_score=5.0, plateau=2)
    for last_best, wanted in ((1, 3), (2, 4), (3, 5), (5, 6)):
        progress = LaterMemberProgress(PartnerStrength("max_window"), best=Candidate(LATEST, 5.0, 0.0))
        while phase2.wants_another_round(progress, phase, 6):
            progress.rounds += 1
            progress.since_best = max(0, progress.rounds - last_best)
        assert progress.rounds == wanted


def test_rare_events_are_those_seen_too_seldom() -> None:
    none = np.zeros(0, np.int64)
    tally = Tally(np.array([7, 3, 0]), np.zeros(3, np.int64), 0, none, none, ())
    assert rare_events(tally, DiscoveryConfig(rare_events=4)) == (1, 2)
    assert rare_events(tally, DiscoveryConfig()) == () == rare_events(None, DiscoveryConfig(rare_events=4))
    assert not goes_by_tally(DiscoveryConfig()) and goes_by_tally(DiscoveryConfig(trust=2.0))


def test_a_member_is_chosen_by_self_play_less_strongest_cross_play() -> None:
    assert Candidate(LATEST, 5.0, 3.5).merit() == 1.5


def test_cross_play_below_its_limit_is_worth_no_more_than_at_it() -> None:
    assert [Candidate(LATEST, 5.0, xp).merit(xp_limit=1.0) for xp in (0.0, 1.0, 3.0)] == [4.0, 4.0, 2.0]


def test_a_round_moves_the_multipliers_of_the_partners_it_met() -> None:
    """m + step (XP - limit) / (SP - limit): partner 1 at half of self-play's excess, 2 below the limit."""
    progress = LaterMemberProgress(PartnerStrength("max_window"), constraint=PartnerConstraint(1.0, 0.5))
    progress.constraint.multipliers = {1: 0.5, 2: 0.5}
    episodes = [
        Episode(Kind.SP, (3, 3), 9.0, 9.0),
        Episode(Kind.XP, (3, 1), 5.0, 5.0),
        Episode(Kind.XP, (2, 3), 0.0, 0.0),
    ]
    scored = phase2.judge_round(progress, LATEST, episodes, 400)
    assert (scored.sp, scored.xp) == (9.0, 5.0)
    assert progress.constraint.multipliers == {1: 0.75, 2: 0.5 - 0.5 / 8.0}


def saved(progress: FirstMemberProgress | LaterMemberProgress) -> dict[str, Any]:
    """As it is in a checkpoint: without handles."""
    return resolve_handles(progress.to_state())


def test_progress_of_member_1_comes_back_from_a_checkpoint() -> None:
    first, phase = member(), Phase1Config(target_score=4.0)
    play(first, phase, *map(float, range(20)))
    first.rounds, first.confirmations, first.restarted, first.figures = 7, 2, True, {"model/loss": 0.5}
    first.mark, first.since_gain, first.rose_from = 4.5, 2, 16
    first.recent_starts = Ready(Starts(*(np.ones((1, 2)) for _ in range(4))))
    first.model, first.starts = Ready({"m": np.ones(3)}), Ready(Starts(*(np.zeros((2, 2)) for _ in range(4))))
    again = FirstMemberProgress.from_state(saved(first), 16, 40, InlineTransport().put)
    assert again.steps == 40 and again.playing_weights is None  # set when the first sampler starts
    counters = ("rounds", "since_best", "confirmations", "restarted", "mark", "since_gain", "rose_from")
    for name in (*counters, "self_play_has_begun", "recent", "shaped", "figures"):
        assert getattr(again, name) == getattr(first, name)
    assert again.recent.maxlen == 16 and again.self_play_has_begun
    assert again.best is not None and first.best is not None and again.best.sp == first.best.sp
    assert np.array_equal(again.best.weights.acting.result()["w"], [2.0, 2.0])
    assert isinstance(again.starts.result(), Starts)  # type: ignore[union-attr]
    assert np.array_equal(again.recent_starts.result().h, np.ones((1, 2)))  # type: ignore[union-attr]


def test_progress_of_a_later_member_comes_back_from_a_checkpoint() -> None:
    best = Candidate(LATEST, 4.0, 1.0)
    later = LaterMemberProgress(
        PartnerStrength("max_window"), rounds=3, self_play_has_begun=True, best=best, since_best=2
    )
    later.strength.add(1, [2.0, 4.0])
    later.constraint.multipliers = {1: 0.25}
    again = LaterMemberProgress(PartnerStrength("max_window"), 160)
    again.load_state(saved(later), InlineTransport().put)
    assert again.constraint.multipliers == {1: 0.25}
    assert (again.rounds, again.self_play_has_begun, again.steps, again.since_best) == (3, True, 160, 2)
    assert again.strength.scores() == {1: 3.0} and again.best is not None and again.best.merit() == 3.0


def test_no_two_rounds_of_any_members_share_a_seed() -> None:
    assert seed_of_round(1002, 1) == 100_201 and seed_of_round(1002, 99) == 100_299
    seeds = {
        seed_of_round(1000 * run + member, number)
        for run in (0, 1)
        for member in range(2, 10)
        for number in range(1, 350)
    }
    assert len(seeds) == 2 * 8 * 349
    assert seed_of_round(2**31 * 1000, 350) < 2**63  # the most that generators take
