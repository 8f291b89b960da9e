"""A small local server: the page of a game, the game over a websocket, and its replay.

The page sends `{"start": {"partner": "2", "seat": 0}}`, then `{"press": "ArrowUp"}` and `{"release": "ArrowUp"}`; the
server answers with `LiveGame.describe` at each step. Steps are due at fixed times of a monotonic clock, 150 ms apart;
the partner acts in a thread, so that a slow one never holds up the connection. Nothing is written to disk.
"""

from __future__ import annotations

import asyncio
import json
import socket
import time
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

from popgen.errors import UserError
from popgen.evaluation.crossplay import PARTNERS
from popgen.pages.live_game import KEYS, Keyboard, LiveGame, Pairing
from popgen.pages.page_template import fill_page
from popgen.pages.replay_files import STEP_MILLISECONDS, name_game, replay_page, to_replay
from popgen.population.store import Population

LARGEST_MESSAGE = 1024
"""Bytes of a message that is read."""

_REFUSED = 1008  # of websockets: policy violation
_MALFORMED = 1003


class GameServer:
    """Games of one population.

    Args:
        population: to play with.
        partner: at first; the page can choose another one.
        seat: of the person at first.
        seed: of the first game; each further one has the next.
        period: seconds of a step.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        population: Population,
        *,
        partner: str = "1",
        seat: int = 0,
        seed: int = 0,
        period: float = STEP_MILLISECONDS / 1000,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.population, self.period, self.clock = population, period, clock
        self._first = Pairing(partner, seat, seed)
        self._seed = seed
        self._last: LiveGame | None = None

    def prepare(self) -> None:
        """Load and compile all that the first step needs; raises UserError for a partner that is not there."""
        game = LiveGame(self.population, self._first)
        game.advance(game.idle_action)

    def build_app(self) -> Any:
        """The FastAPI application."""
        from fastapi import FastAPI, WebSocket
        from fastapi.responses import HTMLResponse

        app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

        async def show_page() -> HTMLResponse:
            return HTMLResponse(self.make_page())

        async def show_replay() -> HTMLResponse:
            page = await asyncio.to_thread(self.make_replay)
            return HTMLResponse(page or "no game was played yet", 200 if page else 404)

        async def play_game(connection: WebSocket) -> None:
            await self.serve_socket(connection)

        # Annotations are text here, which FastAPI would look up among this module's names.
        play_game.__annotations__["connection"] = WebSocket
        app.add_api_route("/", show_page, response_class=HTMLResponse, response_model=None)
        app.add_api_route("/replay", show_replay, response_class=HTMLResponse, response_model=None)
        app.add_api_websocket_route("/game", play_game)
        return app

    def make_page(self) -> str:
        """The page that plays."""
        spec, population = self.population.spec, self.population
        keys = {KEYS[name]: name for name in spec.action_names if name in KEYS}
        partners = [*(str(member) for member in range(1, len(population) + 1)), *PARTNERS]
        return fill_page(
            "live_game.html.jinja",
            title=f"{spec.name}: play with a member",
            scripts=("live_game.js",),
            data={"settings": {"keys": list(keys), "unit": spec.score_name}},
            keys=keys,
            partners=partners,
            chosen=self._first,
            seconds=round(spec.horizon * self.period),
            milliseconds=round(self.period * 1000),
        )

    def make_replay(self) -> str | None:
        """The last game that was played, None before the first step."""
        game = self._last
        if game is None:
            return None
        recording = game.to_recording()
        title = name_game(recording.players, recording.score, self.population.spec.score_name)
        replay = to_replay([recording], self.population.make_env())
        return replay_page(replay, title=title, source=f"{self.population.spec.name}, played in this browser")

    async def serve_socket(self, connection: Any) -> None:
        """One page: games one after another, until it goes away or sends what is no message."""
        from fastapi import WebSocketDisconnect

        origin = urlsplit(connection.headers.get("origin", "")).netloc
        if origin and origin != connection.headers.get("host"):  # a page of another site
            await connection.close(_REFUSED)
            return
        await connection.accept()
        task: asyncio.Task[None] | None = None
        keyboard = Keyboard(0)
        try:
            while True:
                message = read_message(await connection.receive_text())
                if message is None:
                    await connection.close(_MALFORMED)
                    return
                if "start" in message:
                    await _stop_task(task)
                    game = await asyncio.to_thread(self._open_game, message["start"])
                    keyboard = Keyboard(game.idle_action)
                    task = asyncio.create_task(self.run_game(connection, game, keyboard))
                else:
                    _turn_key(keyboard, self.population.spec.action_names, message)
        except WebSocketDisconnect:
            return
        except UserError as error:
            await connection.close(_REFUSED, str(error)[:100])
        finally:
            await _stop_task(task)

    async def run_game(self, connection: Any, game: LiveGame, keyboard: Keyboard) -> None:
        """Steps at fixed times; one that takes longer than its time moves all later ones, so that none is hurried."""
        await connection.send_text(json.dumps(await asyncio.to_thread(game.describe)))
        due = self.clock() + self.period
        while not game.over:
            await asyncio.sleep(max(0.0, due - self.clock()))
            told = await asyncio.to_thread(game.advance, keyboard.take_action())
            self._last = game
            await connection.send_text(json.dumps(told))
            due = max(due, self.clock() - self.period) + self.period

    def _open_game(self, wanted: Any) -> LiveGame:
        partner, seat = (wanted.get("partner"), wanted.get("seat")) if isinstance(wanted, dict) else (None, None)
        if not isinstance(partner, str) or seat not in (0, 1) or isinstance(seat, bool):
            raise UserError("start", "needs a partner and a seat", "reload the page")
        game = LiveGame(self.population, Pairing(partner, seat, self._seed))
        self._seed += 1
        return game


def read_message(text: str) -> dict[str, Any] | None:
    """One of the module's messages, None for anything else."""
    if len(text) > LARGEST_MESSAGE:
        return None
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        return None
    known = isinstance(message, dict) and len(message) == 1 and set(message) <= {"start", "press", "release"}
    return message if known else None


