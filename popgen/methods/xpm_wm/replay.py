"""B_SP and B_XP: a ring of compact environment states; observations are encoded when a batch is drawn.

A row is one transition (s_t, a_t, e_{t+1}); where an episode terminated, one more row holds the terminal state.
Rows of one environment lie contiguously in a *stream*; a window never crosses streams.
No torch here: the actors that hold the buffers would load it for nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from popgen.config.sections import EnvConfig
from popgen.envs import make_env
from popgen.envs.contract import BatchedEnv, EnvSpec
from popgen.methods.training import Pending
from popgen.methods.xpm_wm.config import DiscoveryConfig, WorldModelRun
from popgen.methods.xpm_wm.real_play import Tally, TallyKeeper, event_pay
from popgen.types import Kind, Segment

KIND_CODE = {kind: code for code, kind in enumerate(Kind)}


@dataclass(frozen=True)
class Windows:
    """N windows of L states, batch first; everything at t belongs to the state at t (see docs/design.md).

    obs (N, L, P, *shape) in the view's dtype; actions (N, L, P) int64, the joint action that led to the state;
    events (N, L, P, E) uint8 that it caused; is_first (N, L) bool; terminal (N, L) bool; partner (N,) int64,
    the other member of a cross-play window, 0 elsewhere; kind (N,) int64, a KIND_CODE; chosen (N,) bool: drawn for an
    event that it contains.
    """

    obs: np.ndarray
    actions: np.ndarray
    events: np.ndarray
    is_first: np.ndarray
    terminal: np.ndarray
    partner: np.ndarray
    kind: np.ndarray
    chosen: np.ndarray


def exchange_players(windows: Windows) -> Windows:
    """The windows with their players exchanged: true ones too, but for who goes first where both interact with one
    thing in the same step, and where a player cannot reach the other's places."""
    obs, actions, events = (array[:, :, ::-1].copy() for array in (windows.obs, windows.actions, windows.events))
    return replace(windows, obs=obs, actions=actions, events=events)


@dataclass(frozen=True)
class Query:
    """Which rows to draw from; None means no condition.

    owner: member during whose training the row was collected, with `owner_is` "equal" or "below".
    partner: the other member of cross-play rows.
    recent: only this last share of the rows that match.
    last: only so many of the last rows that match.
    """

    owner: int | None = None
    owner_is: str = "equal"
    kind: Kind | None = None
    partner: int | None = None
    recent: float = 1.0
    last: int | None = None


def by_event(batch: int, event_fraction: float) -> int:
    """How many of a batch of windows are chosen for an event: the first ones."""
    return int(round(batch * event_fraction))


