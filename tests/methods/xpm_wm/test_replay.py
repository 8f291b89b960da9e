from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from popgen.methods.xpm_wm.replay import KIND_CODE, Query, Replay, Request, draw, find_most_paid, join
from popgen.types import RANDOM_MEMBER, Kind, Segment

EVENTS = 3


class Numbers:
    """What a replay needs of an environment whose states are numbers; player p sees (state, p)."""

    spec = SimpleNamespace(state_size=1, state_dtype="int64", num_events=EVENTS)

    def encode(self, states: np.ndarray, view: str) -> np.ndarray:
        assert view == "numbers"
        both = np.broadcast_to(states[..., None, :], (*states.shape[:-1], 2, 1))
        return np.concatenate([both, np.broadcast_to([[0], [1]], both.shape)], -1)


@dataclass
class Row:
    """One state as a window must show it: how it was reached, and whether an episode begins or ends in it."""

    state: int
    action: tuple[int, int] | None
    events: np.ndarray | None
    first: bool
    terminal: bool


@dataclass
class Stream:
    """All states of one environment of a segment, in order, and what queries ask for."""

    rows: list[Row]
    owner: int
    partner: int
    kind: Kind


class History:
    """Random segments, kept in the most naive way."""

    def __init__(self, seed: int, *, event_rate: float = 0.2, ends: tuple[float, float] = (0.1, 0.1)) -> None:
        self.rng = np.random.default_rng(seed)
        self.event_rate, self.ends = event_rate, ends
        self.numbers = 0
        self.streams: list[Stream] = []
        self.segments: list[tuple[Segment, int]] = []

    def state(self) -> int:
        self.numbers += 1
        return self.numbers

    def segment(self, steps: int, envs: int, owner: int, members: tuple[int, int], kind: Kind) -> tuple[Segment, int]:
        """A segment of `envs` environments, each of which is also kept as a stream."""
        rng = self.rng
        shape = (steps, envs)
        states, following = np.zeros((*shape, 1), np.int64), np.zeros((*shape, 1), np.int64)
        actions = rng.integers(0, 6, (*shape, 2)).astype(np.uint8)
        events = (rng.random((*shape, 2, EVENTS)) < self.event_rate).astype(np.uint8)
        terminated, truncated = rng.random(shape) < self.ends[0], rng.random(shape) < self.ends[1]
        partner = 0 if members[0] == members[1] else sum(members) - owner
        for env in range(envs):
            rows, fresh, state = [], True, self.state()
            action: tuple[int, int] | None = None
            caused: np.ndarray | None = None
            for t in range(steps):
                rows.append(Row(state, action, caused, fresh, False))
                states[t, env], following[t, env] = state, self.state()
                action, caused, fresh, state = tuple(actions[t, env].tolist()), events[t, env], False, self.numbers
                if terminated[t, env]:
                    rows.append(Row(state, action, caused, False, True))
                if terminated[t, env] or truncated[t, env]:
                    fresh, state, action, caused = True, self.state(), None, None
            self.streams.append(Stream(rows, owner, partner, kind))
        reward = np.zeros(shape, np.float32)
        columns = (states, following, actions, reward, reward, events, terminated, truncated)
        segment = Segment(kind, members, *columns, sampler="s", sequence=len(self.segments))
        self.segments.append((segment, owner))
        return self.segments[-1]

    def random_segment(self) -> tuple[Segment, int]:
        rng = self.rng
        owner = int(rng.integers(1, 5))
        kind = Kind(rng.choice(["random", "SP", "XP"])) if owner > 1 else Kind.SP
        members = (owner, owner)
        if kind is Kind.RANDOM:
            members = (RANDOM_MEMBER, RANDOM_MEMBER)
        elif kind is Kind.XP:
            other = int(rng.integers(1, owner))
            members = (owner, other) if rng.random() < 0.5 else (other, owner)
        return self.segment(int(rng.integers(1, 14)), int(rng.integers(1, 4)), owner, members, kind)

    def place(self, state: int) -> tuple[Stream, int]:
        for stream in self.streams:
            for index, row in enumerate(stream.rows):
                if row.state == state:
                    return stream, index
        raise AssertionError(f"state {state} was never stored")

    def held(self, capacity: int) -> list[tuple[Stream, int]]:
        """(stream, index) of the rows a ring of `capacity` still holds, oldest first, streams never being split."""
        ring: list[tuple[int, Stream, int] | None] = []
        head = age = 0
        for stream in self.streams:
            if head + len(stream.rows) > capacity:
                del ring[head:]
                head = 0
            for index in range(len(stream.rows)):
                ring[head : head + 1] = [(age, stream, index)]
                head, age = head + 1, age + 1
        return [(stream, index) for _, stream, index in sorted((r for r in ring if r), key=lambda r: r[0])]


