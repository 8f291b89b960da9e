"""Simulated participants: policies take part through the real requests and connections, as a browser does.

A participant draws one member for each layout, from populations of that layout, and keeps it; it reads the state from
the game's messages, presses the key of its member's action and lets it go at once.
"""

from __future__ import annotations

import asyncio
import json
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from http.cookiejar import CookieJar
from typing import Any

import numpy as np
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, WebSocketException

from popgen.envs.overcooked import OvercookedEnv
from popgen.errors import UserError
from popgen.pages.live_game import KEYS
from popgen.play.policy import Policy
from popgen.policies.portable_program import read_program
from popgen.policies.program_runner import ProgramRunner
from popgen.policies.simple_policies import RandomPolicy
from popgen.population.store import Population
from popgen.study.hosted_game import HostedGame, open_shelves
from popgen.study.study_definition import Study, check_kitchen, find_layout
from popgen.study.study_messages import MOST_STEPS

SIMULATED_AHEAD = 40
"""Steps that a simulated participant plays before they are recorded, where no time is kept."""

RETRY_SECONDS = 0.3
MOST_RETRIES = 400


class Casting:
    """Who plays a participant in each layout.

    Args:
        study: its layouts.
        populations: members of them play in their own layout; where there are none, keys are pressed at random.

    Raises:
        UserError: a population of a layout that the study does not have.
    """

    def __init__(self, study: Study, populations: Sequence[Population]) -> None:
        self._shelves = open_shelves(study)
        self._envs: dict[str, OvercookedEnv] = {layout: shelf.env for (layout, _), shelf in self._shelves.items()}
        self._members: dict[str, list[tuple[Population, int]]] = {}
        for population in populations:
            layout = find_layout(population)
            same = layout in self._envs and check_kitchen(population).spec.views == self._envs[layout].spec.views
            if not same:
                fix = f"give populations of {', '.join(sorted(self._envs))}"
                raise UserError(str(population.path), f"plays {layout}, which is not this study's", fix)
            found = self._members.setdefault(layout, [])
            found += [(population, member) for member in range(1, len(population) + 1)]

    def warm_up(self) -> None:
        """Play a step with each member: what is compiled or read at the first use would make others' steps late."""
        for (layout, _), shelf in self._shelves.items():
            game, policy = HostedGame(shelf.env, shelf.take(), 0, 0), self.draw(layout, np.random.default_rng(0))
            game.advance(0)
            policy.reset(1, 0)
            policy.act(game.env.encode(game.state[None], policy.view), np.zeros((1, 2), np.uint8), np.array([True]))

    def env(self, layout: str) -> OvercookedEnv:
        """The layout's environment, to be asked only."""
        return self._envs[layout]

    def draw(self, layout: str, rng: np.random.Generator) -> Policy:
        """A member for a layout."""
        members = self._members.get(layout)
        if not members:
            return RandomPolicy(self._envs[layout].spec.num_actions)
        population, member = members[int(rng.integers(len(members)))]
        return population[member]


@dataclass
class Visit:
    """What one participant went through.

    Attributes:
        status: at the end; `active` where it stopped after as many games as were asked for.
        games: played to their end.
        steps: seen.
        breaks: connections that broke off.
        lost: steps that had been shown and were gone after a break, the most at once.
    """

    status: str = "active"
    games: int = 0
    steps: int = 0
    breaks: int = 0
    lost: int = 0
    shown: dict[tuple[int, int | None], int] = field(default_factory=dict)