class Replay:
    """A ring buffer of transitions.

    Args:
        env: encodes states; its own episode is not touched.
        capacity: rows; each takes the bytes of a state and 2 + P * E + 15 more.
        seed: of the sampling generator.
    """

    COLUMNS = ("states", "actions", "events", "first", "terminal", "stream", "owner", "partner", "kind")

    def __init__(self, env: BatchedEnv, capacity: int, seed: int) -> None:
        spec = env.spec
        self.env, self.capacity = env, capacity
        self.rng = np.random.default_rng(seed)
        self.size = self.head = self.streams = self.added = 0
        self._cache: dict[Any, np.ndarray] = {}
        self.states = np.zeros((capacity, spec.state_size), spec.state_dtype)
        self.actions = np.zeros((capacity, 2), np.uint8)
        self.events = np.zeros((capacity, 2, spec.num_events), np.uint8)
        self.first = np.zeros(capacity, bool)
        self.terminal = np.zeros(capacity, bool)
        self.stream = np.full(capacity, -1, np.int64)
        self.owner = np.zeros(capacity, np.int16)
        self.partner = np.zeros(capacity, np.int16)
        self.kind = np.zeros(capacity, np.uint8)

    def add(self, segment: Segment, owner: int) -> None:
        """Store every environment of a segment as a stream of its own."""
        pair = segment.members
        partner = 0 if pair[0] == pair[1] else min(pair) if max(pair) == owner else max(pair)
        for column in range(segment.reward.shape[1]):
            self._add_stream(segment, column, owner, partner)
        self._cache.clear()

    def _add_stream(self, segment: Segment, column: int, owner: int, partner: int) -> None:
        ended = segment.terminated[:, column]
        order = np.concatenate([np.arange(len(ended)), np.flatnonzero(ended) + 0.5]).argsort(kind="stable")
        source = np.concatenate([np.arange(len(ended)), np.flatnonzero(ended)])[order]
        arrival = order >= len(ended)
        rows = self._reserve_rows(len(source))
        self.states[rows] = segment.states[source, column]
        self.states[rows[arrival]] = segment.next_states[source[arrival], column]
        self.actions[rows] = segment.actions[source, column]
        self.events[rows] = segment.events[source, column]
        self.events[rows[arrival]] = 0
        done = (segment.terminated | segment.truncated)[source, column]
        after_done = np.concatenate([[True], (done & (arrival | ~segment.terminated[source, column]))[:-1]])
        self.first[rows] = after_done
        self.terminal[rows] = arrival
        self.stream[rows] = self.streams
        self.owner[rows], self.partner[rows] = owner, partner
        self.kind[rows] = KIND_CODE[segment.kind]
        self.streams += 1
        self.added += len(rows)

    def _reserve_rows(self, count: int) -> np.ndarray:
        if count > self.capacity:
            raise ValueError(f"a stream of {count} rows does not fit a replay of {self.capacity}")
        if self.head + count > self.capacity:
            self.stream[self.head : self.size] = -1
            self.head = 0
        rows = np.arange(self.head, self.head + count)
        self.head += count
        self.size = max(self.size, self.head)
        return rows

    def rows(self, query: Query, event: int | None = None) -> np.ndarray:
        """Row numbers that match (and at which a window can show `event`), oldest first; cached until the next add."""
        key = (query, event)
        if key not in self._cache:
            self._cache[key] = self._find_rows(query) if event is None else self._rows_showing(self.rows(query), event)
        return self._cache[key]

    def _find_rows(self, query: Query) -> np.ndarray:
        match = self.stream[: self.size] >= 0
        if query.owner is not None:
            owner = self.owner[: self.size]
            match &= owner == query.owner if query.owner_is == "equal" else owner < query.owner
        if query.kind is not None:
            match &= self.kind[: self.size] == KIND_CODE[query.kind]
        if query.partner is not None:
            match &= self.partner[: self.size] == query.partner
        rows = np.flatnonzero(match)
        wrapped = int(np.searchsorted(rows, self.head))  # rows from the head on are the ring's oldest
        rows = np.concatenate([rows[wrapped:], rows[:wrapped]])
        kept = int(np.ceil(len(rows) * query.recent))
        return rows[len(rows) - (kept if query.last is None else min(kept, query.last)) :]

    def _rows_showing(self, rows: np.ndarray, event: int) -> np.ndarray:
        """Those of the rows at which a window can show the event."""
        rows = rows[self.events[rows, :, event].any(1)]
        # A window shows an event at the state it led to, which is not stored where an episode was cut.
        return rows[self._is_whole(rows, 2) & ~self.first[(rows + 1) % self.capacity]]

    def sample(
        self, batch: int, length: int, query: Query, *, event_fraction: float = 0.0, turn: int = 0
    ) -> np.ndarray:
        """First rows of `batch` windows of `length`; a share contains an event, the types in turn.

        Raises:
            LookupError: no window of that length matches.
        """
        starts = self._draw_starts(self.rows(query), batch, length, offset=0)
        for slot in range(by_event(batch, event_fraction)):
            event = (turn + slot) % self.env.spec.num_events
            rows = self.rows(query, event)
            if len(rows):
                offset = int(self.rng.integers(0, length - 1))
                picked = self._draw_starts(rows, 1, length, offset=offset, strict=False)
                if len(picked):
                    starts[slot] = picked[0]
        return starts

    def before_events(self, batch: int, length: int, query: Query, events: list[int], reach: int) -> np.ndarray:
        """First rows of windows whose last state lies up to `reach` steps before one of the events, in its episode."""
        rows = np.unique(np.concatenate([self.rows(query, event) for event in events])) if events else np.array([], int)
        if not len(rows):
            return self.sample(batch, length, query)
        lead = self.rng.integers(0, reach, size=batch * 4)
        picked = rows[self.rng.integers(0, len(rows), size=batch * 4)]
        last, episode = picked - lead, np.cumsum(self.first[: self.size])
        same = (self.stream[last] == self.stream[picked]) & (episode[last] == episode[picked])
        starts = (last - (length - 1))[same]
        starts = starts[self._is_whole(starts, length)][:batch]
        missing = batch - len(starts)
        return np.concatenate([starts, self.sample(missing, length, query)]) if missing else starts

    def _draw_starts(
        self, rows: np.ndarray, batch: int, length: int, *, offset: int, strict: bool = True
    ) -> np.ndarray:
        kept: list[np.ndarray] = []
        missing = batch
        for _ in range(50):
            if missing <= 0 or not len(rows):
                break
            starts = rows[self.rng.integers(0, len(rows), size=2 * missing + 8)] - offset
            starts = starts[self._is_whole(starts, length)][:missing]
            kept.append(starts)
            missing -= len(starts)
        if missing and strict:
            raise LookupError(f"the replay has no window of {length} states that matches")
        return np.concatenate(kept) if kept else np.array([], np.int64)

    def _is_whole(self, starts: np.ndarray, length: int) -> np.ndarray:
        inside = (starts >= 0) & (starts + length <= self.size)
        first, last = self.stream[np.where(inside, starts, 0)], self.stream[np.where(inside, starts + length - 1, 0)]
        return inside & (first == last) & (first >= 0)

    def windows(self, starts: np.ndarray, length: int, view: str, chosen: np.ndarray | None = None) -> Windows:
        """Encode the windows that begin at rows `starts` (N,), of which `chosen` (N,) were drawn for an event."""
        index = starts[:, None] + np.arange(length)
        before = np.maximum(index - 1, 0)
        is_first = self.first[index].copy()
        is_first[:, 0] = True
        return Windows(
            obs=self.env.encode(self.states[index], view),
            actions=self.actions[before].astype(np.int64),
            events=self.events[before],
            is_first=is_first,
            terminal=self.terminal[index],
            partner=self.partner[starts].astype(np.int64),
            kind=self.kind[starts].astype(np.int64),
            chosen=np.zeros(len(starts), bool) if chosen is None else chosen,
        )

    def _stored_columns(self) -> dict[str, np.ndarray]:
        return {name: getattr(self, name) for name in self.COLUMNS}

    def state(self) -> dict[str, Any]:
        """Everything needed to continue: arrays of the filled part, counters and the generator (JSON-able)."""
        arrays = {name: column[: self.size].copy() for name, column in self._stored_columns().items()}
        counters = {
            "head": self.head,
            "streams": self.streams,
            "added": self.added,
            "rng": self.rng.bit_generator.state,
        }
        return {"arrays": arrays, "counters": counters}

    def load_state(self, state: dict[str, Any]) -> None:
        """Replace the contents with `state()` of another replay.

        Raises:
            ValueError: it holds more rows than this one's capacity.
        """
        arrays, counters = state["arrays"], state["counters"]
        if len(arrays["stream"]) > self.capacity:
            raise ValueError(f"{len(arrays['stream'])} rows do not fit a replay of {self.capacity}")
        self.size = len(arrays["stream"])
        for name, column in self._stored_columns().items():
            column[: self.size] = arrays[name]
        self.head, self.streams, self.added = (int(counters[name]) for name in ("head", "streams", "added"))
        self.rng.bit_generator.state = counters["rng"]
        self._cache.clear()


