"""`popgen COMMAND ...`: the only file that knows Hydra.

Whatever a user can get wrong becomes one line on stderr and exit code 2, before Ray starts; torch, Ray and MLflow are
imported only by the commands that need them. Results go to stdout, progress to stderr.
"""

from __future__ import annotations

import argparse
import difflib
import errno
import json
import math
import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import popgen
from popgen.errors import UserError
from popgen.jsonable import jsonable

if TYPE_CHECKING:
    from popgen.config import RunConfig

OK, ERROR, INTERRUPTED = 0, 2, 130
ALIASES = {"seed": "run.seed"}
OPEN_SECTIONS = ("env.params", "cluster.resources")  # dictionaries that take any key
_ROOM = "make room or choose another folder; finished parts are kept"
_DISK = {
    errno.ENOSPC: ("the disk is full", _ROOM),
    errno.EDQUOT: ("the disk quota is used up", _ROOM),
    errno.EROFS: ("the file system is read-only", "choose another folder"),
    errno.EACCES: ("permission denied", "choose a folder you can read and write"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0, 2 for an error told in one line, 130 when interrupted."""
    try:
        args = _parse(sys.argv[1:] if argv is None else list(argv))
        return args.command(args)
    except SystemExit as stop:  # --help and --version
        return int(stop.code or 0)
    except UserError as error:
        return _fail(str(error))
    except KeyboardInterrupt:
        print("popgen: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output went away
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except RecursionError:
        return _fail(str(UserError("input", "is nested too deeply", "give plain values")))
    except MemoryError as error:
        return _fail(str(UserError("memory", f"is not enough ({error})", "ask for less at a time")))
    except OSError as error:
        if error.errno not in _DISK and error.filename is None:
            raise
        where = _short(str(error.filename or "disk"))
        problem, fix = _DISK.get(error.errno or 0, (error.strerror or str(error), "check the path"))
        return _fail(str(UserError(where, problem, fix)))


def _fail(message: str) -> int:
    print(f"popgen: error: {_short(' '.join(message.split()), 2000)}", file=sys.stderr)
    return ERROR


def _short(text: str, length: int = 100) -> str:
    return text if len(text) <= length else f"{text[: length - 3]}..."


# --- commands


def _run(args: argparse.Namespace) -> int:
    from popgen.config import RunConfig
    from popgen.preflight import preflight
    from popgen.progress import make_reporter

    config = RunConfig.parse(compose(args.overrides))
    preflight(config)
    if args.dry_run:
        return _print_config(config.relevant(), args.json)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    _bound_threads(config.cluster.threads)
    from pipelines.population import run_population

    reporter = make_reporter(quiet=args.quiet)
    try:
        result = run_population(config, reporter=reporter)
    finally:
        reporter.close()
    if args.json:
        _print_json(result)
    else:
        _print_run(result)
    return OK


def _bound_threads(count: int) -> None:
    """Before torch is imported: its threads wait for each other actively, which on busy cores costs many times more
    than one thread alone takes for the small networks of an acting policy."""
    os.environ.setdefault("OMP_NUM_THREADS", str(count))


def _print_config(values: dict[str, Any], as_json: bool) -> int:
    if as_json:
        _print_json(values)
    else:
        from omegaconf import OmegaConf

        print(OmegaConf.to_yaml(OmegaConf.create(values)), end="")
    return OK


def _print_json(value: Mapping[str, Any]) -> None:
    """Exactly one JSON object; numbers that are not finite become null."""
    print(json.dumps(jsonable(value), allow_nan=False))


def _print_run(result: Mapping[str, Any]) -> None:
    from rich.table import Table

    evaluation = result["evaluation"]
    members, matrix = evaluation["members"], evaluation["matrix"]
    title = f"{evaluation['environment']['name']}: {evaluation['unit']} per episode (± standard error)"
    table = Table("seat 0 \\ seat 1", *map(str, members), title=title)
    for member, means, errors in zip(members, matrix["mean"], matrix["standard_error"], strict=True):
        cells = ({"mean": mean, "standard_error": error} for mean, error in zip(means, errors, strict=True))
        table.add_row(str(member), *map(_figure_text, cells))
    _print_table(table)
    beside = "".join(f"   beside {who} {_figure_text(row['both'])}" for who, row in evaluation["beside"].items())
    print(f"SP mean {_figure_text(evaluation['sp'])}   XP mean {_figure_text(evaluation['xp'])}{beside}")
    for who, row in result["ledger"].items():
        kinds = ", ".join(f"{kind} {steps:,}" for kind, steps in row.items() if steps and kind != "total")
        print(f"environment steps, {'all' if who == 'total' else f'member {who}'}: {kinds}")
    print(f"time: {result['seconds'] / 60:.1f} minutes")
    print(f"population: {result['population']}   ledger, checkpoints and reports: {result['run_dir']}")


def _figure_text(figure: Mapping[str, float | None]) -> str:
    mean, error = figure["mean"], figure["standard_error"]
    if mean is None:
        return "-"
    return f"{mean:.2f}" if error is None else f"{mean:.2f} ± {error:.2f}"


def _evaluate(args: argparse.Namespace) -> int:
    _bound_threads(1)
    from popgen.population import check_compatible, load_population
    from popgen.preflight import check_root
    from popgen.progress import make_reporter

    population = load_population(args.population)
    if args.env or args.param:
        from popgen.envs import make_env

        info = population.env_info
        name = args.env or info.name
        params = {**(info.params if name == info.name else {}), **dict(args.param)}
        check_compatible(population, make_env(name, 1, **params).spec)
    out = Path(args.out) if args.out else Path(args.population) / "evaluation"
    check_root(out, 16 * 2**20, "--out")
    from popgen.evaluation.crossplay import evaluate_population
    from popgen.evaluation.report import summary, to_dict, to_rich, write_report

    reporter = make_reporter(quiet=args.quiet)
    try:
        reporter.phase("evaluation", 1)
        result = evaluate_population(
            population,
            args.episodes,
            args.seed,
            args.members,
            progress=lambda done, total: reporter.update(done / total, episodes=done),
        )
    finally:
        reporter.close()
    files = write_report(result, out)
    if args.json:
        _print_json({**to_dict(result), "files": {suffix: str(path) for suffix, path in files.items()}})
        return OK
    _print_table(to_rich(result))
    print("\n".join([*summary(result), f"report: {out} ({', '.join(path.name for path in files.values())})"]))
    return OK


def _show(args: argparse.Namespace) -> int:
    from popgen.population import load_population
    from popgen.population.show import describe, render

    population = load_population(args.population)
    if args.json:
        _print_json(describe(population))
        return OK
    _print_table(render(population))
    print(f"population: {population.path}")
    return OK


def _runs(args: argparse.Namespace) -> int:
    from pipelines.runs import list_runs

    runs = list_runs(Path(args.root))
    if args.json:
        _print_json({"root": args.root, "runs": runs})
        return OK
    from rich.markup import escape
    from rich.table import Table

    names = ("run", "state", "method", "environment", "member", "environment steps", "minutes", "last error")
    table = Table(*names, title=f"runs in {args.root}", title_justify="left")
    for run in runs:
        member = "-" if run["size"] is None else f"{run['member']} of {run['size']}"
        steps = ", ".join(f"{kind} {count:,}" for kind, count in run["steps"].items())
        cells = (run["id"], run["state"], run["method"], run["environment"], member, steps)
        error = _short(" ".join((run["error"] or "").split()))
        table.add_row(*(escape(str(cell or "-")) for cell in cells), f"{run['seconds'] / 60:.1f}", escape(error))
    _print_table(table)
    return OK


def _compare(args: argparse.Namespace) -> int:
    labels = [next((w.partition("=")[2] for w in words if w.startswith("label=")), None) for words in args.start]
    overrides = [[*(word for word in words if not word.startswith("label=")), *args.set] for words in args.start]
    configs = _to_start(overrides, args.out)
    from pipelines.compare import EXPERIMENT, compare_runs
    from popgen.config import TrackingConfig
    from popgen.evaluation.comparison_report import to_tables
    from popgen.progress import make_reporter
    from popgen.tracking import check_uri

    tracking = TrackingConfig(enabled=not args.no_tracking, uri=args.tracking_uri, experiment=EXPERIMENT)
    check_uri(tracking.uri)
    reporter = make_reporter(quiet=args.quiet)
    try:
        report = compare_runs(
            *(args.runs, list(zip(labels, configs, strict=True)), args.out),
            agents=args.agents,
            sp=args.sp,
            xp=args.xp,
            tracking=tracking,
            reporter=reporter,
        )
    finally:
        reporter.close()
    if args.json:
        _print_json(report)
        return OK
    for table in to_tables(report):
        _print_table(table)
    print("\n".join([*report["notes"], f"report: {args.out} ({', '.join(report['files'])})"]))
    return OK


def _self_sabotage(args: argparse.Namespace) -> int:
    methods = args.method or ([] if args.population else ["lipo", "comedi", "xpm_sim"])
    if args.overrides and not methods:
        raise UserError("overrides", "have no use where nothing is trained", "name what to train with --method")
    from popgen.evaluation.sabotage_report import NOTES, TERMINATIONS, summary, to_tables

    rules = list(TERMINATIONS) if args.termination == "both" else [args.termination]
    base = [] if any(word.startswith("env=") for word in args.overrides) else ["env=rendezvous/mppmr"]
    base += ["population.size=8", *args.overrides]
    penalties = [f"env.params.exit_penalty={TERMINATIONS[rule]['exit_penalty']}" for rule in rules]
    overrides = [
        [*base, f"method={method}", penalty, f"seed={seed}"]
        for penalty in penalties
        for method in methods
        for seed in args.seeds
    ]
    configs = _to_start(overrides, args.out)
    from pipelines.experiments import self_sabotage
    from popgen.progress import make_reporter

    reporter = make_reporter(quiet=args.quiet)
    try:
        report = self_sabotage(
            args.population, configs, args.out, episodes=args.episodes, seed=args.seed, reporter=reporter
        )
    finally:
        reporter.close()
    if args.json:
        _print_json(report)
        return OK
    for table in to_tables(report):
        _print_table(table)
    print("\n".join([*NOTES, *summary(report), f"report: {args.out} ({', '.join(report['files'])})"]))
    return OK


def _shared_encoder(args: argparse.Namespace) -> int:
    if args.overrides and args.run:
        raise UserError("overrides", "have no use where nothing is trained", "leave out --run")
    base = [] if any(word.startswith("env=") for word in args.overrides) else ["env=rendezvous/mppmr"]
    base += ["method=xpm_sim", "population.size=8", *args.overrides]
    kinds = [] if args.run else ["none", "shared"]
    overrides = [[*base, f"xpm_sim.encoder={kind}", f"seed={seed}"] for seed in args.seeds for kind in kinds]
    configs = _to_start(overrides, args.out)
    from pipelines.shared_encoder import shared_encoder
    from popgen.evaluation.shared_encoder import summary
    from popgen.progress import make_reporter

    reporter = make_reporter(quiet=args.quiet)
    try:
        report = shared_encoder(args.run, configs, args.out, reporter=reporter)
    finally:
        reporter.close()
    if args.json:
        _print_json(report)
        return OK
    print("\n".join([*summary(report), f"report: {args.out} ({', '.join(report['files'])})"]))
    return OK


def _to_start(overrides: Sequence[Sequence[str]], out: str) -> list[RunConfig]:
    """The runs that a command starts itself, in folders under `out` that their settings decide.

    All that can be known before the first of them starts is checked, and the place of the report.
    """
    from popgen.config import RunConfig
    from popgen.preflight import check_root, preflight

    configs = [RunConfig.parse(compose(words)) for words in overrides]
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    _bound_threads(max((config.cluster.threads for config in configs), default=1))
    from pipelines.batch import check_different, named

    configs = [named(config, Path(out) / "runs") for config in configs]
    check_different(configs)
    for config in configs:
        preflight(config)
    check_root(Path(out), 16 * 2**20, "--out")
    return configs


def _bench(args: argparse.Namespace) -> int:
    from pipelines.bench import bench_env

    result = bench_env(args.env, num_envs=args.envs, seconds=args.seconds)
    if args.json:
        _print_json(result)
    else:
        ratio = "" if result["ratio"] is None else f"   {result['ratio']:,.0f} times the reference"
        print(f"{args.env}: {result['steps_per_second']:,.0f} environment steps a second{ratio}")
    return OK


def _bench_scale(args: argparse.Namespace) -> int:
    from popgen.config import RunConfig
    from popgen.preflight import preflight

    config = RunConfig.parse(compose([*args.overrides, "method=xpm_wm"]))
    preflight(config)
    _bound_threads(config.cluster.threads)
    from pipelines.bench_scale import bench_scale

    tell = (lambda text: None) if args.quiet else (lambda text: print(text, file=sys.stderr))
    result = bench_scale(config, samplers=args.samplers, seconds=args.seconds, tell=tell)
    if args.json:
        _print_json(result)
    else:
        _print_scale(result)
    return OK


def _bench_mappo(args: argparse.Namespace) -> int:
    from popgen.config import RunConfig
    from popgen.preflight import preflight

    config = RunConfig.parse(compose([*args.overrides, "method=mappo"]))
    preflight(config)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    _bound_threads(config.cluster.threads)
    from pipelines.bench_mappo import bench_mappo

    result = bench_mappo(config, seconds=args.seconds)
    if args.json:
        _print_json(result)
    else:
        shares = ", ".join(f"{name} {share:.0%}" for name, share in result["shares"].items())
        print(f"{result['env']}: {result['steps_per_second']:,} environment steps a second end to end ({shares})")
        print(f"{result['steps_per_cpu_second']:,} a second of processor time, {result['threads']} threads")
    return OK


def _print_scale(result: Mapping[str, Any]) -> None:
    from rich.table import Table

    measured = Table("samplers", "steps/s", "model's", "world model idle", "agent idle", title="measured here")
    for row in result["measured"]:
        idle = (f"{row['idle'][name]:.0%}" for name in ("model", "agent"))
        rates = (f"{row[name]:,.0f}" for name in ("steps_per_second", "model_steps_per_second"))
        measured.add_row(str(row["samplers"]), *rates, *idle)
    _print_table(measured)
    model = Table("samplers", "steps/s", "world model idle", "agent idle", title="model: a core for each")
    for nodes, row in result["model"].items():
        model.add_row(nodes, f"{row['steps_per_second']:,.0f}", f"{row['idle_model']:.0%}", f"{row['idle_agent']:.0%}")
    _print_table(model)
    costs = ", ".join(f"{name} {value:.3g}" for name, value in result["costs"].items())
    print("\n".join([f"a round costs (s; steps; bytes): {costs}", *(f"assumed: {a}" for a in result["assumptions"])]))


def _print_table(table: Any) -> None:
    from rich.console import Console

    # Piped output has no width of its own; tables of many members must not be cut.
    Console(width=None if sys.stdout.isatty() else 200).print(table)


# --- configuration


def compose(overrides: Sequence[str]) -> dict[str, Any]:
    """The plain dictionary that conf/ and the overrides give, not yet checked by the schemas.

    Raises:
        UserError: an override that cannot be read, an unknown group option, key or interpolation.
    """
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.config_store import ConfigStore
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from conf import DIRECTORY
    from popgen.config import RunConfig

    ConfigStore.instance().store(name="schema", node=RunConfig().model_dump(mode="json"))
    GlobalHydra.instance().clear()
    given = [_translate(override) for override in overrides]
    try:
        with initialize_config_dir(str(DIRECTORY), version_base="1.3"):
            composed = hydra_compose("config", given)
        missing = sorted(OmegaConf.missing_keys(composed))
        values = OmegaConf.to_container(composed, resolve=True)
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # the last for a number as a group's option
        raise _composition_error(error, overrides) from None
    for key in missing or _unset(values):
        raise UserError(key, "has no value", f"give one with {key}=VALUE")
    assert isinstance(values, dict)
    values.pop("per_env", None)  # the table that conf/scale/paper.yaml looks values up in
    return values


def group_options(group: str) -> list[str]:
    """Names that `group=NAME` takes."""
    from conf import DIRECTORY

    folder = DIRECTORY / group
    return sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml"))


def _translate(override: str) -> str:
    """Aliases, and `++` for dictionaries that take any key, so that users need not know Hydra's signs."""
    key, equals, value = override.partition("=")
    if equals and key or override.startswith("~"):
        if key.lstrip("+").startswith("hydra"):
            raise UserError(key, "Hydra's own settings have no use here", "leave it out")
        if key in ALIASES:
            return f"{ALIASES[key]}={value}"
        is_open = key in OPEN_SECTIONS or key.startswith(tuple(f"{name}." for name in OPEN_SECTIONS))
        return f"++{override}" if is_open else override
    raise UserError("overrides", f"cannot read {_short(override)!r}", "write KEY=VALUE")


def _unset(values: Any, prefix: str = "") -> list[str]:
    """Keys whose interpolation gave the mark of a missing value."""
    if values == "???":
        return [prefix]
    items = values.items() if isinstance(values, dict) else ()
    return [key for name, item in items for key in _unset(item, f"{prefix}.{name}" if prefix else str(name))]


def _composition_error(error: Exception, overrides: Sequence[str]) -> UserError:
    from hydra.errors import MissingConfigException, OverrideParseException
    from omegaconf.errors import InterpolationKeyError

    from popgen.config import unknown_field

    text = str(error)
    if isinstance(error, MissingConfigException) and "Could not find" in text:
        group, _, option = text.partition("Could not find '")[2].partition("'")[0].partition("/")
        return _unknown_option(group, option)
    if isinstance(error, OverrideParseException):
        return UserError(
            "overrides", f"cannot read {_culprit(text, overrides)!r}", "write KEY=VALUE, with quotes around odd text"
        )
    if text.startswith("Ambiguous value"):
        fix = "write a list as KEY=[a,b]; several runs need several commands"
        return UserError(
            "overrides", f"{text.partition(chr(10))[0].rpartition(' ')[2].strip(chr(39))!r} has several values", fix
        )
    if text.startswith("Config group override"):  # a number or nothing where a name belongs
        groups = {override.partition("=")[0]: override.partition("=")[2] for override in overrides}
        known = {group: group_options(group) for group in groups}
        return next(_unknown_option(g, option) for g, option in groups.items() if known[g] and option not in known[g])
    if text.startswith("Could not override '"):
        return unknown_field(text.split("'")[1])
    first = text.partition("\n")[0]
    if isinstance(error, InterpolationKeyError):
        return UserError(error.full_key or "overrides", first, "refer to a field that is there")
    return UserError("overrides", first, "see conf/ for what can be set")


def _unknown_option(group: str, option: str) -> UserError:
    options = group_options(group)
    by_leaf = {name.rpartition("/")[2]: name for name in options}
    close = difflib.get_close_matches(option, options, n=1) or [
        by_leaf[leaf] for leaf in difflib.get_close_matches(option.rpartition("/")[2], by_leaf, n=1)
    ]
    listed = f"choose one of {', '.join(options)}" if options else "see conf/"
    return UserError(group, f"there is no option {option!r}", f"did you mean {group}={close[0]}?" if close else listed)


def _culprit(text: str, overrides: Sequence[str]) -> str:
    return next((override for override in overrides if override in text), overrides[0] if len(overrides) == 1 else text)


# --- arguments


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError("arguments", message, f"see {self.prog} --help")


def _parse(argv: list[str]) -> argparse.Namespace:
    parser = _parser()
    args, rest = parser.parse_known_args(argv)
    if hasattr(args, "overrides"):  # overrides may stand after options too
        args.overrides = [*args.overrides, *(word for word in rest if not word.startswith("-"))]
        rest = [word for word in rest if word.startswith("-")]
    if rest:
        raise UserError("arguments", f"unknown argument {rest[0]}", "see popgen --help")
    if args.command is None:
        parser.print_help(sys.stderr)
        raise SystemExit(ERROR)
    return args


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="popgen", description="Populations of diverse cooperative partner agents.")
    parser.add_argument("--version", action="version", version=f"popgen {popgen.__version__}")
    parser.set_defaults(command=None)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", parser_class=_Parser)
    _add_run(commands)
    _add_population_commands(commands)
    _add_compare(commands)
    _add_experiment(commands)
    bench = commands.add_parser("bench", help="measure speed", description="Measure speed.")
    kinds = bench.add_subparsers(title="what to measure", metavar="WHAT", required=True, parser_class=_Parser)
    env = _command(
        kinds,
        "env",
        _bench,
        "step plus all observations on one core, and the reference implementation in the same run",
        "Keys of --json: steps_per_second, reference_steps_per_second and ratio (null without a reference), "
        "step_only_per_second, env, num_envs, seconds.",
    )
    env.add_argument("--env", default="overcooked/cramped_room", help="registry name (%(default)s)")
    env.add_argument("--envs", type=_at_least(1), default=1024, help="environments stepped together (%(default)s)")
    env.add_argument("--seconds", type=_positive, default=2.0, help="time per measurement (%(default)s)")
    mappo = _command(
        kinds,
        "mappo",
        _bench_mappo,
        "MAPPO's training of self-play on RLlib, end to end",
        "Keys of --json: steps_per_second, steps_per_cpu_second, shares (sampling, pooling, gradients, rllib), env, "
        "threads, runners, envs, iterations, steps, seconds, cpu_seconds.",
    )
    mappo.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="as for `popgen run`")
    mappo.add_argument("--seconds", type=_positive, default=20.0, help="time of the measurement (%(default)s)")
    scale = _command(
        kinds,
        "scale",
        _bench_scale,
        "sampling and idle learners with several samplers, and a model of more nodes",
        "Keys of --json: measured (samplers, steps_per_second, idle, model_steps_per_second), costs of a round, model "
        "(samplers -> steps_per_second, idle_model, idle_agent), assumptions, cores, network_bytes_per_second, env.",
    )
    scale.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="as for `popgen run`")
    scale.add_argument("--samplers", type=_numbers, default=[1, 2, 4], metavar="1,2,...", help="how many (1,2,4)")
    scale.add_argument("--seconds", type=_positive, default=30.0, help="time per measurement (%(default)s)")
    return parser


