"""One game of a person with an ego, step by step: no clock, no connection, no files.

The ego acts alone (a batch of one) with a generator of its own. Stacking the egos of several games into one product of
matrices would be faster, but changes the last bits of its result, and with them now and then an action: a recording
would no longer be proven by playing it again. Where games run in the browser, an ego is its program, here as there.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from popgen.envs.overcooked import OvercookedEnv
from popgen.errors import UserError
from popgen.pages.tile_atlas import TileAtlas
from popgen.play.policy import Policy
from popgen.policies.portable_program import Program
from popgen.policies.program_runner import ProgramRunner
from popgen.population.store import Population
from popgen.study.browser_kitchen import describe_kitchen
from popgen.study.study_definition import Ego, Study, check_kitchen, find_layout, find_program

PLAYERS = 2


@dataclass(frozen=True)
class PlayedStep:
    """What a step was.

    Attributes:
        state: (S,) before it.
        actions: of both players.
        score: what it added.
    """

    state: np.ndarray
    actions: tuple[int, int]
    score: float


class Partner(Protocol):
    """An ego in one seat: `PolicyPartner` or `ProgramRunner`."""

    view: str

    def begin(self, seat: int, seed: int) -> None:
        """A fresh game."""

    def act(self, obs: np.ndarray, previous: np.ndarray, *, first: bool) -> int:
        """The action on both players' views (2, *shape) after the joint action `previous` (2,)."""
        ...


class PolicyPartner:
    """A policy as a partner.

    Args:
        policy: of this partner alone.
    """

    def __init__(self, policy: Policy) -> None:
        self.view, self._policy, self._seat = policy.view, policy, 0

    def begin(self, seat: int, seed: int) -> None:
        """See `Partner`."""
        self._seat = seat
        self._policy.reset(1, seed)

    def act(self, obs: np.ndarray, previous: np.ndarray, *, first: bool) -> int:
        """See `Partner`."""
        return int(self._policy.act(obs[None], previous[None], np.array([first]))[0, self._seat])


class HostedGame:
    """The exact simulator with one ego.

    Args:
        env: of the layout; only asked, so that games may share it.
        partner: the ego, of this game alone.
        seat: of the person.
        seed: of the ego's generator.
    """

    def __init__(self, env: OvercookedEnv, partner: Partner, seat: int, seed: int) -> None:
        self.env, self.seat = env, seat
        self._partner = partner
        partner.begin(1 - seat, seed)
        self.state = env.kitchen.start.copy()
        self.step, self.score = 0, 0.0
        self._actions = np.zeros((1, PLAYERS), np.uint8)

    def advance(self, own: int) -> PlayedStep:
        """The person plays `own`, the ego answers the same state."""
        before, actions = self.state, np.empty((1, PLAYERS), np.uint8)
        actions[0, 1 - self.seat] = self._ask_ego()
        actions[0, self.seat] = own
        self._actions = actions
        following, result = self.env.simulate(before[None], self._actions)
        self.state, self.step = following[0], self.step + 1
        gained = float(result.score[0])
        self.score += gained
        return PlayedStep(before, (int(self._actions[0, 0]), int(self._actions[0, 1])), gained)

    def repeat(self, recorded: np.ndarray) -> int | None:
        """Play recorded joint actions (T, 2) again, the person's as they are and the ego's anew.

        Returns:
            The first step at which the ego acts otherwise than recorded, None where it never does. The game then
            stands before that step.
        """
        for number, actions in enumerate(recorded):
            kept = self.state, self.step, self.score
            played = self.advance(int(actions[self.seat]))
            if played.actions != tuple(int(action) for action in actions):
                self.state, self.step, self.score = kept
                return number
        return None

    def _ask_ego(self) -> int:
        """The ego's action in the present state."""
        obs = self.env.encode(self.state[None], self._partner.view)[0]
        return self._partner.act(obs, self._actions[0], first=self.step == 0)