def find_most_paid(replay: Replay, pay: np.ndarray, steps: int) -> np.ndarray:
    """(steps,) float64: the most that up to 1, 2, ... steps on end of an episode have earned, where events pay `pay`
    (E,)."""
    size, stream, most = replay.size, replay.stream[: replay.size], np.zeros(steps)
    earned = np.concatenate([[0.0], np.cumsum(replay.events[:size].sum(1, dtype=np.int64) @ pay)])
    episode = np.cumsum(replay.first[:size])
    for length in range(1, min(steps, size) + 1):
        first, last = slice(0, size - length + 1), slice(length - 1, size)
        whole = (stream[first] >= 0) & (stream[first] == stream[last]) & (episode[first] == episode[last])
        most[length - 1] = (earned[length:] - earned[:-length])[whole].max(initial=0.0)
    return np.maximum.accumulate(most)


# ---- requests of several kinds of windows ----------------------------------------------------------------------------


OLD, NEW_SP, NEW_XP = 0, 1, 2
"""Labels of start states: data of earlier members and random play, own self-play, own cross-play."""


@dataclass(frozen=True)
class Request:
    """`count` windows that match `query`.

    event_fraction: share that contains an event, the types in turn.
    events, reach: instead, windows that end up to `reach` steps before one of these events.
    pool: label of the start states made of them (see `popgen.methods.xpm_wm.imagination`).
    """

    query: Query
    count: int
    event_fraction: float = 0.0
    events: tuple[int, ...] = ()
    reach: int = 0
    pool: int = 0


