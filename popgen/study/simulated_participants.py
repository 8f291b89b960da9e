"""Simulated participants: policies take part through the real requests and connections, as a browser does.

A participant draws one member for each layout, from populations of that layout, and keeps it; it reads the state from
the game's messages, presses the key of its member's action and lets it go at once.
"""

from __future__ import annotations

import asyncio
import json
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from http.cookiejar import CookieJar
from typing import Any

import numpy as np
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException

from popgen.envs.overcooked import OvercookedEnv
from popgen.errors import UserError
from popgen.pages.live_game import KEYS
from popgen.play.policy import Policy
from popgen.policies.simple_policies import RandomPolicy
from popgen.population.store import Population
from popgen.study.hosted_game import open_shelves
from popgen.study.study_definition import Study, check_kitchen, find_layout

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
        shelves = open_shelves(study)
        self._envs: dict[str, OvercookedEnv] = {layout: shelf.env for (layout, _), shelf in shelves.items()}
        self._members: dict[str, list[tuple[Population, int]]] = {}
        for population in populations:
            layout = find_layout(population)
            same = layout in self._envs and check_kitchen(population).spec.views == self._envs[layout].spec.views
            if not same:
                fix = f"give populations of {', '.join(sorted(self._envs))}"
                raise UserError(str(population.path), f"plays {layout}, which is not this study's", fix)
            found = self._members.setdefault(layout, [])
            found += [(population, member) for member in range(1, len(population) + 1)]

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
    shown: dict[int, int] = field(default_factory=dict)


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
            await self._call("answers", {"form": state["form"], "answers": self._answer(state["questions"])})
        return False

    def _answer(self, questions: Sequence[Mapping[str, Any]]) -> dict[str, str]:
        right = {question.key: question.answer for question in self._study.definition.check}
        drawn = {one["key"]: str(self._rng.choice(one["options"])) for one in questions}
        return {key: right.get(key) or value for key, value in drawn.items()}

    async def _call(self, name: str, body: Any = None) -> dict[str, Any]:
        return await asyncio.to_thread(self._send_request, name, body)

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
        self._note_break(facts["number"], step)
        env, policy = self._casting.env(facts["layout"]), self._load_policy(facts["layout"])
        policy.reset(1, int(self._rng.integers(2**31)))
        previous, first = np.zeros((1, 2), np.uint8), True
        codes = {number: KEYS[name] for number, name in enumerate(env.spec.action_names) if name in KEYS}
        told = begun
        await line.send(json.dumps({"go": True}))
        while "over" not in told:
            if "state" in told:
                self.visit.shown[facts["number"]] = told["step"]
                obs = env.encode(np.array(told["state"], np.uint8)[None], policy.view)
                previous = np.array(policy.act(obs, previous, np.array([first])), np.uint8)
                first = False
                await line.send(json.dumps(press_key(codes.get(int(previous[0, facts["seat"]])), told["step"])))
            told = json.loads(await line.recv())
            self.visit.steps += "state" in told
        self.visit.games += 1

    def _load_policy(self, layout: str) -> Policy:
        if layout not in self._policies:
            self._policies[layout] = self._casting.draw(layout, self._rng)
        return self._policies[layout]

    def _note_break(self, number: int, step: int) -> None:
        """Steps that were shown before and are not recorded."""
        shown = self.visit.shown.get(number, 0) if step else self.visit.shown.pop(number, 0)
        self.visit.lost = max(self.visit.lost, shown - step)


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
