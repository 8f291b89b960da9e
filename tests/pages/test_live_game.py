from __future__ import annotations

import json
import socket
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import uvicorn
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from popgen.cli import main
from popgen.errors import UserError
from popgen.pages.game_server import LARGEST_MESSAGE, GameServer, read_message
from popgen.pages.live_game import Keyboard, LiveGame, Pairing
from popgen.population import Population, load_population

STAY = 4


@pytest.fixture(scope="module")
def population(random_population: Path) -> Population:
    return load_population(random_population)


@pytest.fixture(scope="module")
def address(population: Population) -> Iterator[str]:
    """A server whose steps are due every millisecond."""
    listening = socket.create_server(("127.0.0.1", 0))
    server = GameServer(population, period=0.001)
    config = uvicorn.Config(server.build_app(), log_level="warning", lifespan="off", ws_max_size=LARGEST_MESSAGE)
    running = uvicorn.Server(config)
    thread = threading.Thread(target=running.run, kwargs={"sockets": [listening]}, daemon=True)
    thread.start()
    yield f"127.0.0.1:{listening.getsockname()[1]}"
    running.should_exit = True
    thread.join(30)


def read_game(connection: Any) -> list[dict[str, Any]]:
    """Everything that the server tells until the game is over."""
    told = [json.loads(connection.recv(30))]
    while not told[-1]["over"]:
        told.append(json.loads(connection.recv(30)))
    return told


def test_a_key_counts_once_and_as_long_as_it_is_held() -> None:
    keyboard = Keyboard(STAY)
    assert keyboard.take_action() == STAY
    keyboard.press(0)
    keyboard.release(0)  # shorter than a step
    assert [keyboard.take_action(), keyboard.take_action()] == [0, STAY]
    keyboard.press(0)
    keyboard.press(2)
    keyboard.press(0)  # the browser repeats
    assert [keyboard.take_action(), keyboard.take_action()] == [2, 2]
    keyboard.release(2)
    keyboard.release(3)
    assert keyboard.take_action() == 0
    keyboard.press(5)
    assert [keyboard.take_action(), keyboard.release(5), keyboard.take_action()] == [5, None, 0]


@pytest.mark.parametrize("seat", [0, 1])
def test_a_game_is_the_simulators_and_the_seeds(population: Population, seat: int) -> None:
    actions = np.random.default_rng(0).integers(0, 6, population.spec.horizon)
    games = [LiveGame(population, Pairing("2", seat, seed)) for seed in (3, 3, 4)]
    told = [[game.advance(int(action)) for action in actions] for game in games]
    assert told[0] == told[1] and games[0].over and told[0][-1]["step"] == len(actions)
    recording, same, other = (game.to_recording() for game in games)
    assert recording.actions[:, seat].tolist() == actions.tolist() and (recording.actions == same.actions).all()
    assert (recording.actions != other.actions).any()
    following, batch = population.make_env().simulate(recording.states[:-1], recording.actions)
    assert (following == recording.states[1:]).all() and batch.score.sum() == recording.score
    assert recording.players == (("you", "2") if seat == 0 else ("2", "you"))
    with pytest.raises(ValueError, match="over"):
        games[0].advance(0)
    with pytest.raises(ValueError, match="no action"):
        LiveGame(population, Pairing("1", 0, 0)).advance(6)
    with pytest.raises(UserError, match="no member"):
        LiveGame(population, Pairing("3", 0, 0))


def test_a_page_plays_over_the_websocket_and_watches_again(address: str) -> None:
    with urllib.request.urlopen(f"http://{address}/") as answer:
        page = answer.read().decode()
    assert "ArrowUp" in page and "member 2" in page and "https://" not in page
    with connect(f"ws://{address}/game") as connection:
        connection.send(json.dumps({"start": {"partner": "idle", "seat": 1}}))
        connection.send(json.dumps({"press": "ArrowUp"}))
        told = read_game(connection)
        assert [one["step"] for one in told] == list(range(21)) and told[0]["rows"] * told[0]["columns"] == 20
        assert len(told[0]["cells"]) == 40 and told[0]["tiles"] and told[5]["actions"] == ["stay", "north"]
        connection.send(json.dumps({"start": {"partner": "2", "seat": 0}}))  # another one at once
        assert len(read_game(connection)) == 21
    with urllib.request.urlopen(f"http://{address}/replay") as answer:
        assert "you with member 2" in answer.read().decode()


@pytest.mark.parametrize(
    "text",
    [
        *("", "x", "[]", "{}", '{"a": 1}', '{"press": 1, "start": 2}', "[" * 1000, '{"start": {}}', '{"start": 7}'),
        *('{"start": {"partner": "9", "seat": 0}}', '{"start": {"partner": "1", "seat": true}}', '{"start": null}'),
    ],
)
def test_malformed_messages_end_the_connection_and_nothing_else(address: str, text: str) -> None:
    with connect(f"ws://{address}/game") as connection:
        connection.send(text)
        with pytest.raises(ConnectionClosed):
            connection.recv(30)


def test_odd_keys_are_ignored_and_large_messages_and_other_sites_refused(address: str) -> None:
    with connect(f"ws://{address}/game") as connection:
        for message in ({"press": "KeyQ"}, {"release": ["x"]}, {"press": None}):
            connection.send(json.dumps(message))
        connection.send(json.dumps({"start": {"partner": "1", "seat": 0}}))
        assert read_game(connection)[-1]["over"]
        connection.send("x" * (LARGEST_MESSAGE + 1))
        with pytest.raises(ConnectionClosed):
            connection.recv(30)
    with pytest.raises(InvalidStatus), connect(f"ws://{address}/game", origin="http://elsewhere.example"):
        pass
    assert read_message('{"press": "x"}') == {"press": "x"} and read_message("x" * 2000) is None


def test_steps_are_due_at_fixed_times_and_a_late_one_hurries_none(population: Population) -> None:
    import asyncio

    now, slept = [0.0], []

    class Recorder:
        async def send_text(self, text: str) -> None:
            now[0] += 0.4 if json.loads(text)["step"] == 3 else 0.01  # the third step takes too long

    wait = asyncio.sleep

    async def sleep(seconds: float) -> None:
        if threading.current_thread() is not threading.main_thread():  # the server of other tests
            return await wait(seconds)
        slept.append(round(seconds, 3))
        now[0] += seconds

    server = GameServer(population, period=0.1, clock=lambda: now[0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("popgen.pages.game_server.asyncio.sleep", sleep)
        asyncio.run(server.run_game(Recorder(), LiveGame(population, Pairing("1", 0, 0)), Keyboard(STAY)))
    assert slept[:6] == [0.1, 0.09, 0.09, 0.0, 0.09, 0.09]


def test_a_port_that_is_taken_and_a_partner_that_is_not_there(
    random_population: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["play", str(random_population), "--port", port]) == 2
    assert main(["play", str(random_population), "--partner", "7"]) == 2
    assert capsys.readouterr().err.count("popgen: error:") == 2