def filled(history: History, capacity: int, seed: int = 0) -> Replay:
    replay = Replay(Numbers(), capacity, seed)  # type: ignore[arg-type]
    for segment, owner in history.segments:
        replay.add(segment, owner)
    return replay


def states_of(replay: Replay, rows: np.ndarray) -> list[int]:
    return replay.states[rows, 0].tolist()


def check_window(history: History, windows: Any, n: int) -> None:
    """Window n shows exactly the rows of one stream from its first state on."""
    ids = windows.obs[n, :, 0, 0]
    stream, start = history.place(int(ids[0]))
    rows = stream.rows[start : start + len(ids)]
    assert [row.state for row in rows] == ids.tolist()
    assert (windows.obs[n, :, :, 1] == [0, 1]).all()
    assert windows.is_first[n].tolist() == [t == 0 or row.first for t, row in enumerate(rows)]
    assert windows.terminal[n].tolist() == [row.terminal for row in rows]
    assert (windows.partner[n], windows.kind[n]) == (stream.partner, KIND_CODE[stream.kind])
    for t, row in enumerate(rows):
        if not windows.is_first[n, t]:
            assert tuple(windows.actions[n, t].tolist()) == row.action
            assert np.array_equal(windows.events[n, t], row.events)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("capacity", [60, 5000])
def test_windows_are_the_history_whatever_was_overwritten(seed: int, capacity: int) -> None:
    history = History(seed)
    replay = Replay(Numbers(), capacity, seed)  # type: ignore[arg-type]
    shown = 0
    for number in range(25):
        replay.add(*history.random_segment())
        assert states_of(replay, replay.rows(Query())) == [s.rows[i].state for s, i in history.held(capacity)]
        for length in (2, 5):
            try:
                starts = replay.sample(8, length, Query())
            except LookupError:
                continue
            windows = replay.windows(starts, length, "numbers")
            assert windows.obs.shape == (8, length, 2, 2) and windows.actions.dtype == np.int64
            for n in range(8):
                check_window(history, windows, n)
            shown += number > 15
    assert shown > 10
    assert replay.size <= capacity and (capacity == 5000 or replay.added > 3 * capacity)


def test_every_whole_window_is_drawn_and_no_other() -> None:
    history, capacity, length = History(3), 60, 4
    for _ in range(20):
        history.random_segment()
    replay = filled(history, capacity)
    held = {stream.rows[i].state for stream, i in history.held(capacity)}
    whole = set()
    for stream in history.streams:
        for start in range(len(stream.rows) - length + 1):
            if all(row.state in held for row in stream.rows[start : start + length]):
                whole.add(stream.rows[start].state)
    assert len(whole) > 10
    assert set(states_of(replay, replay.sample(2000, length, Query()))) == whole


@pytest.mark.parametrize(
    ("query", "wanted"),
    [
        (Query(owner=3), lambda s: s.owner == 3),
        (Query(owner=3, owner_is="below"), lambda s: s.owner < 3),
        (Query(kind=Kind.XP), lambda s: s.kind is Kind.XP),
        (Query(partner=1), lambda s: s.partner == 1),
        (Query(owner=4, kind=Kind.XP, partner=2), lambda s: (s.owner, s.kind, s.partner) == (4, Kind.XP, 2)),
        (Query(owner=4, owner_is="below", kind=Kind.RANDOM), lambda s: s.owner < 4 and s.kind is Kind.RANDOM),
    ],
)
def test_queries_select_the_rows_they_name(query: Query, wanted: Any) -> None:
    history = History(21)
    for _ in range(160):
        history.random_segment()
    replay = filled(history, 1200)
    assert replay.added > 1800
    expected = [s.rows[i].state for s, i in history.held(1200) if wanted(s)]
    assert len(expected) > 5
    assert states_of(replay, replay.rows(query)) == expected
    late = expected[len(expected) - int(np.ceil(0.3 * len(expected))) :]
    assert states_of(replay, replay.rows(replace(query, recent=0.3))) == late
    assert states_of(replay, replay.rows(replace(query, last=4))) == expected[-4:]
    assert states_of(replay, replay.rows(replace(query, last=10**6))) == expected
    for start in replay.sample(20, 2, query):
        assert wanted(history.place(int(replay.states[start, 0]))[0])


