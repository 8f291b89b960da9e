"""A campaign of random faults: `make chaos`, or `python tests/chaos/campaign.py --faults 36 --seed 1`.

Small runs with schedule=sync, each with one fault at a random moment. Each must end complete, by itself or when it is
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

from chaos_testbed import RunFigures, Testbed, count_events, count_repeated_steps
from faults import FAULTS, Fault, Trial

TRIES = 5
"""Of a fault whose run ended before its moment came."""


def main() -> int:
    """Run the campaign; 0 if all faults were survived."""
    args = read_arguments()
    testbed = Testbed.open()
    began, rows = time.time(), []
    try:
        references = {method: run_undisturbed(testbed, method) for method in args.methods}
        plan = plan_faults(args, random.Random(args.seed))
        for number, (method, fault) in enumerate(plan, start=1):
            rows.append(
                run_trial(testbed, number, method, fault, references[method], random.Random(args.seed * 1000 + number))
            )
            print(format_row(rows[-1]), flush=True)
    finally:
        testbed.close(keep=not all(row["survived"] for row in rows))
    return print_summary(rows, time.time() - began, args.json)


def read_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=36, help="how many (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of kinds, moments and victims (%(default)s)")
    parser.add_argument("--methods", nargs="+", default=["xpm_wm"], help="taken in turn (%(default)s)")
    parser.add_argument("--kinds", nargs="+", choices=sorted(FAULTS), default=sorted(FAULTS), help="all by default")
    parser.add_argument("--json", type=Path, help="file for the rows")
    return parser.parse_args()


def plan_faults(args: argparse.Namespace, rng: random.Random) -> list[tuple[str, Fault]]:
    """As many faults of each kind, in random order, each on the next method that it applies to."""
    kinds = [args.kinds[number % len(args.kinds)] for number in range(args.faults)]
    rng.shuffle(kinds)
    plan, turn = [], Counter()
    for kind in kinds:
        able = [method for method in args.methods if FAULTS[kind].applies(method)]
        if able:
            plan.append((able[turn[kind] % len(able)], FAULTS[kind]))
            turn[kind] += 1
    return plan


def run_undisturbed(testbed: Testbed, method: str) -> dict[str, Any]:
    """The run that nothing happens to."""
    began, name = time.time(), f"{method}-undisturbed"
    run, log = testbed.folder / "runs" / name, testbed.folder / f"{name}.out"
    outcome = testbed.finish(testbed.start(testbed.list_settings(name, f"method={method}", "tracking=off"), log), log)
    if outcome.code:
        raise SystemExit(f"the undisturbed run of {method} ended with {outcome.code}: {outcome.error}")
    print(
        f"{name}: {time.time() - began:.0f} s, {count_events(run)} events, {RunFigures.read(run).totals['total']}",
        flush=True,
    )
    # A machine that is short of memory disturbs even this run; what it did again is no moment of its own.
    rows = [json.loads(text) for text in (run / "run.log").read_text().splitlines()]
    moments = {(row["event"], row.get("member"), row.get("iteration"), row.get("text")) for row in rows}
    return {"figures": RunFigures.read(run), "events": len(moments)}


def run_trial(
    testbed: Testbed, number: int, method: str, fault: Fault, known: dict[str, Any], rng: random.Random
) -> dict[str, Any]:
    """One fault on one run: where and when it was injected, and what came of it."""
    for attempt in range(TRIES):
        name = f"{number:03d}-{fault.name.replace(chr(32), chr(45))}-{attempt}"
        moment = rng.randrange(2, known["events"])
        trial = Trial(testbed, name, method, moment, rng.random() * fault.delay, rng)
        began = time.time()
        fault.act(trial)
        if trial.injected:
            break
    row = {"number": number, "method": method, "fault": fault.name, "event": moment, "victim": trial.victim}
    row |= {
        "submissions": trial.submissions,
        "error_lines": trial.error_lines,
        "seconds": round(time.time() - began, 1),
    }
    run = trial.run
    row |= {"injected": trial.injected, "attempts": 0, "repeated": 0}
    if not trial.injected or trial.code:
        problem = f"exit {trial.code}: {trial.error_lines}" if trial.code else f"the run ended before it, {TRIES} times"
        return row | {"survived": False, "problem": problem}
    figures, wanted = RunFigures.read(run), known["figures"]
    problems = [what for what in ("weights", "entries", "totals") if getattr(figures, what) != getattr(wanted, what)]
    problems += ["error text"] * (fault.one_line and not one_line(trial.error_lines))
    attempts = len((run / "attempts.txt").read_text().splitlines())
    row |= {"attempts": attempts, "repeated": count_repeated_steps(run), "weights": figures.weights[-1][:12]}
    return row | {"survived": not problems, "problem": ", ".join(problems)}


def one_line(error_lines: list[str]) -> bool:
    """The interrupted call ended with one line, and no traceback."""
    return bool(error_lines) and all(text.startswith("popgen: error: ") and " / " not in text for text in error_lines)


def format_row(row: dict[str, Any]) -> str:
    """Of the table."""
    failed = f"{'FAILED' if row['injected'] else 'missed'} ({row['problem']})"
    verdict = "survived" if row["survived"] else failed
    parts = (f"{row['number']:3d}", f"{row['method']:8s}", f"{row['fault']:22s}", f"after event {row['event']:3d}")
    more = (f"{row['attempts']} attempts", f"{row['submissions']} calls", f"{row['repeated']:5d} steps again")
    return "  ".join([*parts, *more, f"{row['seconds']:5.0f} s", verdict, str(row["victim"])])


def print_summary(rows: list[dict[str, Any]], seconds: float, path: Path | None) -> int:
    """What the campaign found; the exit code. A fault that missed its run says nothing, and is counted apart."""
    injected = [row for row in rows if row["injected"]]
    survived, kinds = sum(row["survived"] for row in injected), Counter(row["fault"] for row in injected)
    missed = f", {len(rows) - len(injected)} more missed their runs" if len(injected) < len(rows) else ""
    took = f"in {seconds / 60:.1f} minutes"
    print(f"{survived} of {len(injected)} faults of {len(kinds)} kinds survived {took}{missed}", flush=True)
    if path is not None:
        path.write_text(json.dumps(rows, indent=1))
    whole = all(row["survived"] or not (row["injected"] or row["error_lines"]) for row in rows)
    return 0 if injected and whole else 1


if __name__ == "__main__":
    raise SystemExit(main())