def _turn_key(keyboard: Keyboard, names: tuple[str, ...], message: dict[str, Any]) -> None:
    """Press or release; keys without a meaning in this environment are ignored."""
    (what, code) = next(iter(message.items()))
    action = next((n for n, name in enumerate(names) if KEYS.get(name) == code), None)
    if action is not None:
        (keyboard.press if what == "press" else keyboard.release)(action)


async def _stop_task(task: asyncio.Task[None] | None) -> None:
    if task is not None:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def open_listening_socket(host: str, port: int) -> socket.socket:
    """A bound socket; port 0 takes a free one.

    Raises:
        UserError: there is no such host or port, or the port is taken, or not ours to take.
    """
    listening = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
    except OverflowError:
        listening.close()
        raise UserError("--port", f"there is no port {port}", "choose one from 0 to 65535") from None
    except OSError as error:
        listening.close()
        field = "--host" if isinstance(error, socket.gaierror) else "--port"
        raise UserError(field, f"cannot listen at {host}:{port} ({error.strerror})", "choose another one") from None
    return listening


def serve_games(server: GameServer, host: str, port: int, tell: Callable[[str], None]) -> None:
    """Serve until interrupted.

    Args:
        server: prepared.
        host, port: where to listen; port 0 takes a free one.
        tell: gets the address once.

    Raises:
        UserError: the port is taken, or not ours to take.
    """
    import uvicorn

    listening = open_listening_socket(host, port)
    tell(f"http://{f'[{host}]' if ':' in host else host}:{listening.getsockname()[1]}")
    config = uvicorn.Config(server.build_app(), log_level="warning", ws_max_size=LARGEST_MESSAGE, lifespan="off")
    uvicorn.Server(config).run(sockets=[listening])
