"""`popgen study init`, `serve`, `verify` and `balance`; those with records and participants are in their own file."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from popgen.cli import study_check_command
from popgen.cli.arguments import Parser, add_command, at_least, label_and_path
from popgen.cli.printing import ERROR, OK, print_json
from popgen.cli.training import bound_threads
from popgen.errors import UserError


def add(commands: Any) -> None:
    """`study` and what can be done with one."""
    study = commands.add_parser("study", help="people play in the browser", description="A study with people.")
    kinds = study.add_subparsers(title="what to do", metavar="WHAT", required=True, parser_class=Parser)
    _add_init(kinds)
    _add_serve(kinds)
    _add_simulate(kinds)
    verify = add_command(
        kinds,
        "verify",
        verify_study,
        "play every recorded game again and compare",
        "The ego acts anew from its recorded seed; states, actions and scores must be the recorded ones. Ends with "
        "code 2 where a recording is not proven. Keys of --json: games, proven, steps, problems.",
    )
    verify.add_argument("study", metavar="STUDY")
    export = add_command(
        kinds,
        "export",
        export_records,
        "write records as tables",
        "steps (the 14 columns of the field's public data, then ours), games, participants, answers; completion codes "
        "apart. `popgen conventions --records OUT/steps.parquet` reads the steps. Keys of --json: files, games, steps.",
    )
    export.add_argument("study", metavar="STUDY")
    export.add_argument("--out", metavar="DIR", default=None, help="STUDY/export by default")
    export.add_argument("--format", choices=("parquet", "csv"), default="parquet", help="of the steps (%(default)s)")
    study_check_command.add(kinds)
    balance = add_command(
        kinds,
        "balance",
        show_balance,
        "random histories of participants, and how balanced the study stays",
        "Imbalance: the largest difference between the games of two cells (ego, seat, position in the pair) of one "
        "layout. Keys of --json: histories, participants, drop_outs, within, overall, final.",
    )
    balance.add_argument("study", metavar="STUDY")
    balance.add_argument("--histories", type=at_least(1), default=10_000, help="(%(default)s)")
    balance.add_argument("--participants", type=at_least(1), default=40, help="who finish (%(default)s)")
    balance.add_argument("--drop-outs", type=float, default=0.2, help="share of who begin (%(default)s)")
    balance.add_argument("--seed", type=at_least(0), default=0, help="of the histories (%(default)s)")


def _add_init(kinds: Any) -> None:
    init = add_command(
        kinds,
        "init",
        init_study,
        "make the folder of a study",
        "STUDY/study.json and STUDY/consent.md are to be edited before anybody takes part. An ego has one member in "
        "each layout: repeat --ego with the same name. Keys of --json: study, layouts, egos, games.",
    )
    init.add_argument("study", metavar="STUDY")
    init.add_argument("--ego", metavar="NAME=POPULATION[:MEMBER]", type=label_and_path, action="append", required=True)
    init.add_argument("--tutorial", metavar="POPULATION[:MEMBER]", required=True, help="partner of the tutorials")
    init.add_argument("--host", choices=("browser", "server"), default="browser", help="where games run (%(default)s)")
    init.add_argument("--tutorials", type=at_least(0), default=3, help="practice games (%(default)s)")
    init.add_argument("--pairs", type=at_least(1), default=2, help="of games in each layout (%(default)s)")
    init.add_argument("--steps", type=at_least(1), default=400, help="of a game (%(default)s)")


def _add_simulate(kinds: Any) -> None:
    simulate = add_command(
        kinds,
        "simulate",
        simulate_study,
        "let members take part, through the real requests and connections",
        "Their records lie in STUDY beside any others: use a study made for it. Without --agent keys are pressed at "
        "random. Keys of --json: seconds, statuses, games, steps, breaks, most_lost, kills, lateness (steps, median, "
        "p99, most in milliseconds, missed).",
    )
    simulate.add_argument("study", metavar="STUDY")
    simulate.add_argument("--agent", action="append", default=[], metavar="POPULATION", help="members take part")
    simulate.add_argument("--participants", type=at_least(1), default=20, help="in all (%(default)s)")
    simulate.add_argument("--together", type=at_least(1), default=20, help="at once (%(default)s)")
    simulate.add_argument("--games", type=at_least(1), default=None, help="of each (all)")
    simulate.add_argument(
        "--speed", type=at_least(0), default=0, help="times real time; 0: as fast as they answer (%(default)s)"
    )
    simulate.add_argument("--kills", type=at_least(0), default=0, help="of the server, by SIGKILL (%(default)s)")
    simulate.add_argument("--seed", type=at_least(0), default=0, help="of participants and kills (%(default)s)")


def _add_serve(kinds: Any) -> None:
    serve = add_command(
        kinds,
        "serve",
        serve_study_pages,
        "let people take part",
        "Serves one study until it is interrupted; see docs/study.md for a reverse proxy with TLS in front.",
    )
    serve.add_argument("study", metavar="STUDY")
    serve.add_argument("--host", default="127.0.0.1", help="address to listen at (%(default)s)")
    serve.add_argument("--port", type=at_least(0), default=8020, help="0 takes a free one (%(default)s)")
    serve.add_argument("--behind-tls", action="store_true", help="cookies go over TLS only")
    serve.add_argument(
        "--speed", type=at_least(0), default=1, help="times real time; 0: as fast as participants answer (%(default)s)"
    )


def init_study(args: argparse.Namespace) -> int:
    """Write the folder."""
    from popgen.study.study_folder import make_study

    egos = [_read_member(name, path) for name, path in args.ego]
    settings = {"host": args.host, "tutorials": args.tutorials, "pairs": args.pairs, "steps": args.steps}
    study = make_study(Path(args.study), egos, _read_member("tutorial", args.tutorial), settings)
    definition = study.definition
    games = definition.tutorials + 2 * definition.pairs * len(definition.layouts)
    if args.json:
        told = {"study": args.study, "layouts": definition.layouts, "egos": sorted(definition.egos), "games": games}
        print_json(told)
        return OK
    print(f"{args.study}: {len(definition.egos)} egos, {len(definition.layouts)} layouts, {games} games a participant")
    print(
        f"edit {study.folder / 'consent.md'} and {study.folder / 'study.json'}, then: popgen study serve {args.study}"
    )
    return OK


def _read_member(name: str, text: str) -> Any:
    from popgen.study.study_folder import NamedMember

    path, colon, member = text.rpartition(":")
    if colon and member.isdecimal():
        return NamedMember(name, path, int(member))
    return NamedMember(name, text)


def serve_study_pages(args: argparse.Namespace) -> int:
    """Serve until interrupted."""
    bound_threads(1)
    from filelock import FileLock, Timeout

    from popgen.pages.game_server import open_listening_socket
    from popgen.study.study_definition import read_study
    from popgen.study.study_server import StudyServer, open_service, serve_study

    study = read_study(args.study)
    lock = FileLock(study.folder / "serving.lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise UserError(args.study, "is being served already", "end the other server") from None
    try:
        listening = open_listening_socket(args.host, args.port)
        service = open_service(study, speed=args.speed)
        host = f"[{args.host}]" if ":" in args.host else args.host
        print(f"study at http://{host}:{listening.getsockname()[1]} (end with Ctrl-C)", flush=True)
        try:
            serve_study(StudyServer(service, secure=args.behind_tls), listening)
        finally:
            service.close()
    except KeyboardInterrupt:
        print("popgen: the server has ended", file=sys.stderr)
    finally:
        lock.release()
    return OK


def simulate_study(args: argparse.Namespace) -> int:
    """Serve in a process and take part."""
    bound_threads(1)
    from dataclasses import asdict

    from popgen.population import load_population
    from popgen.study.simulated_participants import Casting
    from popgen.study.study_definition import read_study
    from popgen.study.study_dry_run import DryRunPlan, run_dry, summarize_visits

    study = read_study(args.study)
    casting = Casting(study, [load_population(path) for path in args.agent])
    plan = DryRunPlan(
        participants=args.participants,
        together=args.together,
        speed=args.speed,
        games=args.games,
        kills=args.kills,
        seed=args.seed,
    )

    def tell(done: int) -> None:
        if not args.quiet:
            print(f"{done} of {args.participants} participants are through", file=sys.stderr, flush=True)

    found = run_dry(study, casting, plan, tell)
    told = summarize_visits(found.visits)
    if args.json:
        print_json({"seconds": found.seconds, **told, "kills": found.kills, "lateness": asdict(found.lateness)})
        return OK
    statuses = ", ".join(f"{count} {status}" for status, count in told["statuses"].items())
    print(f"{statuses}; {told['games']} games, {told['steps']:,} steps in {found.seconds:.0f} s")
    late = found.lateness
    if args.speed:
        print(
            f"late by {late.median:.2f} ms (median), {late.p99:.2f} (p99), {late.most:.2f} (most); {late.missed} missed"
        )
    if found.kills:
        print(
            f"{found.kills} kills, {told['breaks']} connections broke, {told['most_lost']} steps lost at most at once"
        )
    return OK


def verify_study(args: argparse.Namespace) -> int:
    """Prove all recordings."""
    bound_threads(1)
    from popgen.study.recording_check import check_recordings
    from popgen.study.study_definition import read_study
    from popgen.study.study_tables import Database

    study = read_study(args.study)
    checked = check_recordings(study, Database(study.database))
    wrong = [one for one in checked if one.problem]
    steps = sum(one.steps for one in checked)
    if args.json:
        problems = [{"game": one.game, "problem": one.problem} for one in wrong]
        print_json({"games": len(checked), "proven": len(checked) - len(wrong), "steps": steps, "problems": problems})
    else:
        print(f"{len(checked) - len(wrong)} of {len(checked)} recorded games are proven, {steps:,} steps")
        for one in wrong:
            print(f"game {one.game}: {one.problem}")
    return ERROR if wrong else OK


def export_records(args: argparse.Namespace) -> int:
    """Write the tables."""
    from popgen.study.study_definition import read_study
    from popgen.study.study_export import export_study
    from popgen.study.study_tables import Database

    study = read_study(args.study)
    out = Path(args.out) if args.out else study.folder / "export"
    written = export_study(study, Database(study.database), out, args.format)
    if args.json:
        files = [str(file) for file in written.files]
        print_json({"files": files, "games": written.games, "steps": written.steps})
        return OK
    print(f"{written.games} games, {written.steps:,} steps: {out} ({', '.join(file.name for file in written.files)})")
    return OK


def show_balance(args: argparse.Namespace) -> int:
    """Simulate histories and print the imbalances."""
    import numpy as np

    from popgen.study.counterbalance import simulate_history
    from popgen.study.study_definition import read_study

    if not 0 <= args.drop_outs < 1:
        raise UserError("--drop-outs", f"must be from 0 to below 1, got {args.drop_outs}")
    design = read_study(args.study).definition.design
    seeds = np.random.SeedSequence(args.seed).spawn(args.histories)
    found = [simulate_history(design, args.participants, np.random.default_rng(s), args.drop_outs) for s in seeds]
    figures = {name: [getattr(one, name) for one in found] for name in ("within", "overall", "final")}
    counted = {name: {str(n): values.count(n) for n in sorted(set(values))} for name, values in figures.items()}
    if args.json:
        shared = {"histories": args.histories, "participants": args.participants, "drop_outs": args.drop_outs}
        print_json({**shared, **counted})
        return OK
    texts = {
        "within": "over complete rows, at any time",
        "overall": "over all who finished or play, at any time",
        "final": "over all who finished, at the end",
    }
    print(f"{args.histories:,} histories, {args.participants} finish, {args.drop_outs:.0%} drop out")
    for name, counts in counted.items():
        told = ", ".join(f"{number} in {count / args.histories:.2%}" for number, count in counts.items())
        print(f"imbalance {texts[name]}: {told}")
    return OK
