"""Human proxies: clones chosen by how they play, and the populations that hold them.

Half A, the recorded train games, makes partners for training; half B, the test games, makes partners that are held
out. A proxy of one half has seen no game of the other.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from popgen.durable_files import name_folder
from popgen.errors import UserError
from popgen.humans.behaviour import (
    MEASURES,
    Agreement,
    Rates,
    compare_rates,
    measure_people,
    measure_policies,
    team_dishes,
)
from popgen.humans.clone_policy import ClonePolicy, CloneSettings
from popgen.humans.cloning import CloneTraining, change_settings, fit_clone, negative_log_likelihood
from popgen.humans.recordings import FILES, LAYOUTS, HumanGame, load_games, make_human_env
from popgen.population import PopulationWriter

HALVES = {"A": "train", "B": "test"}
"""Name of a proxy's half -> of the recordings."""

METHOD = "human_clone"

PATIENCE, LONGEST_STAY = (0, 1, 2), (0, 4, 8, 16)
TEMPERATURES, STAY_BIASES = (1.0, 0.8, 0.6, 0.35), (-0.5, 0.0, 0.5, 1.0)
"""What the first search draws from."""


@dataclass(frozen=True)
class ProxySearch:
    """How a proxy is chosen.

    Attributes:
        drawn: candidates of the first search.
        rounds: searches around the best one.
        episodes, final_episodes: of play for each candidate, and for the figures that are kept.
        likelihood_weight: how much a nat of likelihood counts against a squared standard deviation of the rates.
        dishes_weight: of the dishes among the rates, all others having 1: the outcome that partners live by.
    """

    drawn: int = 40
    rounds: int = 3
    episodes: int = 24
    final_episodes: int = 120
    likelihood_weight: float = 0.25
    dishes_weight: float = 6.0


@dataclass(frozen=True)
class Proxy:
    """A chosen clone and its figures.

    Attributes:
        policy: the clone.
        people, clone: rates of the people it was fitted to, and its own in play with itself.
        likelihood: negative log-likelihood of the validation game by the policy, in nats.
        network_likelihood: the same by the network alone, before the settings.
        cost: what the choice made small.
    """

    policy: ClonePolicy
    people: Rates
    clone: Rates
    likelihood: float
    network_likelihood: float
    cost: float

    @property
    def agreement(self) -> Agreement:
        """With the people it was fitted to."""
        return compare_rates(self.people, self.clone)


def fit_proxy(
    games: Sequence[HumanGame], seed: int, training: CloneTraining, search: ProxySearch, settings: CloneSettings
) -> Proxy:
    """Fit a network to one layout's games of one half and choose how it acts; the same seed gives the same proxy.

    The last game is kept from the fit, for the likelihood. Accuracy decides nothing: always to stay is hard to beat.

    Raises:
        ValueError: fewer than two games.
    """
    if len(games) < 2:
        raise ValueError(f"a proxy needs two games at least, got {len(games)}")
    network = fit_clone(games[:-1], settings, training, seed)
    chooser = _Chooser(network, games, search, seed)
    best = chooser.choose()
    return chooser.rate(best, search.final_episodes)


class _Chooser:
    """Searches the settings of one network."""

    def __init__(self, network: ClonePolicy, games: Sequence[HumanGame], search: ProxySearch, seed: int) -> None:
        self._network, self._games, self._search, self._seed = network, games, search, seed
        self._layout, self._spec = games[0].layout, make_human_env(games[0].layout).spec
        self._people = measure_people(games)
        self._base = negative_log_likelihood(network, games[-1:])
        self._rng = np.random.default_rng(seed)

    def choose(self) -> CloneSettings:
        """The settings of the least cost: drawn ones first, then the neighbours of the best."""
        grid = list(itertools.product(PATIENCE, LONGEST_STAY, TEMPERATURES, STAY_BIASES))
        drawn = self._rng.permutation(len(grid))[: self._search.drawn]
        best = self._best_of([self._settings(*grid[number]) for number in drawn])
        for _ in range(self._search.rounds):
            best = self._best_of([best, *self._neighbours(best)])
        return best

    def rate(self, settings: CloneSettings, episodes: int) -> Proxy:
        """The proxy that acts by `settings`, with its figures."""
        policy = change_settings(self._network, self._spec, settings)
        clone = measure_policies([policy], self._layout, episodes, self._seed)
        likelihood = negative_log_likelihood(policy, self._games[-1:])
        distances = np.minimum(compare_rates(self._people, clone).distances, 3.0) ** 2
        weights = np.where([name.startswith("dishes") for name in MEASURES], self._search.dishes_weight, 1.0)
        cost = float(np.average(distances, weights=weights))
        cost += self._search.likelihood_weight * (likelihood - self._base)
        return Proxy(policy, self._people, clone, likelihood, self._base, cost)

    def _best_of(self, candidates: Sequence[CloneSettings]) -> CloneSettings:
        costs = [self.rate(settings, self._search.episodes).cost for settings in candidates]
        return candidates[int(np.argmin(costs))]

    def _settings(self, patience: int, longest_stay: int, temperature: float, stay_bias: float) -> CloneSettings:
        return CloneSettings(patience=patience, longest_stay=longest_stay, temperature=temperature, stay_bias=stay_bias)

    def _neighbours(self, best: CloneSettings) -> list[CloneSettings]:
        """Four small steps each of temperature and bias, drawn, and the other rules against standing still."""
        steps = self._rng.normal(size=(5, 2)) * (0.25, 0.25)
        near = [
            replace(
                best,
                temperature=float(np.clip(best.temperature * np.exp(step[0]), 0.1, 1.5)),
                stay_bias=float(best.stay_bias + step[1]),
            )
            for step in steps
        ]
        patience = int(self._rng.choice([choice for choice in PATIENCE if choice != best.patience]))
        longest = int(self._rng.choice([choice for choice in LONGEST_STAY if choice != best.longest_stay]))
        return [*near, replace(best, patience=patience), replace(best, longest_stay=longest)]