def draw(replay: Replay, request: Request, length: int, view: str, turn: int = 0) -> Windows | None:
    """The windows of one request, or None if nothing matches yet."""
    if request.count < 1 or not len(replay.rows(request.query)):
        return None
    if request.events:
        starts = replay.before_events(request.count, length, request.query, list(request.events), request.reach)
    else:
        starts = replay.sample(request.count, length, request.query, event_fraction=request.event_fraction, turn=turn)
    chosen = np.arange(len(starts)) < (
        len(starts) if request.events else by_event(request.count, request.event_fraction)
    )
    return replay.windows(starts, length, view, chosen)


def join(parts: list[Windows]) -> Windows:
    """Several batches of windows as one."""
    return Windows(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Windows)))


# ---- what each update draws ------------------------------------------------------------------------------------------


LATE = 0.3
"""Share of a buffer's rows that counts as late data."""


@dataclass(frozen=True)
class Draws:
    """Requests to the two replays."""

    sp: tuple[Request, ...]
    xp: tuple[Request, ...] = ()


def model_batch(config: WorldModelRun, member: int) -> Draws:
    """Windows of one world-model update.

    Member 1 learns from everything it has, a share of it from the last rows: a policy finds the rewards that the
    model only imagines, and what it then does in reality must be seen often to be unlearned. Later members mix the
    kept buffers with their own new data, the latter half self-play and half cross-play where there is any.
    """
    batch, events = config.world_model.batch, config.replay.event_fraction
    if member == 1:
        recent = int(round(batch * config.phase1.recent_fraction))
        late = (Request(Query(last=config.phase1.recent_rows), recent, events),) if recent else ()
        return Draws(sp=(Request(Query(), batch - recent, events), *late))
    new = int(round(batch * config.phase2.new_fraction))
    meets = config.phase2.episodes_xp > 0
    old, old_xp = batch - new, (batch - new) // 4 if meets and member > 2 else 0
    new_xp = new // 2 if meets else 0
    kept, own = Query(owner=member, owner_is="below"), Query(owner=member)
    return Draws(
        sp=(Request(kept, old - old_xp, events), Request(own, new - new_xp, events)),
        xp=(Request(kept, old_xp, events), Request(own, new_xp, events)),
    )


def major_events(spec: EnvSpec) -> tuple[int, ...]:
    """Events worth more than the median event: in Overcooked, taking and delivering a soup."""
    median = float(np.median(spec.event_weights))
    return tuple(i for i, weight in enumerate(spec.event_weights) if weight > median)


