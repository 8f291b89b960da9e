"""Best responses to the members of populations: each is trained once, as an ego with one partner, and found again.

They lie in one folder, a run for each: `br-WHO-HOW`. WHO is a digest of all that decides how the member acts (kind,
configuration, weights, environment), HOW one of the settings of the response's training. Another population that holds
the same member finds its response there too, if it asks for the same training; a run that was interrupted goes on.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.evaluation.holdout_lineages import NO_WEIGHTS, TRAINED_WITH
from popgen.evaluation.holdout_players import Group, Player, Response, open_sides
from popgen.methods.ego.config import BrRun, EgoRun
from popgen.methods.registry import METHODS
from popgen.pipelines.ego_training import make_ego_config, train_ego
from popgen.population import load_population
from popgen.population.manifest import EnvironmentInfo
from popgen.progress import Reporter

FOLDER = "best_responses"
"""Beside a population, unless another place is given."""

_LETTERS = 16, 8
"""Of the two digests in the name of a run."""

_FIX = "remove its run's folder"


_GIVEN = ("run.id", "run.root", "ego.partners", "ego.pinned")
"""Settings that follow from whom a response is to."""


@dataclass(frozen=True)
class ResponseTraining:
    """How best responses are trained.

    Attributes:
        scale: the recipe.
        settings: dotted field -> value, on top of it.
    """

    scale: str = "laptop"
    settings: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def of_words(words: Sequence[tuple[str, Any]]) -> ResponseTraining:
        """Of (field, value) as they are given; `scale` among them names the recipe."""
        settings = dict(words)
        return ResponseTraining(str(settings.pop("scale", ResponseTraining.scale)), settings)

    def digest(self, environment: EnvironmentInfo) -> str:
        """sha256 of all settings that decide the result in an environment, whatever recipe or word gave them.

        Raises:
            UserError: a recipe or a setting that does not exist, or one that is not to be chosen.
        """
        for name in _GIVEN:
            if name in self.settings:
                raise UserError(name, "of a best response follows from whom it is to", "leave it out")
        place = {"env.name": environment.name, "env.params": environment.params}
        return _digest_training(make_ego_config(_find_method(), [], {**self.settings, **place}, scale=self.scale))


def _digest_training(config: EgoRun) -> str:
    """Of a run, whoever its partner is, whatever its recipe is called and however its ego is evaluated."""
    ego = config.ego.model_copy(update={"partners": (), "pinned": ()})
    evaluation = type(config.evaluation)()
    return config.model_copy(update={"ego": ego, "evaluation": evaluation, "scale": ""}).digest()


def _find_method() -> str:
    return next(name for name, one in METHODS.items() if issubclass(one.config, BrRun))


def name_run(player: Player, settings: str) -> str:
    """Id of the run that trains the best response to a player, with the digest of its settings."""
    who, how = _LETTERS
    return f"br-{(player.identity or '')[:who]}-{settings[:how]}"


def find_response(folder: Path, player: Player, training: ResponseTraining, settings: str) -> Response | None:
    """The best response to a player that was trained in this way, None where none is finished.

    Args:
        folder: of best responses.
        player: the partner.
        training, settings: how, and its digest.

    Raises:
        UserError: what lies there is damaged, of another member, or trained in another way.
    """
    run = folder / name_run(player, settings)
    path = run / "population"
    if not (path / "manifest.json").exists() or not len(population := load_population(path)):
        return None
    info = population.info(1)
    met = [name for one in info.extra.get(TRAINED_WITH) or [] for name in one.get("identity", ())]
    if met != [player.identity]:
        raise UserError(str(path), "is no best response to the member it is named after", _FIX)
    if _digest_training(_read_config(run)) != settings:
        raise UserError(str(path), "was trained with other settings than those it is named after", _FIX)
    (group,) = open_sides({"response": [("best response", str(path))]}, str).sides["response"]
    return Response(group.players[0], training.scale, training.settings, info.total_steps)


def _read_config(run: Path) -> BrRun:
    path = run / "config.json"
    try:
        config = RunConfig.parse(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(str(path), f"the settings of a best response cannot be read ({error})", _FIX) from None
    if not isinstance(config, BrRun):
        raise UserError(str(path), f"is of a run of {config.method}, which trains no best response", _FIX)
    return config


@dataclass(frozen=True)
class Wanted:
    """A best response that is to be there: to whom, and the folders where it may lie, the first for a new one."""

    player: Player
    folders: tuple[Path, ...]


def list_wanted(groups: Sequence[Group], folder: str | None) -> list[Wanted]:
    """One for each policy of some groups, however often they hold it.

    Users' agents and members without weights have no best response.

    Args:
        groups: of partners.
        folder: where all lie; None for the places beside the populations.
    """
    found: dict[str, Wanted] = {}
    for player in (player for group in groups for player in group.players):
        if player.identity is not None and player.digest != NO_WEIGHTS:
            place = Path(folder) if folder else Path(player.source).resolve().parent / FOLDER
            known = found.setdefault(player.identity, Wanted(player, ()))
            found[player.identity] = Wanted(known.player, tuple(dict.fromkeys([*known.folders, place])))
    return list(found.values())


def find_responses(
    groups: Sequence[Group], folder: str | None, training: ResponseTraining, environment: EnvironmentInfo
) -> dict[str, Response]:
    """Identity -> best response that was trained in this way, for all members of some groups that have one.

    Raises:
        UserError: see `find_response` and `ResponseTraining.digest`.
    """
    settings, found = training.digest(environment), dict[str, Response]()
    for one in list_wanted(groups, folder):
        known = (find_response(place, one.player, training, settings) for place in one.folders)
        response = next((response for response in known if response is not None), None)
        if response is not None:
            found[one.player.identity or ""] = response
    return found


def count_others(
    groups: Sequence[Group], folder: str | None, training: ResponseTraining, environment: EnvironmentInfo
) -> int:
    """Number of best responses to members of some groups that lie there, but were trained in another way."""
    settings = training.digest(environment)
    return sum(
        path.parent.name != name_run(one.player, settings)
        for one in list_wanted(groups, folder)
        for place in one.folders
        for path in place.glob(f"{name_run(one.player, '')}*/population")
    )


def train_responses(
    groups: Sequence[Group],
    folder: str | None,
    training: ResponseTraining,
    environment: EnvironmentInfo,
    reporter: Reporter,
) -> int:
    """Train what is missing, one after the other; gives the number of those trained.

    Args:
        groups: of partners; users' agents and members without weights have no response.
        folder: where they go; None for the places beside the populations.
        training: how.
        environment: of all partners.
        reporter: told of progress.

    Raises:
        UserError: settings that do not exist, or a run that fails.
    """
    found, settings = find_responses(groups, folder, training, environment), training.digest(environment)
    missing = [one for one in list_wanted(groups, folder) if one.player.identity not in found]
    configs = [_plan_run(one, training, settings) for one in missing]
    for config in configs:
        train_ego(config, reporter)
    return len(configs)


def _plan_run(wanted: Wanted, training: ResponseTraining, settings: str) -> EgoRun:
    """A new run, or one that was interrupted as it began: beside whichever copy of the partner."""
    player, folder = wanted.player, wanted.folders[0]
    places = {"run.root": str(folder), "run.id": name_run(player, settings)}
    partner = f"{Path(player.source).resolve()}:{player.member}"
    chosen = {"tracking.enabled": False, **training.settings, **places}
    config = make_ego_config(_find_method(), [partner], chosen, scale=training.scale)
    run = folder / name_run(player, settings)
    if not (run / "config.json").exists():
        return config
    begun = _read_config(run)
    if _digest_training(begun) != settings:
        raise UserError(str(run), "was begun with other settings than those it is named after", _FIX)
    return begun.model_copy(update={"run": config.run, "cluster": config.cluster, "tracking": config.tracking})