class SimulatedParticipant:
    """One participant.

    Args:
        address: HOST:PORT of the server.
        study: for the right answers of the comprehension check.
        casting: who plays.
        seed: of all its draws.
        most_games: it stops after so many; None: at the end of the study.
    """

    def __init__(self, address: str, study: Study, casting: Casting, seed: int, most_games: int | None = None) -> None:
        self.visit = Visit()
        self._address, self._study, self._casting, self._most = address, study, casting, most_games
        self._rng = np.random.default_rng(seed)
        self._jar = CookieJar()
        self._opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(self._jar))
        self._policies: dict[str, Policy] = {}

    async def take_part(self) -> Visit:
        """From consent to the end; what breaks off is tried again, as a browser would.

        Raises:
            UserError: the server does not come back.
        """
        failures = 0
        while failures < MOST_RETRIES:
            try:
                if await self._do_next():
                    return self.visit
                failures = 0
            except (OSError, WebSocketException, TimeoutError):  # URLError is an OSError
                failures += 1
                await asyncio.sleep(RETRY_SECONDS)
        raise UserError(self._address, "the server does not answer any more", "see what it printed")

    async def _do_next(self) -> bool:
        """Do what is due; whether that was the end."""
        state = await self._call("state")
        kind = state.get("kind")
        if state["status"] == "new":
            await self._call("session", {})
        elif state["status"] != "active":
            self.visit.status = state["status"]
            return True
        elif kind == "consent":
            await self._call("consent", {"agreed": True, "version": state["version"]})
        elif kind == "instructions":
            await self._call("instructions", {})
        elif kind == "game":
            if self.visit.games == self._most:
                return True
            await self._play()
        else:
            await self._call("answers", {"form": state["form"], "answers": self._answer_questions(state["questions"])})
        return False

    def _answer_questions(self, questions: Sequence[Mapping[str, Any]]) -> dict[str, str]:
        right = {question.key: question.answer for question in self._study.definition.check}
        drawn = {one["key"]: str(self._rng.choice(one["options"])) for one in questions}
        return {key: right.get(key) or value for key, value in drawn.items()}

    async def _call(self, name: str, body: Any = None) -> dict[str, Any]:
        return await asyncio.to_thread(self._send_request, name, body)

    def _fetch_file(self, name: str) -> bytes:
        with self._opener.open(f"http://{self._address}/api/{name}", timeout=60) as answer:
            return answer.read()

    def _send_request(self, name: str, body: Any) -> dict[str, Any]:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(
            f"http://{self._address}/api/{name}", data, {"Content-Type": "application/json"}
        )
        with self._opener.open(request, timeout=60) as answer:
            return json.load(answer)

    async def _play(self) -> None:
        cookie = "; ".join(f"{one.name}={one.value}" for one in self._jar)
        address = f"ws://{self._address}/api/game?pictures=0"
        try:
            async with connect(address, additional_headers={"Cookie": cookie}, compression=None) as line:
                await self._play_on(line)
        except (OSError, WebSocketException):
            self.visit.breaks += 1
            raise

    async def _play_on(self, line: Any) -> None:
        begun = json.loads(await line.recv())
        facts, step = begun["begin"], begun["step"]
        self._note_break(name_game(facts), step)
        if facts.get("host") == "browser":
            await self._play_here(line, facts)
            self._end_game(name_game(facts))
            return
        env, policy = self._casting.env(facts["layout"]), self._load_policy(facts["layout"])
        policy.reset(1, int(self._rng.integers(2**31)))
        previous, first = np.zeros((1, 2), np.uint8), True
        codes = {number: KEYS[name] for number, name in enumerate(env.spec.action_names) if name in KEYS}
        told = begun
        await line.send(json.dumps({"go": True}))
        while "over" not in told:
            if "state" in told:
                self.visit.shown[name_game(facts)] = told["step"]
                obs = env.encode(np.array(told["state"], np.uint8)[None], policy.view)
                previous = np.array(policy.act(obs, previous, np.array([first])), np.uint8)
                first = False
                pressed = press_key(codes.get(int(previous[0, facts["seat"]])), told["step"])
                with suppress(ConnectionClosed):  # where the game is over, what was told before is still to be heard
                    await line.send(json.dumps(pressed))
            told = json.loads(await line.recv())
            self.visit.steps += "state" in told
        self._end_game(name_game(facts))

    def _end_game(self, name: tuple[int, int | None]) -> None:
        """A void game begins anew under its number: nothing of it is lost by that."""
        self.visit.games += 1
        self.visit.shown.pop(name, None)

    async def _play_here(self, line: Any, facts: Mapping[str, Any]) -> None:
        """A game whose rules and partner run on this side, as in a browser; in real time where the study has any."""
        env, policy = self._casting.env(facts["layout"]), await asyncio.to_thread(self._load_policy, facts["layout"])
        held = await asyncio.to_thread(self._fetch_file, "partner")
        partner = await asyncio.to_thread(lambda: ProgramRunner(read_program(held), env.spec.num_actions))
        game = HostedGame(env, partner, facts["seat"], facts["seed"])
        if game.repeat(np.array(facts["actions"], np.uint8).reshape(-1, 2)) is not None:
            raise UserError(self._address, "sent a game that its partner does not play so", "report it")
        policy.reset(1, int(self._rng.integers(2**31)))
        played = PlayedHere(line, game, policy, facts, self.visit)
        await played.play_on()

    def _load_policy(self, layout: str) -> Policy:
        if layout not in self._policies:
            self._policies[layout] = self._casting.draw(layout, self._rng)
        return self._policies[layout]

    def _note_break(self, name: tuple[int, int | None], step: int) -> None:
        """Steps that were shown before and are not recorded."""
        shown = self.visit.shown.get(name, 0) if step else self.visit.shown.pop(name, 0)
        self.visit.lost = max(self.visit.lost, shown - step)


