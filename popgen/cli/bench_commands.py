"""`popgen bench WHAT`: measured speed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from popgen.cli.arguments import Parser, add_command, at_least, numbers, positive
from popgen.cli.compose import compose
from popgen.cli.printing import OK, print_json, print_table
from popgen.cli.training import before_ray, bound_threads
from popgen.errors import UserError

if TYPE_CHECKING:
    from popgen.config.run_config import RunConfig

C = TypeVar("C", bound="RunConfig")


def add(commands: Any) -> None:
    """`bench env`, `bench mappo`, `bench ego`, `bench world-model` and `bench scale`."""
    bench = commands.add_parser("bench", help="measure speed", description="Measure speed.")
    kinds = bench.add_subparsers(title="what to measure", metavar="WHAT", required=True, parser_class=Parser)
    env = add_command(
        kinds,
        "env",
        bench_env,
        "step plus all observations on one core, and the reference implementation in the same run",
        "Keys of --json: steps_per_second, reference_steps_per_second and ratio (null without a reference), "
        "step_only_per_second, env, num_envs, seconds.",
    )
    env.add_argument("--env", default="overcooked/cramped_room", help="registry name (%(default)s)")
    env.add_argument("--envs", type=at_least(1), default=1024, help="environments stepped together (%(default)s)")
    env.add_argument("--seconds", type=positive, default=2.0, help="time per measurement (%(default)s)")
    mappo = add_command(
        kinds,
        "mappo",
        bench_mappo,
        "MAPPO's training of self-play on RLlib, end to end",
        "Keys of --json: steps_per_second, steps_per_cpu_second, shares (sampling, pooling, gradients, rllib), env, "
        "threads, runners, envs, iterations, steps, seconds, cpu_seconds.",
    )
    mappo.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="as for `popgen run`")
    mappo.add_argument("--seconds", type=positive, default=20.0, help="time of the measurement (%(default)s)")
    learners = add_command(
        kinds,
        "world-model",
        bench_world_model,
        "XPM-WM's two learners: milliseconds by part, and how near they come to this machine's matrix products",
        "Keys of --json: sizes (recipe -> world_model and agent, each milliseconds, parts, flops, share_of_peak; "
        "precision), peaks (float32, bfloat16: operations a second), threads.",
    )
    learners.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="as for `popgen run`")
    learners.add_argument("--scales", default="laptop,paper", metavar="NAME,...", help="recipes (%(default)s)")
    learners.add_argument("--seconds", type=positive, default=10.0, help="time per measurement (%(default)s)")
    _add_ego(kinds)
    scale = add_command(
        kinds,
        "scale",
        bench_scale,
        "sampling and idle learners with several samplers, and a model of more nodes",
        "Keys of --json: measured (samplers, steps_per_second, idle, model_steps_per_second), costs of a round, model "
        "(samplers -> steps_per_second, idle_model, idle_agent), assumptions, cores, network_bytes_per_second, env.",
    )
    scale.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="as for `popgen run`")
    scale.add_argument("--samplers", type=numbers, default=[1, 2, 4], metavar="1,2,...", help="how many (1,2,4)")
    scale.add_argument("--seconds", type=positive, default=30.0, help="time per measurement (%(default)s)")


def _add_ego(kinds: Any) -> None:
    ego = add_command(
        kinds,
        "ego",
        bench_ego,
        "an ego's training beside feed-forward and beside world-model partners, end to end",
        "Keys of --json: env, method, threads, envs, partners, kinds (by kind of partner: steps, seconds, cpu_seconds, "
        "steps_per_second, steps_per_cpu_second, rollout, the share of play).",
    )
    ego.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="as for `popgen ego train`")
    ego.add_argument("--partners", type=at_least(1), default=8, help="of each kind (%(default)s)")
    ego.add_argument("--seconds", type=positive, default=10.0, help="time per measurement (%(default)s)")


def bench_env(args: argparse.Namespace) -> int:
    """Environment steps a second."""
    from popgen.pipelines.bench_env import bench_env as measure

    result = measure(args.env, num_envs=args.envs, seconds=args.seconds)
    if args.json:
        print_json(result)
    else:
        ratio = "" if result["ratio"] is None else f"   {result['ratio']:,.0f} times the reference"
        print(f"{args.env}: {result['steps_per_second']:,.0f} environment steps a second{ratio}")
    return OK


def bench_mappo(args: argparse.Namespace) -> int:
    """Environment steps a second of MAPPO's training."""
    from popgen.methods.mappo.config import MappoRun

    config = _check_run(MappoRun, args.overrides)
    from popgen.pipelines.bench_mappo import bench_mappo as measure

    result = measure(config, seconds=args.seconds)
    if args.json:
        print_json(result)
    else:
        shares = ", ".join(f"{name} {share:.0%}" for name, share in result["shares"].items())
        print(f"{result['env']}: {result['steps_per_second']:,} environment steps a second end to end ({shares})")
        print(f"{result['steps_per_cpu_second']:,} a second of processor time, {result['threads']} threads")
    return OK


