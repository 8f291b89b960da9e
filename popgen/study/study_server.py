"""The study's web server: pages, requests and the games' connections.

A participant is known by a random token in a cookie that scripts cannot read; the database holds its digest. Requests
must come from the page itself (origin), be small and be what `study_messages` describes. Addresses are neither stored
nor logged.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import secrets
import socket
from collections.abc import Awaitable, Callable, MutableMapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

from fastapi import FastAPI, Request, Response, WebSocket
from fastapi.responses import JSONResponse, PlainTextResponse
from pydantic import ValidationError
from starlette.websockets import WebSocketDisconnect

from popgen.envs.overcooked import OvercookedEnv
from popgen.pages.page_template import read_asset
from popgen.study import study_messages as messages
from popgen.study.browser_host import BrowserGameHost
from popgen.study.game_host import GameHost, Pace, ServerGameHost
from popgen.study.game_records import GameRecords, GameTicket, PartnerKey
from popgen.study.hosted_game import PartnerShelf, find_tutorial_layout, open_shelves
from popgen.study.participant_path import list_questions
from popgen.study.participant_records import ACTIVE, Participant, ParticipantRecords, Refused
from popgen.study.study_definition import Study
from popgen.study.study_tables import Database
from popgen.study.study_texts import list_instructions

COOKIE = "popgen_study"
SECRET = "secret.key"
MOST_MESSAGES = 60
"""Messages of a connection a second; simulated participants are not counted."""

_CLOSED = {"elsewhere": 4000, "replaced": 4001, "malformed": 4002, "too many": 4003, "failed": 4004}
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_SCRIPTS = ("study_page.js", "study_game.js", "browser_game.js", "kitchen_rules.js", "ego_network.js")
_log = logging.getLogger("popgen.study")
B = TypeVar("B", bound=messages.Body)
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]


@dataclass
class StudyService:
    """What the server serves.

    Attributes:
        study: its definition.
        people, records: its database.
        host: runs the games.
        shelves: everybody's partners.
        cooking: how pots start, for the instructions.
        accelerated: no limit on how fast a connection's messages come.
    """

    study: Study
    people: ParticipantRecords
    records: GameRecords
    host: GameHost
    shelves: dict[PartnerKey, PartnerShelf]
    cooking: str
    accelerated: bool = False

    def close(self) -> None:
        """Everything is recorded and closed."""
        self.host.stop()
        self.people.database.close()


def open_service(study: Study, *, speed: float = 1.0) -> StudyService:
    """Open the database and everybody's partners.

    Args:
        study: its definition.
        speed: times the real one; 0: each step is played as soon as the browser is ready for it.

    Raises:
        UserError: a population is missing or changed, or the database is of another study.
    """
    definition, shelves = study.definition, open_shelves(study)
    people = ParticipantRecords(study, Database(study.database, study), read_secret(study.folder))
    records = GameRecords(people, find_tutorial_layout(study), definition.step_milliseconds)
    seconds = definition.step_milliseconds / 1000
    pace = Pace(
        seconds / speed if speed else 0.0,
        warn_steps=max(1, round(definition.warn_seconds / seconds)),
        end_steps=max(2, round(definition.end_seconds / seconds)),
    )
    envs: list[OvercookedEnv] = [shelf.env for shelf in shelves.values()]
    for shelf in shelves.values():
        shelf.prepare()
    kind = BrowserGameHost if definition.host == "browser" else ServerGameHost
    host = kind(records, shelves, pace)
    return StudyService(study, people, records, host, shelves, envs[0].cooking, speed != 1.0)


def read_secret(folder: Path) -> bytes:
    """The study's secret, made once; only its owner can read the file."""
    path = folder / SECRET
    if not path.exists():
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "wb") as file:
            file.write(secrets.token_bytes(32))
    return path.read_bytes()


