"""What is drawn from B_SP and B_XP for the model's updates and for the states that imagination starts from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from popgen.envs.contract import EnvSpec
from popgen.methods.xpm_wm.config import XpmWmRun
from popgen.methods.xpm_wm.replay import Query
from popgen.methods.xpm_wm.start_states import NEW_SP, NEW_XP, OLD
from popgen.methods.xpm_wm.window_requests import Request
from popgen.types import Kind

LATE = 0.3
"""Share of a buffer's rows that counts as late data."""


@dataclass(frozen=True)
class Draws:
    """Requests to the two replays."""

    sp: tuple[Request, ...]
    xp: tuple[Request, ...] = ()


def model_batch(config: XpmWmRun, member: int) -> Draws:
    """Windows of one world-model update.

    Member 1 learns from everything it has, a share of it from the last rows: a policy finds the rewards that the
    model only imagines, and what it then does in reality must be seen often to be unlearned. Later members mix the
    kept buffers with their own new data, the latter half self-play and half cross-play.
    """
    batch, events = config.world_model.batch, config.replay.event_fraction
    if member == 1:
        recent = int(round(batch * config.phase1.recent_fraction))
        late = (Request(Query(last=config.phase1.recent_rows), recent, events),) if recent else ()
        return Draws(sp=(Request(Query(), batch - recent, events), *late))
    new = int(round(batch * config.phase2.new_fraction))
    old, old_xp = batch - new, (batch - new) // 4 if member > 2 else 0
    kept, own = Query(owner=member, owner_is="below"), Query(owner=member)
    return Draws(
        sp=(Request(kept, old - old_xp, events), Request(own, new - new // 2, events)),
        xp=(Request(kept, old_xp, events), Request(own, new // 2, events)),
    )


def major_events(spec: EnvSpec) -> tuple[int, ...]:
    """Events worth more than the median event: in Overcooked, taking and delivering a soup."""
    median = float(np.median(spec.event_weights))
    return tuple(i for i, weight in enumerate(spec.event_weights) if weight > median)


def start_batch(config: XpmWmRun, spec: EnvSpec, member: int, windows: int) -> Draws:
    """Windows whose last states become starts of imagination for a later member.

    Old states: random play, the moments before a soup is taken or delivered, and late data. New states: this
    member's own self-play and cross-play.
    """
    phase = config.phase2
    kept = {"owner": member, "owner_is": "below"}
    shares = {"random": phase.starts_random, "event": phase.starts_event}
    random, event = (int(round(windows * shares[name])) for name in ("random", "event"))
    late = windows - random - event
    late_xp = late // 2 if member > 2 else 0
    return Draws(
        sp=(
            Request(Query(**kept, kind=Kind.RANDOM), random, pool=OLD),
            Request(Query(**kept), event, events=major_events(spec), reach=phase.event_reach, pool=OLD),
            Request(Query(**kept, kind=Kind.SP, recent=LATE), late - late_xp, pool=OLD),
            Request(Query(owner=member), windows // 2, pool=NEW_SP),
        ),
        xp=(
            Request(Query(**kept, kind=Kind.XP, recent=LATE), late_xp, pool=OLD),
            Request(Query(owner=member, kind=Kind.XP), windows // 2, pool=NEW_XP),
        ),
    )