def start_batch(config: WorldModelRun, spec: EnvSpec, member: int, windows: int) -> Draws:
    """Windows whose last states become starts of imagination for a later member.

    Old states: random play, the moments before a soup is taken or delivered, and late data. New states: this
    member's own self-play and cross-play.
    """
    phase = config.phase2
    kept = {"owner": member, "owner_is": "below"}
    shares = {"random": phase.starts_random, "event": phase.starts_event}
    random, event = (int(round(windows * shares[name])) for name in ("random", "event"))
    late = windows - random - event
    meets = phase.episodes_xp > 0
    late_xp = late // 2 if meets and member > 2 else 0
    return Draws(
        sp=(
            Request(Query(**kept, kind=Kind.RANDOM), random, pool=OLD),
            Request(Query(**kept), event, events=major_events(spec), reach=phase.event_reach, pool=OLD),
            Request(Query(**kept, kind=Kind.SP, recent=LATE), late - late_xp, pool=OLD),
            Request(Query(owner=member), windows // 2, pool=NEW_SP),
        ),
        xp=(
            Request(Query(**kept, kind=Kind.XP, recent=LATE), late_xp, pool=OLD),
            Request(Query(owner=member, kind=Kind.XP), windows // 2 if meets else 0, pool=NEW_XP),
        ),
    )


class ReplayActor:
    """Takes segments once each, serves encoded windows, and tells what it has taken in.

    Args:
        counted: view whose players' own states are counted; "" for none.
    """

    def __init__(self, env: EnvConfig, capacity: int, seed: int, counted: str = "") -> None:
        self.replay = Replay(make_env(env.name, 1, **env.params), capacity, seed)
        self.keeper = TallyKeeper(self.replay.env, counted)
        self.seen: set[tuple[str, int]] = set()
        self.turn = 0

    def ingest(self, segments: Pending[list[Segment]], owner: int) -> int:
        """Store segments; a retried call adds nothing. Returns the rows held."""
        for segment in segments.result():
            key = (segment.sampler, segment.sequence)
            if key not in self.seen:
                self.seen.add(key)
                self.replay.add(segment, owner)
                self.keeper.add(segment, owner)
        return self.replay.size

    def draw(self, requests: tuple[Request, ...], length: int, view: str, repeats: int) -> list[list[Windows | None]]:
        """For each of `repeats` updates, the windows of every request (None where nothing matches)."""
        drawn = []
        for _ in range(repeats):
            drawn.append([draw(self.replay, request, length, view, self.turn) for request in requests])
            self.turn += 1
        return drawn

    def tally(self, owner: int) -> Tally:
        """Of all segments so far, with `owner` as the present member."""
        return self.keeper.tally(owner)

    def most_paid(self, discovery: DiscoveryConfig, steps: int) -> np.ndarray:
        """(steps,) float64: the most that up to 1, 2, ... steps on end of what is held have earned, at the pay of
        imagination."""
        return find_most_paid(self.replay, event_pay(discovery, self.replay.env.spec), steps)

    def state(self) -> dict[str, Any]:
        """Contents, counters and generator."""
        seen = sorted([list(key) for key in self.seen])
        return {"replay": self.replay.state(), "seen": seen, "turn": self.turn, "tally": self.keeper.state()}

    def marks(self) -> dict[str, Any]:
        """What `state` holds beside the contents: small enough for every iteration."""
        return {"rng": self.replay.rng.bit_generator.state, "turn": self.turn}

    def load_marks(self, marks: dict[str, Any]) -> None:
        """Draw on from `marks()`, with contents that were added again."""
        self.replay.rng.bit_generator.state = marks["rng"]
        self.turn = int(marks["turn"])

    def load_state(self, state: Pending[dict[str, Any]]) -> None:
        """Continue from `state()`."""
        contents = state.result()
        self.replay.load_state(contents["replay"])
        self.seen = {(str(name), int(number)) for name, number in contents["seen"]}
        self.turn = int(contents["turn"])
        self.keeper.load_state(contents["tally"])