class StudyServer:
    """Routes of one study.

    Args:
        service: what is served.
        secure: cookies go over TLS only; set it behind a proxy with TLS.
    """

    def __init__(self, service: StudyService, *, secure: bool = False) -> None:
        self.service, self.secure = service, secure
        self.people = service.people
        self._lines: dict[int, GameLine] = {}

    def build_app(self) -> Any:
        """The ASGI application."""
        app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
        for path, (content, kind) in read_files().items():
            app.add_api_route(path, _serve_text(content, kind), response_model=None)
        app.add_api_route("/api/state", self.show_state, response_model=None)
        for name in ("kitchen", "partner"):
            app.add_api_route(f"/api/{name}", getattr(self, f"show_{name}"), response_model=None)
        for name in ("session", "consent", "instructions", "answers", "withdraw", "delete"):
            app.add_api_route(f"/api/{name}", getattr(self, f"post_{name}"), methods=["POST"], response_model=None)
        app.add_api_websocket_route("/api/game", self.play_game)
        app.add_exception_handler(Refused, _answer_refusal)
        app.add_exception_handler(ValidationError, _answer_malformed)
        return BoundedRequests(app)

    async def show_state(self, request: Request) -> Response:
        """Where the participant is, and what to show there."""
        who = await self._find(request)
        if who is None:
            return JSONResponse({"status": "new", "title": self.service.study.definition.title})
        return JSONResponse(self.describe_station(who))

    async def show_kitchen(self, request: Request) -> Response:
        """Rules and pictures of the participant's game, where the browser plays it."""
        shelf = await self._find_shelf(request)
        return JSONResponse(await asyncio.to_thread(shelf.pictures.describe))

    async def show_partner(self, request: Request) -> Response:
        """The partner of the participant's game as a program, where the browser plays it."""
        shelf = await self._find_shelf(request)
        return Response(shelf.file, media_type="application/octet-stream")

    async def _find_shelf(self, request: Request) -> PartnerShelf:
        key = await asyncio.to_thread(self.service.records.find_open, await self._need(request))
        if not self.service.shelves[key].file:
            raise Refused("elsewhere")
        return self.service.shelves[key]

    async def post_session(self, request: Request) -> Response:
        """Begin, unless this browser has begun."""
        body = await _read_body(request, messages.SessionBody)
        if await self._find(request) is not None:
            return _answer_moved()
        token = await asyncio.to_thread(self.people.begin_session, body.recruit)
        answer = _answer_moved()
        answer.set_cookie(COOKIE, token, max_age=7 * 86_400, httponly=True, samesite="strict", secure=self.secure)
        return answer

    async def post_consent(self, request: Request) -> Response:
        """Take part or not."""
        body = await _read_body(request, messages.ConsentBody)
        who = await self._need(request)
        await asyncio.to_thread(self.people.consent, who, agreed=body.agreed, version=body.version)
        return _answer_moved()

    async def post_instructions(self, request: Request) -> Response:
        """The instructions are read."""
        await _read_body(request, messages.EmptyBody)
        await asyncio.to_thread(self.people.read_instructions, await self._need(request))
        return _answer_moved()

    async def post_answers(self, request: Request) -> Response:
        """Answers to a form; a comprehension check that was not passed is shown again, after the instructions."""
        body = await _read_body(request, messages.AnswersBody)
        passed = await asyncio.to_thread(self.people.answer, await self._need(request), body.form, body.answers)
        return JSONResponse({"passed": passed})

    async def post_withdraw(self, request: Request) -> Response:
        """Stop, and have everything deleted if wished."""
        body = await _read_body(request, messages.WithdrawBody)
        who = await self._need(request)
        await self._hang_up(who.id, "elsewhere")
        if not body.delete:
            await asyncio.to_thread(self.people.withdraw, who)
            return _answer_moved()
        await asyncio.to_thread(self.people.delete, who.code)
        answer = _answer_moved()
        answer.delete_cookie(COOKIE)
        return answer

    async def post_delete(self, request: Request) -> Response:
        """Delete by the participant's code, from any browser."""
        body = await _read_body(request, messages.DeleteBody)
        return JSONResponse({"deleted": await asyncio.to_thread(self.people.delete, body.code)})

    async def play_game(self, connection: WebSocket) -> None:
        """The connection of a game; the newest one of a participant has it."""
        if not _is_own_page(connection):
            await connection.close(1008)
            return
        who = await asyncio.to_thread(self.people.find, connection.cookies.get(COOKIE))
        await connection.accept()
        if who is None:
            await connection.close(_CLOSED["elsewhere"])
            return
        await self._hang_up(who.id, "replaced")
        line = GameLine(self.service, connection)
        self._lines[who.id] = line
        try:
            await line.serve(who)
        finally:
            del self._lines[who.id]
            line.ended.set()

    async def _hang_up(self, participant: int, reason: str) -> None:
        """End the participant's present connection, with everything recorded."""
        while (line := self._lines.get(participant)) is not None:
            await line.end(reason)
            await line.ended.wait()

    async def _find(self, request: Request) -> Participant | None:
        return await asyncio.to_thread(self.people.find, request.cookies.get(COOKIE))

    async def _need(self, request: Request) -> Participant:
        who = await self._find(request)
        if who is None:
            raise Refused("unknown")
        return who

    def describe_station(self, who: Participant) -> dict[str, Any]:
        """What the page needs to show a participant's station."""
        definition, station = self.service.study.definition, who.station
        told: dict[str, Any] = {"title": definition.title, "status": who.status, "code": who.code}
        told |= {"kind": station.kind, "place": who.place, "places": len(self.people.stations) - 1}
        if who.status != ACTIVE:
            return told | {"completion": who.completion}
        if station.kind == "consent":
            told |= {"text": self.service.study.consent, "version": definition.consent_version}
        if station.kind in ("instructions", "check"):
            seconds = round(definition.steps * definition.step_milliseconds / 1000)
            told["instructions"] = list_instructions(self.service.cooking, seconds, definition.end_seconds)
        if questions := list_questions(definition, station):
            told["form"] = station.form
            told["questions"] = [question.model_dump(include={"key", "text", "options"}) for question in questions]
        if station.kind == "game":
            told |= _describe_game(station.number, definition.tutorials)
            told["step_ms"] = definition.step_milliseconds
        return told