def bench_ego(args: argparse.Namespace) -> int:
    """Environment steps a second of an ego's training."""
    bound_threads(1)
    from popgen.config.run_config import RunConfig
    from popgen.methods.ego.config import EgoFcpRun, EgoRun
    from popgen.methods.registry import DEFAULT_EGO

    words = [EgoFcpRun.method_override(), "cluster.threads=2", *args.overrides]
    config = RunConfig.parse(compose(words))
    if not isinstance(config, EgoRun) or config.plays_itself:
        raise UserError("method", f"{config.method} has no partners", f"choose another, such as {DEFAULT_EGO}")
    from popgen.pipelines.bench_ego import bench_ego as measure

    result = measure(config, seconds=args.seconds, partners=args.partners)
    if args.json:
        print_json(result)
        return OK
    for kind, row in result["kinds"].items():
        rates = f"{row['steps_per_second']:,} environment steps a second ({row['steps_per_cpu_second']:,} of processor"
        print(
            f"{result['env']}, {result['partners']} partners of kind {kind}: {rates} time), play {row['rollout']:.0%}"
        )
    return OK


def bench_world_model(args: argparse.Namespace) -> int:
    """Milliseconds of an update."""
    from popgen.methods.xpm_wm.config import XpmWmRun

    configs = {name: _check_run(XpmWmRun, [*args.overrides, f"scale={name}"]) for name in args.scales.split(",")}
    from popgen.pipelines.bench_world_model import bench_world_model as measure

    result = measure(configs, seconds=args.seconds)
    if args.json:
        print_json(result)
    else:
        _print_learners(result)
    return OK


def bench_scale(args: argparse.Namespace) -> int:
    """Environment steps a second with several samplers."""
    from popgen.methods.xpm_wm.config import XpmWmRun

    config = _check_run(XpmWmRun, args.overrides)
    from popgen.pipelines.bench_scale import bench_scale as measure

    tell = (lambda text: None) if args.quiet else (lambda text: print(text, file=sys.stderr))
    result = measure(config, samplers=args.samplers, seconds=args.seconds, tell=tell)
    if args.json:
        print_json(result)
    else:
        _print_scale(result)
    return OK


def _print_learners(result: Mapping[str, Any]) -> None:
    from rich.table import Table

    parts = list(next(iter(result["sizes"].values()))["agent"]["parts"])
    table = Table("size", "learner", "ms", *parts, "GFLOP/s", "of peak", title="one update, milliseconds by part")
    for size, learners in result["sizes"].items():
        for learner in ("world_model", "agent"):
            row = learners[learner]
            spent = (f"{row['parts'][part]:.1f}" for part in parts)
            rate = f"{row['flops'] / 1e9:.1f}", f"{row['share_of_peak']:.0%} ({learners['precision'][learner]})"
            table.add_row(size, learner.replace("_", " "), f"{row['milliseconds']:.1f}", *spent, *rate)
    print_table(table)
    peaks = ", ".join(f"{name} {value / 1e9:.0f} GFLOP/s" for name, value in result["peaks"].items())
    print(f"peak of matrix products here, {result['threads']} threads: {peaks}")


def _check_run(schema: type[C], overrides: list[str]) -> C:
    """A run of the method whose schema is given."""
    from popgen.runs.preflight import preflight

    config = schema.parse(compose([*overrides, schema.method_override()]))
    assert isinstance(config, schema)
    preflight(config)
    before_ray(config.cluster.threads, config.cluster.address is None)
    return config


def _print_scale(result: Mapping[str, Any]) -> None:
    from rich.table import Table

    measured = Table("samplers", "steps/s", "model's", "world model idle", "agent idle", title="measured here")
    for row in result["measured"]:
        idle = (f"{row['idle'][name]:.0%}" for name in ("model", "agent"))
        rates = (f"{row[name]:,.0f}" for name in ("steps_per_second", "model_steps_per_second"))
        measured.add_row(str(row["samplers"]), *rates, *idle)
    print_table(measured)
    model = Table("samplers", "steps/s", "world model idle", "agent idle", title="model: a core for each")
    for nodes, row in result["model"].items():
        model.add_row(nodes, f"{row['steps_per_second']:,.0f}", f"{row['idle_model']:.0%}", f"{row['idle_agent']:.0%}")
    print_table(model)
    costs = ", ".join(f"{name} {value:.3g}" for name, value in result["costs"].items())
    print("\n".join([f"a round costs (s; steps; bytes): {costs}", *(f"assumed: {a}" for a in result["assumptions"])]))