def _add_run(commands: Any) -> None:
    run = _command(
        commands,
        "run",
        _run,
        "generate a population",
        "Overrides are Hydra's: a group as in env=overcooked/cramped_room, method=xpm_wm, scale=laptop, "
        "cluster=gpu_node or tracking=off, a field as in population.size=3 or agent.lambda_xp=0.1; seed=1 stands for "
        "run.seed=1. The same run.id goes on where an interrupted run was. Exit codes: 0, 2 for an error told in one "
        "line, 130 when interrupted. Keys of --json: run_id, run_dir, population (paths), members (how many), matrix "
        "(mean and standard_error, row = seat 0, column = seat 1), ledger (environment steps by member and kind), "
        "evaluation (as `evaluate --json`), files (the report's), seconds; with --dry-run the whole configuration.",
    )
    run.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="settings on top of conf/config.yaml")
    run.add_argument("--dry-run", action="store_true", help="check everything, print the configuration, start nothing")


def _add_population_commands(commands: Any) -> None:
    evaluate = _command(
        commands,
        "evaluate",
        _evaluate,
        "SP/XP matrix of a population, beside random and idle partners",
        "Keys of --json: those of popgen/evaluation/report.py (sp, xp, matrix, beside, obstruction, pairs, ...) "
        "and files.",
    )
    evaluate.add_argument("population", metavar="POPULATION", help="folder that holds manifest.json")
    evaluate.add_argument("--episodes", type=_at_least(1), default=20, help="per ordered pair (%(default)s)")
    evaluate.add_argument("--seed", type=_at_least(0), default=0, help="of the evaluation (%(default)s)")
    evaluate.add_argument("--members", type=_numbers, default=None, metavar="1,2,...", help="all by default")
    evaluate.add_argument("--out", metavar="DIR", help="of the report (POPULATION/evaluation)")
    evaluate.add_argument("--env", metavar="NAME", help="refuse a population that was trained in another environment")
    evaluate.add_argument(
        "--param", type=_pair, action="append", default=[], metavar="KEY=VALUE", help="the same for a parameter of it"
    )
    show = _command(
        commands,
        "show",
        _show,
        "what a population holds",
        "Keys of --json: path, manifest, bytes (of all members' files), steps (by kind), total_steps, members "
        "(member.json with total_steps, bytes and parameters).",
    )
    show.add_argument("population", metavar="POPULATION", help="folder that holds manifest.json")
    runs = _command(
        commands,
        "runs",
        _runs,
        "the runs in a folder: state, member, environment steps, last error",
        "States: running, finished, failed, interrupted (`popgen run` with the same run.id goes on), damaged. Keys of "
        "--json: root, and runs, each with id, state, method, scale, environment, member (that is trained) of size, "
        "steps (by kind), total_steps, seconds (of all attempts), attempt, began (seconds since 1970), error.",
    )
    runs.add_argument("root", metavar="ROOT", nargs="?", default="runs", help="folder of the runs (%(default)s)")