def _describe_game(number: int, tutorials: int) -> dict[str, Any]:
    pair, position = divmod(number - tutorials, 2)
    if number < tutorials:
        return {"practice": True, "number": number + 1, "of": tutorials}
    return {"practice": False, "pair": pair + 1, "position": position + 1}


class GameLine:
    """One game's connection.

    Args:
        service: of the study.
        connection: accepted.
    """

    def __init__(self, service: StudyService, connection: WebSocket) -> None:
        self.ended = asyncio.Event()
        self._service, self._connection = service, connection
        self._told: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._reason: str | None = None
        self._tasks: list[asyncio.Task[None]] = []

    async def serve(self, who: Participant) -> None:
        """Until the game is over or one side hangs up."""
        loop = asyncio.get_running_loop()

        def tell(told: dict[str, Any]) -> None:
            with suppress(RuntimeError):  # gone already
                loop.call_soon_threadsafe(self._told.put_nowait, told)

        try:
            fresh = await asyncio.to_thread(self._service.records.open_game, who)
            ticket, place = fresh.ticket, fresh.place
        except Refused:
            await self._close(_CLOSED["elsewhere"])
            return
        pictures = self._connection.query_params.get("pictures") != "0"
        try:
            await asyncio.to_thread(self._service.host.open, ticket, place, tell, pictures=pictures)
            self._tasks = [asyncio.create_task(part) for part in (self._send(), self._receive(who, ticket))]
            if self._reason is None:
                await asyncio.wait(self._tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
        except ValueError:
            _log.exception("game %d cannot be opened", ticket.id)
            self._reason = "failed"
        finally:
            await asyncio.to_thread(self._service.host.close, ticket.id)
        await self._close(_CLOSED.get(self._reason or "", 1000))

    async def end(self, reason: str) -> None:
        """Hang up."""
        self._reason = self._reason or reason
        for task in self._tasks:
            task.cancel()

    async def _send(self) -> None:
        while True:
            told = await self._told.get()
            await self._connection.send_text(json.dumps(told, separators=(",", ":")))
            if "over" in told:
                return

    async def _receive(self, who: Participant, ticket: GameTicket) -> None:
        loop, count, since, seen = asyncio.get_running_loop(), 0, 0.0, 0.0
        while True:
            try:
                message = messages.read_game_message(await self._connection.receive_text())
            except (WebSocketDisconnect, KeyError, RuntimeError):  # gone, or bytes where text is due
                return
            now = loop.time()
            count, since = (1, now) if now - since > 1 else (count + 1, since)
            if message is None or (count > MOST_MESSAGES and not self._service.accelerated):
                self._reason = "malformed" if message is None else "too many"
                return
            self._service.host.receive(ticket.id, message)
            if now - seen > 20:
                seen = now
                await asyncio.to_thread(self._service.people.touch, who.id)

    async def _close(self, code: int) -> None:
        with suppress(RuntimeError, WebSocketDisconnect):  # gone already
            await self._connection.close(code)


class BoundedRequests:
    """ASGI: bodies are bounded, requests that change something come from our own page, every answer has our headers.

    Args:
        app: what answers.
    """

    def __init__(self, app: Any) -> None:
        self._app = app

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        answer = None
        if request.method not in ("GET", "HEAD"):
            if not _is_own_page(request):
                answer = PlainTextResponse("refused", 403)
            body = await _collect_body(receive) if answer is None else b""
            if body is None:
                answer = PlainTextResponse("too large", 413)
            receive = _replay_body(body or b"", receive)
        await (answer or self._app)(scope, receive, _add_headers(send))


async def _collect_body(receive: Receive) -> bytes | None:
    """The whole body, None for one that is too large."""
    body = b""
    while True:
        part = await receive()
        if part["type"] == "http.disconnect":
            return body
        body += part.get("body", b"")
        if len(body) > messages.LARGEST_BODY:
            return None
        if not part.get("more_body"):
            return body


def _replay_body(body: bytes, receive: Receive) -> Receive:
    told = [{"type": "http.request", "body": body, "more_body": False}]

    async def receive_again() -> MutableMapping[str, Any]:
        return told.pop() if told else await receive()

    return receive_again


def _add_headers(send: Send) -> Send:
    extra = [(name.lower().encode(), value.encode()) for name, value in _HEADERS.items()]

    async def send_with_headers(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message.get("headers", ()), *extra]}
        await send(message)

    return send_with_headers


