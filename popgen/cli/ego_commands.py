"""`popgen ego train`: an agent trained with populations."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from popgen.cli.arguments import Parser, add_command, add_config_dir
from popgen.cli.compose import compose
from popgen.cli.printing import tell_unfinished
from popgen.cli.run_command import execute
from popgen.cli.training import bound_threads


def add(commands: Any) -> None:
    """`ego train`."""
    ego = commands.add_parser("ego", help="agents trained with populations", description="Train with populations.")
    kinds = ego.add_subparsers(title="what to do", metavar="WHAT", required=True, parser_class=Parser)
    train = add_command(
        kinds,
        "train",
        train_ego,
        "train an ego beside the members of populations, or in self-play",
        "method=hipt (default), fcp, br (one partner: PATH:3), sp or sp_aug (no POPULATION, but env=LAYOUT); the "
        "environment is that of the populations. The result is a population of one. Exit codes and keys of --json: "
        "those of `popgen run`.",
    )
    train.add_argument(
        "overrides",
        nargs="*",
        metavar="POPULATION|KEY=VALUE",
        help="folders of populations, PATH:1,3 for some members only; settings as for `popgen run`",
    )
    train.add_argument(
        "--dry-run", action="store_true", help="check everything, print the configuration, start nothing"
    )
    add_config_dir(train)


def is_population(word: str) -> bool:
    """Whether a word names a folder, or members of what is in it, whatever else it might be."""
    from popgen.population.chosen_members import split_members

    return Path(split_members(word)[0]).expanduser().is_dir()


def train_ego(args: argparse.Namespace) -> int:
    """Train an ego, or say what would be done."""
    bound_threads(1)
    from popgen.config.run_config import RunConfig
    from popgen.methods.registry import DEFAULT_EGO
    from popgen.pipelines.ego_training import environment_of, find_ego_method, pin_partners, refuse_derived

    partners = [word for word in args.overrides if "=" not in word or is_population(word)]
    overrides = [word for word in args.overrides if word not in partners]
    keys = [word.lstrip("+").partition("=")[0] for word in overrides]
    method = dict(word.partition("=")[::2] for word in overrides).get("method", DEFAULT_EGO)
    overrides = [*(word for word in overrides if not word.startswith("method=")), f"method={find_ego_method(method)}"]
    tell_unfinished(partners)
    info = environment_of(partners) if partners else None
    if info is not None and not any(key == "env" or key.startswith("env.") for key in keys):
        values = compose([*overrides, f"env.name={info.name}"], args.config_dir)
        values["env"] = {"name": info.name, "params": info.params}
    else:
        values = compose(overrides, args.config_dir)
    refuse_derived(values.get("ego") or {})
    if partners:
        values.setdefault("ego", {})["partners"] = partners
    return execute(pin_partners(RunConfig.parse(values)), args)