def _add_compare(commands: Any) -> None:
    compare = _command(
        commands,
        "compare",
        _compare,
        "environment steps, time, SP/XP and steps to equal quality of finished runs, against the number of agents",
        "Runs of one method and environment are its seeds. Keys of --json: those of "
        "popgen/evaluation/comparison_report.py (runs, costs, scores, quality, budgets, notes) and files.",
    )
    compare.add_argument(
        "runs", nargs="*", type=_named_path, metavar="[NAME=]RUN", help="a run's folder, called NAME and not its method"
    )
    compare.add_argument(
        *("--start", "-s"),
        action="append",
        type=_words,
        default=[],
        metavar="'KEY=VALUE ...'",
        help="run this first (as `popgen run`), in DIR/runs, unless it is finished there; label=NAME calls it NAME",
    )
    compare.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="for every --start")
    compare.add_argument("--agents", type=_at_least(1), default=8, help="extrapolate costs to this many (%(default)s)")
    for name, which in (("--sp", "SP of at least"), ("--xp", "XP of at most")):
        told = f"equal quality: {which} this (0.8 and 0.2 of the SP of the paper's XPM-WM on the layout)"
        compare.add_argument(name, type=_finite, default=None, metavar="SCORE", help=told)
    compare.add_argument("--out", default="comparison", metavar="DIR", help="of the report (%(default)s)")
    compare.add_argument("--tracking-uri", default=None, metavar="URI", help="of MLflow (sqlite in DIR)")
    compare.add_argument("--no-tracking", action="store_true", help="no MLflow")