def _is_own_page(request: Request | WebSocket) -> bool:
    """No browser sent it from a page of another site."""
    origin = request.headers.get("origin")
    return origin is None or (urlsplit(origin).netloc == request.headers.get("host") and "://" in origin)


async def _read_body(request: Request, kind: type[B]) -> B:
    """Raises: Refused, ValidationError."""
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise Refused("json")
    return kind.model_validate_json(await request.body())


def _answer_moved() -> Response:
    return JSONResponse({"ok": True})


async def _answer_refusal(_: Request, error: Exception) -> Response:
    assert isinstance(error, Refused)
    return JSONResponse({"refused": error.reason}, 401 if error.reason == "unknown" else 409)


async def _answer_malformed(_: Request, error: Exception) -> Response:
    return JSONResponse({"refused": "malformed"}, 422)


def read_files() -> dict[str, tuple[str, str]]:
    """Path -> content and type of all that is served as it is."""
    here = files("popgen.study") / "assets"
    own = {name: (here / name).read_text(encoding="utf-8") for name in ("study.html", "study.css", *_SCRIPTS)}
    script = "text/javascript; charset=utf-8"
    return {
        "/": (own["study.html"], "text/html; charset=utf-8"),
        "/study.css": (read_asset("pages.css") + own["study.css"], "text/css; charset=utf-8"),
        **{f"/{name}": (own[name], script) for name in _SCRIPTS},
    }


def _serve_text(content: str, kind: str) -> Callable[[], Awaitable[Response]]:
    async def serve() -> Response:
        return Response(content, media_type=kind)

    return serve


def serve_study(server: StudyServer, listening: socket.socket) -> None:
    """Serve until interrupted; everything that was played is recorded then.

    Args:
        server: of the study.
        listening: a bound socket.
    """
    import uvicorn

    config = uvicorn.Config(
        server.build_app(),
        log_level="warning",
        access_log=False,  # it would hold addresses
        server_header=False,
        proxy_headers=False,
        ws_max_size=messages.LARGEST_MESSAGE * 4,
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=3,
        lifespan="off",
    )
    uvicorn.Server(config).run(sockets=[listening])
