"""Best responses to the members of populations: each is trained once, as an ego with one partner, and found again by
the digest of the member's weights.

They lie in one folder, a run for each: `br-DIGEST`. Another population that holds the same member finds its response
there too; a run that was interrupted goes on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.evaluation.holdout_players import NO_WEIGHTS, Group, Player, open_sides
from popgen.methods.ego.config import BrRun
from popgen.methods.registry import METHODS
from popgen.pipelines.ego_training import make_ego_config, train_ego
from popgen.population import load_population
from popgen.progress import Reporter

FOLDER = "best_responses"
"""Beside a population, unless another place is given."""

_LETTERS = 20
"""Of a digest, in the name of a run."""


def default_folder(source: str) -> Path:
    """Where the responses to a population's members are by default: beside it."""
    return load_population(source).path.resolve().parent / FOLDER


def find_response(folder: str | Path, digest: str) -> Player | None:
    """The best response to the member with these weights, None where none is finished.

    Raises:
        UserError: what lies there is damaged, or is of another member.
    """
    path = Path(folder) / name_run(digest) / "population"
    if not (path / "manifest.json").exists() or not len(load_population(path)):
        return None
    (group,) = open_sides({"response": [("best response", str(path))]}, str).sides["response"]
    met = frozenset[str]().union(*(one.digests for one in group.partners))
    if met != {digest}:
        raise UserError(str(path), "is no best response to the member it is named after", "remove its run's folder")
    return group.players[0]


def name_run(digest: str) -> str:
    """Id of the run that trains the best response to a member."""
    return f"br-{digest[:_LETTERS]}"


def find_responses(groups: Sequence[Group], folder: str | None) -> dict[str, Player]:
    """Digest -> best response, for all members of some groups that have one.

    Args:
        groups: of partners.
        folder: where they lie; None for the places beside the populations.
    """
    found = {}
    for player in (player for group in groups for player in group.players):
        if player.digest in (None, NO_WEIGHTS):
            continue
        response = find_response(folder or default_folder(player.source), player.digest)
        if response is not None:
            found[player.digest] = response
    return found


def train_responses(
    groups: Sequence[Group], folder: str | None, settings: Mapping[str, Any], reporter: Reporter, *, scale: str
) -> int:
    """Train what is missing, one after the other; gives the number of those trained.

    Args:
        groups: of partners; users' agents and members without weights have no response.
        folder: where they go; None for the places beside the populations.
        settings: dotted field -> value, of the runs.
        reporter: told of progress.
        scale: the recipe.

    Raises:
        UserError: settings that do not exist, or a run that fails.
    """
    configs = []
    for player in (player for group in groups for player in group.players):
        if player.digest in (None, NO_WEIGHTS):
            continue
        place = folder or str(default_folder(player.source))
        if find_response(place, player.digest) is None:
            configs.append(_plan_run(player, place, settings, scale))
    for config in configs:
        train_ego(config, reporter)
    return len(configs)


def _plan_run(player: Player, folder: str, settings: Mapping[str, Any], scale: str) -> RunConfig:
    method = next(name for name, one in METHODS.items() if issubclass(one.config, BrRun))
    places = {"run.root": folder, "run.id": name_run(player.digest or ""), "tracking.enabled": False}
    return make_ego_config(method, [f"{player.source}:{player.member}"], {**places, **settings}, scale=scale)