class PlayedHere:
    """A game that a simulated participant plays by itself and sends step by step.

    Args:
        line: to the server.
        game: where it stands.
        policy: of the participant.
        facts: what the server told of the game.
        visit: gets what is shown.
    """

    def __init__(self, line: Any, game: HostedGame, policy: Policy, facts: Mapping[str, Any], visit: Visit) -> None:
        self._line, self._game, self._policy, self._facts, self._visit = line, game, policy, facts, visit
        names = game.env.spec.action_names
        self._codes = {number: KEYS[name] for number, name in enumerate(names) if name in KEYS}
        self._kept, self._over = game.step, False
        self._batch: list[list[Any]] = []
        self._previous = np.zeros((1, 2), np.uint8)

    async def play_on(self) -> None:
        """To the end, never more than a second's steps ahead of what is recorded."""
        first, period = self._game.step, self._facts["step_ms"] / 1000
        began = time.monotonic()
        size = 2 if period else MOST_STEPS
        ahead = max(size, int(1 / period)) if period else SIMULATED_AHEAD
        await self._line.send(json.dumps({"go": True}))
        while not self._over and self._game.step < self._facts["steps"]:
            due = began + (self._game.step - first + 1) * period
            if period:
                await asyncio.sleep(max(0.0, due - time.monotonic()))
            self._play_step(max(0.0, time.monotonic() - due) if period else 0.0, self._game.step == first, began)
            if len(self._batch) >= size:
                await self._send_batch()
            while self._game.step - self._kept > ahead and not self._over:
                await self._hear_server()
        await self._send_batch()
        while not self._over:
            await self._hear_server()

    def _play_step(self, late: float, first: bool, began: float) -> None:
        game, seat = self._game, self._facts["seat"]
        obs = game.env.encode(game.state[None], self._policy.view)
        chosen = np.array(self._policy.act(obs, self._previous, np.array([first])), np.uint8)
        played = game.advance(int(chosen[0, seat]))
        self._previous = np.array([played.actions], np.uint8)
        code = self._codes.get(played.actions[seat])
        keys = [[code, 1, 0], [code, 0, 0]] if code else []
        since = self._facts["elapsed_ms"] + int((time.monotonic() - began) * 1000)
        row = [game.step - 1, played.state.tobytes().hex(), *played.actions, since, int(late * 1e6), keys]
        self._batch.append(row)
        self._visit.steps += 1
        self._visit.shown[name_game(self._facts)] = game.step

    async def _send_batch(self) -> None:
        if self._batch:
            await self._line.send(json.dumps({"steps": self._batch}, separators=(",", ":")))
            self._batch = []

    async def _hear_server(self) -> None:
        told = json.loads(await self._line.recv())
        self._kept = told.get("kept", self._kept)
        self._over = self._over or "over" in told


def name_game(facts: Mapping[str, Any]) -> tuple[int, int | None]:
    """What tells a game from the void one whose number it has: in the browser the seed of its partner."""
    return facts["number"], facts.get("seed")


def press_key(code: str | None, step: int) -> dict[str, Any]:
    """A message: the key goes down and up, then the step may be played; None presses nothing."""
    told: dict[str, Any] = {"ready": step}
    if step % 4 == 0 and step:
        told["seen"] = step
    if code is not None:
        told["keys"] = [[code, 1, 0], [code, 0, 0]]
    return told


async def simulate_people(
    people: Sequence[SimulatedParticipant], together: int, told: Callable[[int], None] = lambda done: None
) -> list[Visit]:
    """All of them, so many at once.

    Args:
        people: to take part.
        together: at once.
        told: gets how many are through.
    """
    asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(together))
    places, done = asyncio.Semaphore(together), 0

    async def visit(one: SimulatedParticipant) -> Visit:
        nonlocal done
        async with places:
            found = await one.take_part()
        done += 1
        told(done)
        return found

    return list(await asyncio.gather(*(visit(one) for one in people)))
