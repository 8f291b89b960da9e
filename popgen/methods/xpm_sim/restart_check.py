"""What the exact dynamics say of a finished member: is self-play as good from cross-play states as from its own?"""

from __future__ import annotations

import numpy as np

from popgen.envs.reward import rewards_events
from popgen.methods.xpm_sim.agent import XpmSimLearner
from popgen.methods.xpm_wm.replay import Replay


def restart_check(learner: XpmSimLearner, pairs: int) -> tuple[dict[str, float], int]:
    """Self-play of the second half of an episode's length, from states of B_XP and from states of B_SP of equal time.

    A member that sabotages in cross-play, or that leaves its convention's states there, does worse from B_XP.

    Args:
        learner: of a member with real episodes in its buffers.
        pairs: of starts to compare.

    Returns:
        score_restart and score_sp (mean score over those steps; without cross-play only the latter), restart_ratio
        where scores count something, and the simulated steps that it took.
    """
    length = max(1, learner.env.spec.horizon // 2)
    own, cross = (_by_time(learner, replay, length) for replay in (learner.starts.sp, learner.starts.xp))
    times = sorted(own.keys() & cross.keys()) if cross else sorted(own)
    if not times:
        return {}, 0
    chosen = learner.rng.choice(times, pairs)
    figures, steps = {}, 0
    for name, rows, replay in (("score_sp", own, learner.starts.sp), ("score_restart", cross, learner.starts.xp)):
        if rows:
            states = replay.states[[learner.rng.choice(rows[time]) for time in chosen]]
            score = learner.simulator.score(states, length, learner.actor.net)
            figures[name], steps = float(score.mean()), steps + pairs * length
    if len(figures) == 2 and rewards_events(learner.env.spec) and figures["score_sp"] > 0:
        figures["restart_ratio"] = figures["score_restart"] / figures["score_sp"]
    return figures, steps


def _by_time(learner: XpmSimLearner, replay: Replay, latest: int) -> dict[int, np.ndarray]:
    """Rows of the buffer's recent episodes by time step, those up to `latest` and not terminal."""
    rows = learner.starts.recent(replay, None)
    times = learner.env.time(replay.states[rows]) if len(rows) else np.zeros(0, np.int64)
    order = np.argsort(times, kind="stable")
    values, first = np.unique(times[order], return_index=True)
    groups = np.split(rows[order], first[1:]) if len(rows) else []
    return {int(t): group for t, group in zip(values, groups, strict=True) if t <= latest}
