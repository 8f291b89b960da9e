"""Small studies: two layouts, two random egos, an idle tutor, games of a few steps."""

from __future__ import annotations

import json
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from http.cookiejar import CookieJar
from pathlib import Path
from typing import Any

import uvicorn
from websockets.sync.client import ClientConnection, connect

from popgen.envs import make_env
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy
from popgen.population import PopulationWriter
from popgen.study.study_definition import Study
from popgen.study.study_folder import NamedMember, make_study
from popgen.study.study_messages import LARGEST_MESSAGE
from popgen.study.study_server import StudyServer, StudyService, open_service
from popgen.study.study_texts import BY_ITSELF

STEPS = 12
LAYOUTS = ("cramped_room", "coordination_ring")
CHECK = {"cooking": BY_ITSELF, "aim": "to deliver as many soups as possible together", "filling": "a dish"}


def make_small_study(folder: Path, **settings: Any) -> Study:
    """A study in `folder/study`."""
    for layout in LAYOUTS:
        spec = make_env(f"overcooked/{layout}", 1, cooking="auto", horizon=20).spec
        writer = PopulationWriter(folder / layout, spec, method="xpm_wm", config_digest="0" * 64, seed=0)
        for policy in (RandomPolicy(spec.num_actions), IdlePolicy(spec.action_names)):
            writer.add_member(policy, seed=1, steps={"SP": 1})
    egos = [NamedMember(name, str(folder / layout)) for name in ("A", "B") for layout in LAYOUTS]
    tutorial = NamedMember("tutorial", str(folder / LAYOUTS[0]), 2)
    return make_study(folder / "study", egos, tutorial, {"steps": STEPS, "tutorials": 1, "pairs": 1, **settings})


@contextmanager
def served(study: Study, speed: float = 0) -> Iterator[tuple[StudyService, str]]:
    """The study's server in this process, and its address."""
    service = open_service(study, speed=speed)
    listening = socket.create_server(("127.0.0.1", 0))
    app = StudyServer(service).build_app()
    config = uvicorn.Config(app, log_level="warning", access_log=False, lifespan="off", ws_max_size=4 * LARGEST_MESSAGE)
    running = uvicorn.Server(config)
    thread = threading.Thread(target=running.run, kwargs={"sockets": [listening]}, daemon=True)
    thread.start()
    yield service, f"127.0.0.1:{listening.getsockname()[1]}"
    running.should_exit = True
    thread.join(30)
    service.close()


class Browser:
    """What a browser keeps: cookies."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.jar = CookieJar()
        self._opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(self.jar))

    def state(self) -> dict[str, Any]:
        with self._opener.open(f"http://{self.address}/api/state", timeout=30) as answer:
            return json.load(answer)

    def post(self, name: str, body: Any, **headers: str) -> tuple[int, Any]:
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        given = {"Content-Type": "application/json", **headers}
        request = urllib.request.Request(f"http://{self.address}/api/{name}", data, given)
        try:
            with self._opener.open(request, timeout=30) as answer:
                return answer.status, json.load(answer)
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    @property
    def cookie(self) -> str:
        return "; ".join(f"{one.name}={one.value}" for one in self.jar)

    def line(self, **given: Any) -> ClientConnection:
        headers = {"Cookie": self.cookie}
        return connect(f"ws://{self.address}/api/game?pictures=0", additional_headers=headers, **given)

    def play(self, key: str = "ArrowUp", until: int | None = None) -> dict[str, Any]:
        """Play the game that is due to its end, or until a step; gives the last message."""
        with self.line() as line:
            told = json.loads(line.recv(30))
            line.send(json.dumps({"go": True, "ready": told["step"]}))
            while True:
                told = json.loads(line.recv(30))
                if "over" in told or (until is not None and told.get("step") == until):
                    return told
                if "step" not in told:  # a warning
                    continue
                line.send(json.dumps({"keys": [[key, 1, 1.5], [key, 0, 2]], "ready": told["step"]}))

    def pass_check(self) -> None:
        """From the beginning to the first game."""
        self.post("session", {})
        self.post("consent", {"agreed": True, "version": "1"})
        self.post("instructions", {})
        self.post("answers", {"form": "check", "answers": CHECK})

    def go_on(self) -> dict[str, Any]:
        """Do what is due, to the end; gives the last state."""
        while (state := self.state())["status"] == "active":
            if state["kind"] == "game":
                self.play()
            else:
                answers = {one["key"]: one["options"][0] for one in state["questions"]}
                self.post("answers", {"form": state["form"], "answers": answers})
        return state
