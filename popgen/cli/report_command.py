"""`popgen report`: a run or a population as one page."""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path
from typing import Any

from popgen.cli.arguments import add_command, at_least
from popgen.cli.output_places import check_written_file
from popgen.cli.printing import OK, print_json, tell_unfinished
from popgen.cli.training import bound_threads


def add(commands: Any) -> None:
    """`report`."""
    parser = add_command(
        commands,
        "report",
        report,
        "one page of a run or a population, which needs no other file: matrix, curves, steps, replays, provenance",
        "The page is the population's card too (card.html in its folder), and travels with it. Keys of --json: files "
        "(report, card), bytes, findings (text, good).",
    )
    parser.add_argument("path", metavar="RUN|POPULATION", help="folder of a run, or of a population")
    parser.add_argument("--out", metavar="FILE", help="the page (RUN/report/report.html)")
    parser.add_argument(
        "--episodes", type=at_least(1), default=20, help="per pair, where there is no evaluation yet (%(default)s)"
    )
    parser.add_argument("--seed", type=at_least(0), default=0, help="of the replays (%(default)s)")


def report(args: argparse.Namespace) -> int:
    """Write the page."""
    check_written_file(args.out, "--out", ".html")
    bound_threads(1)
    tell_unfinished([args.path])
    from popgen.pages.report_source import read_source
    from popgen.pages.run_report import list_findings, write_run_report
    from popgen.progress import make_reporter

    with closing(make_reporter(quiet=args.quiet)) as reporter:
        reporter.phase("evaluation", 1)
        source = read_source(
            args.path,
            episodes=args.episodes,
            progress=lambda done, total: reporter.update(done / total, episodes=done),
        )
        files = write_run_report(source, Path(args.out) if args.out else None, seed=args.seed)
    findings, size = list_findings(source), files["report"].stat().st_size
    if args.json:
        told = [finding.as_dict() for finding in findings]
        print_json({"files": {name: str(file) for name, file in files.items()}, "bytes": size, "findings": told})
        return OK
    print("\n".join(f"- {finding.text}" for finding in findings))
    print("\n".join(f"{name}: {file}" for name, file in files.items()))
    return OK
