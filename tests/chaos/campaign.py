"""A campaign of random faults: `make chaos`, or `python tests/chaos/campaign.py --faults 36 --seed 1`.

Small runs with schedule=sync, each hit by one fault at a random moment. Each must end complete, by itself or when it is
submitted again, with the ledger and the weights of the run that nothing happened to. Prints one line for each fault
and ends with exit code 1 if one of them was not survived.
"""

from __future__ import annotations

import argparse
import json
import random
import time
from collections import Counter
from pathlib import Path
from typing import Any

from faults import FAULTS, Fault, Hit
from site_of_chaos import RunRecorder, Site, events, repeated

TRIES = 5
"""Of a fault whose run ended before its moment came."""


def main() -> int:
    """Run the campaign; 0 if all faults were survived."""
    args = arguments()
    site = Site.open()
    began, rows = time.time(), []
    try:
        references = {method: reference(site, method) for method in args.methods}
        plan = schedule(args, random.Random(args.seed))
        for number, (method, fault) in enumerate(plan, start=1):
            rows.append(
                strike(site, number, method, fault, references[method], random.Random(args.seed * 1000 + number))
            )
            print(line(rows[-1]), flush=True)
    finally:
        site.close(keep=not all(row["survived"] for row in rows))
    return summary(rows, time.time() - began, args.json)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=36, help="how many (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of kinds, moments and victims (%(default)s)")
    parser.add_argument("--methods", nargs="+", default=["xpm_wm"], help="taken in turn (%(default)s)")
    parser.add_argument("--kinds", nargs="+", choices=sorted(FAULTS), default=sorted(FAULTS), help="all by default")
    parser.add_argument("--json", type=Path, help="file for the rows")
    return parser.parse_args()


def schedule(args: argparse.Namespace, rng: random.Random) -> list[tuple[str, Fault]]:
    """As many faults of each kind, in random order, each on the next method that has what it hits."""
    kinds = [args.kinds[number % len(args.kinds)] for number in range(args.faults)]
    rng.shuffle(kinds)
    plan, turn = [], Counter()
    for kind in kinds:
        able = [method for method in args.methods if FAULTS[kind].hits(method)]
        if able:
            plan.append((able[turn[kind] % len(able)], FAULTS[kind]))
            turn[kind] += 1
    return plan


def reference(site: Site, method: str) -> dict[str, Any]:
    """The run that nothing happens to."""
    began, name = time.time(), f"{method}-undisturbed"
    run, log = site.folder / "runs" / name, site.folder / f"{name}.out"
    outcome = site.finish(site.start(site.overrides(name, f"method={method}", "tracking=off"), log), log)
    if outcome.code:
        raise SystemExit(f"the undisturbed run of {method} ended with {outcome.code}: {outcome.error}")
    print(
        f"{name}: {time.time() - began:.0f} s, {events(run)} events, {RunRecorder.of(run).totals['total']}", flush=True
    )
    # A machine that is short of memory hits even this run; what it did again is no moment of its own.
    rows = [json.loads(text) for text in (run / "run.log").read_text().splitlines()]
    moments = {(row["event"], row.get("member"), row.get("iteration"), row.get("text")) for row in rows}
    return {"recorder": RunRecorder.of(run), "events": len(moments)}


def strike(
    site: Site, number: int, method: str, fault: Fault, known: dict[str, Any], rng: random.Random
) -> dict[str, Any]:
    """One fault: the run, what hit it and when, and what came of it."""
    for attempt in range(TRIES):
        name = f"{number:03d}-{fault.name.replace(chr(32), chr(45))}-{attempt}"
        moment = rng.randrange(2, known["events"])
        hit = Hit(site, name, method, moment, rng.random() * fault.delay, rng)
        began = time.time()
        fault.act(hit)
        if hit.struck:
            break
    row = {"number": number, "method": method, "fault": fault.name, "event": moment, "victim": hit.victim}
    row |= {"submissions": hit.submissions, "told": hit.told, "seconds": round(time.time() - began, 1)}
    run = hit.run
    row |= {"struck": hit.struck, "attempts": 0, "repeated": 0}
    if not hit.struck or hit.code:
        problem = f"exit {hit.code}: {hit.told}" if hit.code else f"the run ended before it, {TRIES} times"
        return row | {"survived": False, "problem": problem}
    recorder, wanted = RunRecorder.of(run), known["recorder"]
    problems = [what for what in ("weights", "entries", "totals") if getattr(recorder, what) != getattr(wanted, what)]
    problems += ["error text"] * (fault.one_line and not one_line(hit.told))
    attempts = len((run / "attempts.txt").read_text().splitlines())
    row |= {"attempts": attempts, "repeated": repeated(run), "weights": recorder.weights[-1][:12]}
    return row | {"survived": not problems, "problem": ", ".join(problems)}


def one_line(told: list[str]) -> bool:
    """The interrupted call ended with one line, and no traceback."""
    return bool(told) and all(text.startswith("popgen: error: ") and " / " not in text for text in told)


def line(row: dict[str, Any]) -> str:
    """Of the table."""
    failed = f"{'FAILED' if row['struck'] else 'missed'} ({row['problem']})"
    verdict = "survived" if row["survived"] else failed
    parts = (f"{row['number']:3d}", f"{row['method']:8s}", f"{row['fault']:22s}", f"after event {row['event']:3d}")
    more = (f"{row['attempts']} attempts", f"{row['submissions']} calls", f"{row['repeated']:5d} steps again")
    return "  ".join([*parts, *more, f"{row['seconds']:5.0f} s", verdict, str(row["victim"])])


def summary(rows: list[dict[str, Any]], seconds: float, path: Path | None) -> int:
    """What the campaign found; the exit code. A fault that missed its run says nothing, and is told apart."""
    struck = [row for row in rows if row["struck"]]
    survived, kinds = sum(row["survived"] for row in struck), Counter(row["fault"] for row in struck)
    missed = f", {len(rows) - len(struck)} more missed their runs" if len(struck) < len(rows) else ""
    took = f"in {seconds / 60:.1f} minutes"
    print(f"{survived} of {len(struck)} faults of {len(kinds)} kinds survived {took}{missed}", flush=True)
    if path is not None:
        path.write_text(json.dumps(rows, indent=1))
    whole = all(row["survived"] or not (row["struck"] or row["told"]) for row in rows)
    return 0 if struck and whole else 1


if __name__ == "__main__":
    raise SystemExit(main())