def test_rows_are_found_again_after_an_addition() -> None:
    history = History(2)
    replay = filled(history, 500)
    for _ in range(5):
        replay.add(*history.segment(6, 2, 1, (1, 1), Kind.SP))
        assert len(replay.rows(Query())) == sum(len(s.rows) for s in history.streams)


@pytest.mark.parametrize("event", range(EVENTS))
def test_event_windows_contain_the_event_whose_turn_it_is(event: int) -> None:
    history = History(4, event_rate=0.02, ends=(0.02, 0.02))
    for _ in range(12):
        history.segment(60, 2, 1, (1, 1), Kind.SP)
    replay, length = filled(history, 5000), 5
    places = set()
    for turn in range(event, event + 30 * EVENTS, EVENTS):
        starts = replay.sample(8, length, Query(), event_fraction=0.5, turn=turn)
        windows = replay.windows(starts, length, "numbers")
        for slot in range(4):
            found = windows.events[slot, 1:, :, (turn + slot) % EVENTS].any(-1) & ~windows.is_first[slot, 1:]
            assert found.any()
            places |= set((1 + np.flatnonzero(found)).tolist())
        for n in range(8):
            check_window(history, windows, n)
    assert places == {1, 2, 3, 4}, "the event is not always at the same place of the window"


def test_without_such_an_event_other_windows_stand_in() -> None:
    history = History(5, event_rate=0.0)
    history.segment(60, 2, 1, (1, 1), Kind.SP)
    replay = filled(history, 500)
    assert len(replay.sample(6, 4, Query(), event_fraction=1.0)) == 6
    assert len(replay.before_events(6, 4, Query(), [0], 3)) == 6
    assert len(replay.before_events(6, 4, Query(), [], 3)) == 6


def test_windows_before_events_end_a_few_steps_before_one() -> None:
    # Few events and many resets in short streams, so that the step before an event is often another episode's.
    history, length, reach = History(6, event_rate=0.01, ends=(0.05, 0.1)), 3, 6
    for _ in range(100):
        history.segment(20, 1, 1, (1, 1), Kind.SP)
    replay = filled(history, 5000)
    wanted, steps_ahead = (0, 2), []
    for start in replay.before_events(100, length, Query(), list(wanted), reach):
        stream, index = history.place(int(replay.states[start + length - 1, 0]))
        ahead = stream.rows[index + 1 : index + 1 + reach]
        resets = [n for n, row in enumerate(ahead) if row.first]
        episode = ahead[: resets[0]] if resets else ahead
        hits = [n for n, row in enumerate(episode) if row.events is not None and row.events[:, wanted].any()]
        assert hits
        steps_ahead.append(hits[0] + 1)
    assert set(steps_ahead) == set(range(1, reach + 1))


@pytest.mark.parametrize("seed", range(4))
def test_the_most_that_steps_on_end_have_earned_is_that_of_all_windows_of_episodes(seed: int) -> None:
    history, pay = History(seed), np.arange(1.0, 1.0 + EVENTS)
    for _ in range(12):
        history.random_segment()
    wanted = np.zeros(6)
    for segment, _ in history.segments:
        for env in range(segment.reward.shape[1]):
            ends = np.flatnonzero(segment.terminated[:, env] | segment.truncated[:, env]) + 1
            for episode in np.split(segment.events[:, env].sum(1) @ pay, ends):
                for begin in range(len(episode)):
                    for steps in range(1, 7):
                        wanted[steps - 1] = max(wanted[steps - 1], episode[begin : begin + steps].sum())
    assert find_most_paid(filled(history, 5000), pay, 6).tolist() == pytest.approx(wanted.tolist())
    assert find_most_paid(Replay(Numbers(), 10, 0), pay, 2).tolist() == [0.0, 0.0]  # type: ignore[arg-type]


def test_what_was_overwritten_pays_no_more() -> None:
    history = History(0, ends=(0.0, 0.0))
    for number in range(3):
        segment, _ = history.segment(10, 1, 1, (1, 1), Kind.SP)
        segment.events[:] = number == 0
    assert find_most_paid(filled(history, 30), np.ones(EVENTS), 3).tolist() == [2.0 * EVENTS * n for n in (1, 2, 3)]
    assert not find_most_paid(filled(history, 20), np.ones(EVENTS), 3).any()


def test_too_short_streams_are_told() -> None:
    history = History(7, ends=(0.0, 0.0))
    history.segment(3, 4, 1, (1, 1), Kind.SP)
    replay = filled(history, 100)
    assert len(replay.sample(5, 3, Query())) == 5
    with pytest.raises(LookupError, match="4 states"):
        replay.sample(5, 4, Query())
    with pytest.raises(LookupError):
        replay.sample(5, 3, Query(owner=2))


