"""Three kinds of work side by side: sampling, world-model learning and agent learning.

`sync` starts one task of each, waits for all, and takes the results in a fixed order: whatever the timing, the next
round sees the same. `async` starts a task of a kind as soon as its last one is done, up to `AHEAD` rounds before the
slowest kind, so that a slow learner holds the others back instead of letting work pile up.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import ray

AHEAD = 1

Start = Callable[[], Any]
Finish = Callable[[Any], None]


def run_rounds(
    work: dict[str, tuple[Start, Finish]],
    *,
    stop: Callable[[], bool],
    after: Callable[[], None],
    schedule: str,
    due: Callable[[], bool] = lambda: False,
    save: Callable[[], None] = lambda: None,
) -> dict[str, int]:
    """Work until `stop()`; every task that was started is also finished.

    Args:
        work: kind -> (start, returning an object reference or several; finish, given the result).
        stop: asked before a round (sync) or a task (async) is started.
        after: called after each round, that is, whenever the slowest kind has advanced.
        schedule: "sync" or "async".
        due, save: whether to save, asked after each round, and how; nothing is at work when `save` is called, which
            in `async` means that all kinds come to a halt first.

    Returns:
        Finished tasks per kind.
    """
    done = dict.fromkeys(work, 0)
    if schedule == "sync":
        while not stop():
            pending = {name: start() for name, (start, _) in work.items()}
            # All first: a result taken in earlier, such as new rows in a replay, would reach the tasks still at work.
            results = {name: _get(reference) for name, reference in pending.items()}
            for name, (_, finish) in work.items():
                finish(results[name])
                done[name] += 1
            after()
            if due():
                save()
        return done
    return _overlapping(work, done, stop, after, due, save)


def _overlapping(
    work: dict[str, tuple[Start, Finish]],
    done: dict[str, int],
    stop: Callable[[], bool],
    after: Callable[[], None],
    due: Callable[[], bool],
    save: Callable[[], None],
) -> dict[str, int]:
    running: dict[str, Any] = {}
    saving = False
    while True:
        if saving and not running:
            save()
            saving = False
        if not saving and not stop():
            for name, (start, _) in work.items():
                if name not in running and done[name] <= min(done.values()) + AHEAD:
                    running[name] = start()
        if not running:
            return done
        ready, _ = ray.wait([_last(reference) for reference in running.values()], num_returns=1)
        rounds = min(done.values())
        for name in [name for name, reference in running.items() if _last(reference) in ready]:
            work[name][1](_get(running.pop(name)))
            done[name] += 1
        if min(done.values()) > rounds:
            after()
            saving = saving or due()


def _last(reference: Any) -> Any:
    return reference[-1] if isinstance(reference, (list, tuple)) else reference


def _get(reference: Any) -> Any:
    """Results of a task; of one with several results, all but the last stay in the object store."""
    if isinstance(reference, (list, tuple)):
        return (*reference[:-1], ray.get(reference[-1]))
    return ray.get(reference)
