"""What learners ask of a replay in one call: several kinds of windows, for several updates at once."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from popgen.methods.xpm_wm.replay import Query, Replay, Windows, by_event


@dataclass(frozen=True)
class Request:
    """`count` windows that match `query`.

    event_fraction: share that contains an event, the types in turn.
    events, reach: instead, windows that end up to `reach` steps before one of these events.
    pool: label of the start states made of them (see `popgen.methods.xpm_wm.start_states`).
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
