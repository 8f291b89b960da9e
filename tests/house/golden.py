"""Golden figures of a checkout: what short runs learn, count and score, as digests in a JSON file.

    python tests/house/golden.py record before.json --checkout ../older
    python tests/house/golden.py record after.json
    python tests/house/golden.py compare before.json after.json

Each of METHODS trains three members at scale=smoke with run.schedule=sync; the first one also in a run that is killed
with SIGKILL halfway and resumed. Equal figures mean that two versions of the code learn the same numbers. The digests
are those of one kind of processor and one torch: record both files on the same machine.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
METHODS = ("xpm_wm", "xpm_sim", "mappo", "lipo", "comedi")
RESUMED = "xpm_wm, killed and resumed"
CASES = (*METHODS, RESUMED)
Figures = dict[str, Any]


def run_command(method: str, root: Path) -> list[str]:
    """The run of a method, under one name whoever runs it: names of samplers hold it."""
    settings = ["scale=smoke", "population.size=3", "run.schedule=sync", "run.seed=1", "tracking=off"]
    place = [f"run.root={root}", f"run.id=golden-{method}", "--json", "--quiet"]
    return [sys.executable, "-m", "popgen", "run", f"method={method}", *settings, *place]


def start_run(checkout: Path, command: list[str], out: Path) -> subprocess.Popen[bytes]:
    """A process of the checkout's code; its report goes to `out`, its complaints to a file beside it."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    with out.open("wb") as stdout, out.with_suffix(".err").open("wb") as stderr:
        return subprocess.Popen(command, cwd=checkout, env=environment, stdout=stdout, stderr=stderr)


def finish_run(checkout: Path, command: list[str], out: Path) -> Figures:
    """Run to the end; what it printed.

    Raises:
        SystemExit: it failed.
    """
    if (code := start_run(checkout, command, out).wait()) not in (0, 3):  # 3: it names a weak member
        raise SystemExit(f"{' '.join(command)}\nended with {code}: {out.with_suffix('.err').read_text()[-2000:]}")
    return json.loads(out.read_text())


def kill_halfway(checkout: Path, command: list[str], out: Path, ledger: Path, rows: int) -> None:
    """Kill the run once its ledger has so many rows.

    Raises:
        SystemExit: it ended before.
    """
    process = start_run(checkout, command, out)
    while process.poll() is None:
        if ledger.exists() and ledger.read_bytes().count(b"\n") >= rows:
            process.send_signal(signal.SIGKILL)
            process.wait()
            return
        time.sleep(0.02)
    raise SystemExit(f"the run ended with {process.returncode} before it could be killed")


def read_figures(folder: Path, report: Figures) -> Figures:
    """Digests of weights, ledger and matrix of a finished run.

    The ledger counts without the samplers' names and running numbers, which tell the attempts of a run apart, and
    without evaluations, whose steps are told beside those of training.
    """
    rows = [json.loads(line) for line in (folder / "ledger.jsonl").read_text().splitlines()]
    names = ("member", "kind", "steps", "episodes", "score")
    kept = sorted(json.dumps([row[name] for name in names]) for row in rows if row["kind"] != "evaluation")
    steps: Counter[str] = Counter()
    for row in rows:
        steps[f"member {row['member']} {row['kind']}"] += row["steps"]
    weights = sorted((folder / "population").rglob("*.safetensors"))
    return {
        "weights": {str(path.relative_to(folder)): digest_of(path.read_bytes()) for path in weights},
        "ledger": digest_of("\n".join(kept).encode()),
        "steps": dict(sorted(steps.items())),
        "matrix": digest_of(json.dumps(report["matrix"], sort_keys=True).encode()),
    }


def digest_of(data: bytes) -> str:
    """sha256."""
    return hashlib.sha256(data).hexdigest()


def record_case(case: str, checkout: Path, folder: Path) -> Figures:
    """Run a case in an empty folder."""
    method = case.partition(",")[0]
    command, run, out = run_command(method, folder), folder / f"golden-{method}", folder / "out.json"
    if case == RESUMED:
        whole = folder / "whole"
        whole.mkdir()
        finish_run(checkout, run_command(method, whole), out)
        rows = (whole / run.name / "ledger.jsonl").read_bytes().count(b"\n")
        kill_halfway(checkout, command, out, run / "ledger.jsonl", rows // 2)
    return read_figures(run, finish_run(checkout, command, out))


def record_cases(file: Path, checkout: Path, cases: list[str]) -> None:
    """Record the cases that the file does not hold yet."""
    recorded: dict[str, Figures] = json.loads(file.read_text()) if file.exists() else {}
    for case in cases:
        if case in recorded:
            continue
        began = time.time()
        with tempfile.TemporaryDirectory(prefix="pg-", dir="/tmp") as folder:
            recorded[case] = record_case(case, checkout, Path(folder))
        file.write_text(json.dumps(recorded, indent=1) + "\n")
        print(f"{case}: {len(recorded[case]['weights'])} weight files, {time.time() - began:.0f} s", flush=True)


def list_differences(before: dict[str, Figures], after: dict[str, Figures]) -> list[str]:
    """Where two recordings differ, a line each."""
    lines = [f"{case}: recorded in one file only" for case in sorted(before.keys() ^ after.keys())]
    for case in sorted(before.keys() & after.keys()):
        for kind in ("weights", "ledger", "steps", "matrix"):
            old, new = before[case][kind], after[case][kind]
            if isinstance(old, dict):
                names = sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))
                lines += [f"{case}: {kind}: {name}" for name in names]
            elif old != new:
                lines.append(f"{case}: {kind}")
    return lines


def compare_files(before: Path, after: Path) -> int:
    """Print the differences of two recordings; 1 if there are any."""
    old, new = (json.loads(path.read_text()) for path in (before, after))
    differences = list_differences(old, new)
    whole, resumed = new.get(RESUMED.partition(",")[0]), new.get(RESUMED)
    if whole and resumed and whole != resumed:
        differences.append(f"{after}: the resumed run differs from the undisturbed one")
    files = sum(len(figures["weights"]) for figures in new.values())
    print("\n".join(differences) or f"equal: {len(new)} cases, {files} weight files, ledgers and matrices")
    return int(bool(differences))


def main() -> int:
    """Record or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    record = commands.add_parser("record", help="run the cases that a file does not hold yet")
    record.add_argument("file", type=Path)
    record.add_argument("--checkout", type=Path, default=ROOT, help="whose code runs (this one)")
    record.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), metavar="CASE", help="all by default")
    compare = commands.add_parser("compare", help="tell where two files differ")
    compare.add_argument("files", type=Path, nargs=2)
    arguments = parser.parse_args()
    if arguments.command == "compare":
        return compare_files(*arguments.files)
    record_cases(arguments.file.resolve(), arguments.checkout.resolve(), arguments.cases)
    return 0


if __name__ == "__main__":
    sys.exit(main())