class KitchenPictures:
    """A layout's pictures as numbers of tiles, shared by all its games: each tile is encoded once.

    Args:
        env: of the layout; its first row is overwritten.
    """

    def __init__(self, env: OvercookedEnv) -> None:
        self._env, self._atlas = env, TileAtlas()
        self._urls: list[str] = []
        self._described: list[dict[str, Any]] = []
        self._lock = threading.Lock()

    def draw(self, state: np.ndarray) -> np.ndarray:
        """Numbers (cells,) of the tiles, row by row."""
        with self._lock:
            self._env.set_state(state[None])
            return self._atlas.add(self._env.render_rgb(0))

    def url(self, number: int) -> str:
        """The `data:` URL of a tile."""
        with self._lock:
            if number >= len(self._urls):
                self._urls += self._atlas.tile_urls(len(self._urls))
            return self._urls[number]

    def describe(self) -> dict[str, Any]:
        """Rules and tiles for a browser that draws by itself."""
        with self._lock:
            if not self._described:
                self._described.append(describe_kitchen(self._env))
            return self._described[0]

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of a picture."""
        return self._env.layout.height, self._env.layout.width


class PartnerShelf:
    """The egos of a study, each read and checked once; every game gets a policy of its own.

    Args:
        population: of the ego.
        member: its number.
        env: of its layout.
        pictures: of its layout, shared with the other egos there.
        program: it acts by its program, as it does in the browser.
    """

    def __init__(
        self,
        population: Population,
        member: int,
        env: OvercookedEnv,
        pictures: KitchenPictures,
        program: Program | None = None,
    ) -> None:
        self.env, self.pictures = env, pictures
        self._population, self._member, self._program = population, member, program
        self._file = b"" if program is None else program.to_bytes()
        self._spare: list[Partner] = []
        self._lock = threading.Lock()

    @property
    def file(self) -> bytes:
        """The program as a file; empty without one."""
        return self._file

    def prepare(self) -> None:
        """Load and compile all that the first step needs, so that no game waits for it."""
        partner = self.take()
        HostedGame(self.env, partner, 0, 0).advance(0)
        self.give_back(partner)

    def take(self) -> Partner:
        """A partner that no other game uses."""
        with self._lock:
            return self._spare.pop() if self._spare else self._make_partner()

    def give_back(self, partner: Partner) -> None:
        """It may serve another game, which begins anew with it."""
        with self._lock:
            self._spare.append(partner)

    def _make_partner(self) -> Partner:
        if self._program is None:
            return PolicyPartner(self._population[self._member])
        return ProgramRunner(self._program, self.env.spec.num_actions)


def open_shelves(study: Study) -> dict[tuple[str, str | None], PartnerShelf]:
    """All partners of a study: by layout and ego, None for the tutorial's.

    Raises:
        UserError: a population is missing, has other weights, plays shorter games than the study's, or cannot play in
            the browser where the study's games run there.
    """
    definition, shelves = study.definition, dict[tuple[str, str | None], PartnerShelf]()
    kitchens: dict[str, tuple[OvercookedEnv, KitchenPictures]] = {}

    def add(layout: str, name: str | None, ego: Ego) -> None:
        population = study.open_population(ego)
        env = check_kitchen(population)
        if definition.steps > env.horizon:
            problem = f"is {definition.steps}, {population.path} plays {env.horizon} steps"
            raise UserError("steps", problem, "make the games shorter")
        known = kitchens.setdefault(population.env_info.fingerprint, (env, KitchenPictures(check_kitchen(population))))
        program = find_program(population, ego.member) if definition.host == "browser" else None
        shelves[layout, name] = PartnerShelf(population, ego.member, *known, program)

    add(find_tutorial_layout(study), None, definition.tutorial)
    for name, members in definition.egos.items():
        for layout, ego in members.items():
            add(layout, name, ego)
    return shelves


def find_tutorial_layout(study: Study) -> str:
    """Name of the layout that the tutorials are played in."""
    return find_layout(study.open_population(study.definition.tutorial))