def test_a_stream_longer_than_the_ring_is_refused() -> None:
    history = History(8, ends=(0.0, 0.0))
    segment, owner = history.segment(30, 1, 1, (1, 1), Kind.SP)
    with pytest.raises(ValueError, match="30 rows does not fit a replay of 20"):
        Replay(Numbers(), 20, 0).add(segment, owner)  # type: ignore[arg-type]


@pytest.mark.parametrize("capacity", [70, 1000])
def test_a_restored_replay_goes_on_identically(capacity: int) -> None:
    history = History(9)
    for _ in range(15):
        history.random_segment()
    replay = filled(history, capacity)
    replay.sample(7, 2, Query())
    restored = Replay(Numbers(), capacity, seed=123)  # type: ignore[arg-type]
    restored.add(*History(10).segment(20, 1, 1, (1, 1), Kind.SP))
    restored.load_state(replay.state())
    for _ in range(8):
        addition = history.random_segment()
        for each in (replay, restored):
            each.add(*addition)
        assert np.array_equal(replay.rows(Query()), restored.rows(Query()))
        one, two = (each.sample(9, 2, Query(), event_fraction=0.5) for each in (replay, restored))
        assert np.array_equal(one, two)
        shown = [each.windows(one, 2, "numbers") for each in (replay, restored)]
        assert all(np.array_equal(getattr(shown[0], name), getattr(shown[1], name)) for name in vars(shown[0]))
    assert (replay.added, replay.streams, replay.head) == (restored.added, restored.streams, restored.head)


def test_a_ring_goes_on_in_a_larger_one_and_not_in_a_smaller_one() -> None:
    history = History(13)
    for _ in range(15):
        history.random_segment()
    replay = filled(history, 70)
    assert replay.added > 2 * 70 and replay.head < replay.size
    state = replay.state()
    with pytest.raises(ValueError, match="do not fit a replay of 40"):
        Replay(Numbers(), 40, 0).load_state(state)  # type: ignore[arg-type]
    larger = Replay(Numbers(), 90, 0)  # type: ignore[arg-type]
    larger.load_state(state)
    for _ in range(20):
        before = states_of(larger, larger.rows(Query()))
        segment, owner = history.segment(4, 1, 1, (1, 1), Kind.SP)
        larger.add(segment, owner)
        after = states_of(larger, larger.rows(Query()))
        new = [row.state for row in history.streams[-1].rows]
        kept = after[: -len(new)]
        assert after[-len(new) :] == new and kept == before[len(before) - len(kept) :]


def test_its_state_is_a_copy() -> None:
    history = History(11)
    history.segment(20, 1, 1, (1, 1), Kind.SP)
    replay = filled(history, 50)
    state = replay.state()
    kept = state["arrays"]["states"].copy()
    replay.add(*history.segment(40, 1, 1, (1, 1), Kind.SP))
    assert np.array_equal(state["arrays"]["states"], kept)


def test_requests() -> None:
    history = History(12)
    for _ in range(10):
        history.segment(30, 2, 1, (1, 1), Kind.SP)
    for _ in range(10):
        history.segment(30, 2, 2, (1, 2), Kind.XP)
    replay = filled(history, 5000)
    assert draw(replay, Request(Query(owner=3), 4), 3, "numbers") is None
    assert draw(replay, Request(Query(), 0), 3, "numbers") is None
    first = draw(replay, Request(Query(owner=1), 4), 3, "numbers")
    second = draw(replay, Request(Query(owner=2), 5, event_fraction=1.0), 3, "numbers", turn=1)
    third = draw(replay, Request(Query(owner=2), 6, events=(1,), reach=2), 3, "numbers")
    assert first and second and third
    assert second.events[0, 1:, :, 1].any() and second.events[1, 1:, :, 2].any()
    half = draw(replay, Request(Query(), 6, event_fraction=0.5), 3, "numbers")
    assert half is not None and half.chosen.tolist() == [True] * 3 + [False] * 3
    joined = join([first, second, third])
    assert joined.chosen.tolist() == [False] * 4 + [True] * 11
    assert joined.kind.tolist() == [KIND_CODE[Kind.SP]] * 4 + [KIND_CODE[Kind.XP]] * 11
    assert joined.partner.tolist() == [0] * 4 + [1] * 11
    assert np.array_equal(joined.obs[4:9], second.obs) and joined.obs.shape == (15, 3, 2, 2)