def fit_population(
    path: str | Path,
    layout: str,
    half: str,
    *,
    seed: int = 0,
    members: int = 1,
    training: CloneTraining | None = None,
    search: ProxySearch | None = None,
    games: Sequence[HumanGame] | None = None,
    tell: Callable[[float], None] = lambda share: None,
) -> list[Proxy]:
    """Fit the proxies of one layout and half, and write them as a population, which is there once it is whole.

    Args:
        path: the population's folder, which must not hold one.
        layout: a name of LAYOUTS.
        half: `A` or `B`.
        seed: of the first member; the others follow.
        members: proxies that differ in their seed only.
        training, search: how to fit and to choose.
        games: of the layout and half, if they are loaded already.
        tell: called with the share that is done.

    Raises:
        UserError: unknown layout or half, missing recordings, or a folder that cannot be written.
    """
    if layout not in LAYOUTS or half not in HALVES:
        wanted = f"{', '.join(LAYOUTS)} and A or B"
        raise UserError("layout, half", f"no people are recorded for {layout!r}, {half!r}", f"choose of {wanted}")
    training, search, settings = training or CloneTraining(), search or ProxySearch(), CloneSettings()
    games = load_games([HALVES[half]], [layout]) if games is None else games
    provenance = _describe_source(games, half, training, search)
    spec, unfinished = make_human_env(layout).spec, _make_unfinished(Path(path))
    writer = PopulationWriter(unfinished, spec, method=METHOD, config_digest=_digest_facts(provenance), seed=seed)
    proxies = []
    for number in range(members):
        proxy = fit_proxy(games, seed + number, training, search, settings)
        extra = {**provenance, **_describe_figures(proxy)}
        writer.add_member(proxy.policy, seed=seed + number, steps={}, extra=extra)
        proxies.append(proxy)
        tell((number + 1) / members)
    name_folder(unfinished, Path(path))
    return proxies


def _make_unfinished(path: Path) -> Path:
    """An empty folder beside `path`, which is given its name at the end; what was broken off is begun anew.

    Raises:
        UserError: `path` is taken.
    """
    if path.exists() and any(path.iterdir()):
        raise UserError(str(path), "exists already", "choose another folder, or remove it to fit anew")
    unfinished = path.with_name(f".{path.name}")
    shutil.rmtree(unfinished, ignore_errors=True)
    return unfinished


def fit_missing_population(
    root: Path, layout: str, half: str, *, seed: int = 0, search: ProxySearch | None = None
) -> Path:
    """The population of this layout, half, seed and search under `root`, fitted where it is not there; its folder's
    name tells them apart."""
    games = load_games([HALVES[half]], [layout])
    facts = _describe_source(games, half, CloneTraining(), search or ProxySearch())
    path = root / f"{layout}_{half}-s{seed}-{_digest_facts(facts)[:8]}"
    if not path.is_dir():
        fit_population(path, layout, half, seed=seed, search=search, games=games)
    return path


def _describe_source(
    games: Sequence[HumanGame], half: str, training: CloneTraining, search: ProxySearch
) -> dict[str, object]:
    file = FILES[HALVES[half]]
    return {
        "layout": games[0].layout,
        "half": half,
        "recordings": {"file": file.name, "sha256": file.sha256},
        "games": [game.pair for game in games],
        "validation_game": games[-1].pair,
        "joint_steps": sum(game.steps for game in games),
        "training": asdict(training),
        "search": asdict(search),
    }


def _digest_facts(facts: dict[str, object]) -> str:
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _describe_figures(proxy: Proxy) -> dict[str, object]:
    return {
        "measures": list(MEASURES),
        "people": {"mean": proxy.people.mean.tolist(), "deviation": proxy.people.deviation.tolist()},
        "clone": {"mean": proxy.clone.mean.tolist(), "deviation": proxy.clone.deviation.tolist()},
        "dishes": team_dishes(proxy.clone),
        "likelihood": proxy.likelihood,
        "network_likelihood": proxy.network_likelihood,
        "within": proxy.agreement.within,
    }