def _add_experiment(commands: Any) -> None:
    experiment = commands.add_parser(
        "experiment", help="an experiment of the paper", description="An experiment of the paper."
    )
    kinds = experiment.add_subparsers(title="experiments", metavar="WHICH", required=True, parser_class=_Parser)
    sabotage = _command(
        kinds,
        "self-sabotage",
        _self_sabotage,
        "who leaves the task in cross-play: LIPO, CoMeDi and XPM-Sim on rendezvous, beside the paper's first table",
        "Without --population all three are trained, 8 agents each, in DIR/runs (what is finished there is not trained "
        "again); overrides are those of `popgen run`. Keys of --json: those of popgen/evaluation/sabotage_report.py "
        "(rows, means, paper, steps, ...) and files.",
    )
    sabotage.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="settings of what is trained")
    sabotage.add_argument(
        "--population",
        type=_label_and_path,
        action="append",
        default=[],
        metavar="METHOD=PATH",
        help="a finished population or run",
    )
    methods = ("lipo", "comedi", "xpm_sim", "mappo")
    sabotage.add_argument("--method", action="append", choices=methods, help="what to train (the paper's three)")
    sabotage.add_argument(
        "--termination",
        choices=("penalty", "plain", "both"),
        default="both",
        help="what an exit costs in training: the worst reward for every step left, nothing, or both (%(default)s)",
    )
    sabotage.add_argument("--seeds", type=_numbers, default=[1], metavar="1,2,...", help="of training (1)")
    sabotage.add_argument("--episodes", type=_at_least(1), default=20, help="per ordered pair (%(default)s)")
    sabotage.add_argument("--seed", type=_at_least(0), default=0, help="of the evaluation (%(default)s)")
    sabotage.add_argument("--out", default="self-sabotage", metavar="DIR", help="of the report (%(default)s)")
    encoder = _command(
        kinds,
        "shared-encoder",
        _shared_encoder,
        "learning curves of XPM-Sim's later members on rendezvous, with and without an encoder shared by all members",
        "Without --run both kinds are trained, 8 agents each, in DIR/runs (what is finished there is not trained "
        "again); overrides are those of `popgen run`. Keys of --json: those of popgen/evaluation/shared_encoder.py "
        "(curves, environment, unit, runs) and files.",
    )
    encoder.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="settings of what is trained")
    encoder.add_argument("--run", action="append", default=[], metavar="DIR", help="a finished run of either kind")
    encoder.add_argument("--seeds", type=_numbers, default=[1], metavar="1,2,...", help="of training (1)")
    encoder.add_argument("--out", default="shared-encoder", metavar="DIR", help="of the report (%(default)s)")


