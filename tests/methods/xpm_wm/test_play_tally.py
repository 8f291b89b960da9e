"""Counts of real play: events, players' own states; against direct counting, and through a checkpoint."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from support.small import kitchen, random_play

from popgen.durable_files import load_state, save_state
from popgen.methods.xpm_wm.real_play import TallyKeeper, part_weights

VIEW = kitchen().spec.views["features"]


def kept(*owners: int) -> tuple[TallyKeeper, list]:
    keeper = TallyKeeper(kitchen(), "features")
    segments = [segment for owner in owners for segment in random_play(kitchen(4), 30, seed=owner)]
    for owner, segment in zip(owners, segments, strict=True):
        keeper.add(segment, owner)
    return keeper, segments


def test_own_entries_are_the_looking_players_and_trade_places_with_the_others() -> None:
    own = [entry for part in VIEW.own for entry in part]
    assert VIEW.swap is not None
    others = [VIEW.swap[entry] for entry in own]
    assert not set(own) & set(others) and [VIEW.swap[entry] for entry in others] == own
    moved = {entry for entry, other in enumerate(VIEW.swap) if entry != other}
    assert moved == set(own) | set(others)


def test_visits_are_those_of_each_players_own_state() -> None:
    keeper, (segment,) = kept(1)
    obs = kitchen().encode(segment.states.reshape(-1, segment.states.shape[-1]), "features")
    own = [entry for part in VIEW.own for entry in part]
    counted = Counter(tuple(row) for row in obs.reshape(-1, obs.shape[-1])[:, own].tolist())
    tally = keeper.tally(1)
    assert sorted(tally.visits.tolist()) == sorted(counted.values()) and tally.visits.sum() == 2 * segment.steps
    weights = np.concatenate(part_weights(VIEW))
    assert set(tally.keys.tolist()) == {int(np.array(row) @ weights) for row in counted}
    assert [len(known) for known in tally.known][1] == 4  # orientations


def test_events_of_a_members_self_play_are_told_from_all() -> None:
    keeper, (first, second) = kept(1, 2)
    tally = keeper.tally(2)
    assert tally.events.tolist() == (first.events.sum((0, 1, 2)) + second.events.sum((0, 1, 2))).tolist()
    assert tally.own_steps == 0 and not tally.own_events.any()  # random play is nobody's self-play


def test_counts_come_back_from_a_checkpoint(tmp_path: Path) -> None:
    keeper, _ = kept(1, 2)
    save_state(tmp_path / "s", {"keeper": keeper.state()})
    again = TallyKeeper(kitchen(), "features")
    again.load_state(load_state(tmp_path / "s")["keeper"])
    tally, wanted = again.tally(1), keeper.tally(1)
    assert tally.own_steps == wanted.own_steps and len(tally.known) == len(wanted.known) == 3
    for name in ("events", "own_events", "keys", "visits"):
        assert np.array_equal(getattr(tally, name), getattr(wanted, name))
    assert all(np.array_equal(a, b) for a, b in zip(tally.known, wanted.known, strict=True))


def test_events_alone_are_counted_without_a_view() -> None:
    keeper = TallyKeeper(kitchen(), "")
    keeper.add(random_play(kitchen(4), 30)[0], 1)
    assert not len(keeper.tally(1).keys) and keeper.tally(1).known == ()