def _command(
    commands: Any, name: str, command: Callable[[argparse.Namespace], int], summary: str, details: str
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=summary, description=f"{summary[0].upper()}{summary[1:]}.", epilog=details
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.set_defaults(command=command)
    return parser


def _at_least(minimum: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"must be a whole number, got {text!r}") from None
        if not minimum <= value < 2**31:
            raise argparse.ArgumentTypeError(f"must be at least {minimum} and below 2^31, got {value}")
        return value

    return parse


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number above 0, got {text!r}")
    return value


def _words(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"cannot read {text!r} ({error})") from None


def _finite(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be a number, got {text!r}")
    return value


def _named_path(text: str) -> tuple[str | None, str]:
    """NAME=PATH, or a path alone; a name holds no slash."""
    name, equals, path = text.partition("=")
    if not equals or "/" in name:
        return None, text
    return _label_and_path(text)


def _label_and_path(text: str) -> tuple[str, str]:
    name, _, path = text.partition("=")
    if not name or not path or "/" in name or len(name) > 40:
        raise argparse.ArgumentTypeError(f"must be NAME=PATH with a short name without slashes, got {text!r}")
    return name, path


def _numbers(text: str) -> list[int]:
    return [_at_least(1)(part) for part in text.split(",")]


def _pair(text: str) -> tuple[str, Any]:
    import yaml

    key, equals, value = text.partition("=")
    if not key or not equals:
        raise argparse.ArgumentTypeError(f"must be KEY=VALUE, got {text!r}")
    try:
        return key, yaml.safe_load(value)
    except yaml.YAMLError:
        raise argparse.ArgumentTypeError(f"cannot read the value of {text!r}") from None
