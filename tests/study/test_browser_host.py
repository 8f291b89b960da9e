"""Games that the browser plays, spoken to as the page does."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from study.study_folders import LAYOUTS, STEPS, Browser, make_small_study, served

from popgen.envs import make_env
from popgen.envs.overcooked import OvercookedEnv
from popgen.envs.overcooked.render import list_tiles
from popgen.errors import UserError
from popgen.humans.clone_policy import ClonePolicy, CloneSettings
from popgen.policies.portable_program import read_program
from popgen.policies.program_runner import ProgramRunner
from popgen.population import PopulationWriter
from popgen.study.browser_check import draw_transitions
from popgen.study.browser_kitchen import describe_kitchen
from popgen.study.hosted_game import HostedGame
from popgen.study.recording_check import check_recordings
from popgen.study.script_engine import find_engine, open_engine
from popgen.study.study_definition import Study
from popgen.study.study_folder import NamedMember, make_study
from popgen.study.study_server import StudyService
from popgen.study.study_tables import games, participants, ticks

ENV = OvercookedEnv("cramped_room", 1, horizon=20)
Row = list[Any]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return make_small_study(tmp_path_factory.mktemp("people"), host="browser")


@pytest.fixture(scope="module")
def server(study: Study) -> Iterator[tuple[StudyService, str]]:
    with served(study) as found:
        yield found


def fetch(browser: Browser, name: str) -> bytes:
    with browser._opener.open(f"http://{browser.address}/api/{name}", timeout=30) as answer:
        return answer.read()


def play_rows(browser: Browser, begun: dict[str, Any], key: str = "ArrowUp") -> list[Row]:
    """The rest of a game in the page's messages: north at each step."""
    facts = begun["begin"]
    game = HostedGame(ENV, ProgramRunner(read_program(fetch(browser, "partner")), 6), facts["seat"], facts["seed"])
    assert game.repeat(np.array(facts["actions"], np.uint8).reshape(-1, 2)) is None
    found = []
    while game.step < facts["steps"]:
        played = game.advance(0)
        found.append([game.step - 1, played.state.tobytes().hex(), *played.actions, 5, 7, [[key, 1, 2.5]]])
    return found


def send_rows(browser: Browser, rows: Callable[[dict[str, Any]], list[Row]], **given: Any) -> list[dict[str, Any]]:
    """Upload them one by one and hear until the last one is kept, or the game is over."""
    with browser.line() as line:
        begun = json.loads(line.recv(30))
        sent, heard = rows(begun), []
        for row in sent:
            line.send(json.dumps({"steps": [row], **given}))
        while not heard or not ("over" in heard[-1] or heard[-1]["kept"] > sent[-1][0]):
            heard.append(json.loads(line.recv(30)))
    return heard


def start_playing(address: str) -> Browser:
    browser = Browser(address)
    browser.pass_check()
    return browser


def read_ticks(service: StudyService, browser: Browser) -> list[Any]:
    with service.people.database.read() as connection:
        own = sa.select(participants.c.id).where(participants.c.code == browser.state()["code"])
        chosen = sa.select(ticks).join(games).where(games.c.participant.in_(own)).order_by(ticks.c.step)
        return list(connection.execute(chosen).all())


def test_an_uploaded_game_is_recorded_and_proven(server: tuple[StudyService, str], study: Study) -> None:
    service, address = server
    browser = start_playing(address)
    heard = send_rows(browser, lambda begun: play_rows(browser, begun), latency=12.5)
    assert heard[-1]["over"] == "finished" and browser.state()["place"] == 4
    kept = read_ticks(service, browser)
    assert [tick.step for tick in kept] == list(range(STEPS)) and {tick.action_0 for tick in kept} == {0}
    assert [(t.time_ms, t.late_us, t.latency_ms, t.keys) for t in kept[:1]] == [(5, 7, 12.5, '[["ArrowUp",1,2.5]]')]
    checked = check_recordings(study, service.people.database)
    assert checked and not [one for one in checked if one.problem]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda row: row[:3] + [(row[3] + 1) % 6] + row[4:],  # the ego's action
        lambda row: [row[0], "01" + row[1][2:], *row[2:]],  # the state
        lambda row: [row[0] + 1, *row[1:]],  # a step is left out
        lambda row: row[:2] + [9] + row[3:],  # no action
    ],
    ids=["ego", "state", "gap", "action"],
)
def test_what_was_not_played_so_is_refused(
    server: tuple[StudyService, str], study: Study, spoil: Callable[[Row], Row]
) -> None:
    service, address = server
    browser = start_playing(address)

    def spoilt(begun: dict[str, Any]) -> list[Row]:
        rows = play_rows(browser, begun)
        return [*rows[:4], spoil(rows[4])]

    assert send_rows(browser, spoilt)[-1] == {"over": "failed"}
    assert [tick.step for tick in read_ticks(service, browser)] == [0, 1, 2, 3]
    heard = send_rows(browser, lambda begun: play_rows(browser, begun))  # a reload goes on after the last good step
    assert heard[-1]["over"] == "finished" and len(read_ticks(service, browser)) == STEPS
    assert not [one for one in check_recordings(study, service.people.database) if one.problem]


def test_steps_sent_again_after_a_break_are_written_once(server: tuple[StudyService, str]) -> None:
    service, address = server
    browser = start_playing(address)
    rows: list[Row] = []
    assert send_rows(browser, lambda begun: rows.extend(play_rows(browser, begun)) or rows[:5])[-1] == {"kept": 5}
    with browser.line() as line:
        assert json.loads(line.recv(30))["begin"]["actions"] == [row[2:4] for row in rows[:5]]
    assert send_rows(browser, lambda _: rows[2:])[-1]["over"] == "finished"
    assert [tick.step for tick in read_ticks(service, browser)] == list(range(STEPS))


def test_without_a_key_the_game_is_void(tmp_path: Path) -> None:
    study = make_small_study(tmp_path, host="browser", warn_seconds=0.5, end_seconds=0.9)  # 6 steps
    with served(study) as (service, address):
        browser = start_playing(address)
        heard = send_rows(browser, lambda begun: [[*row[:6], []] for row in play_rows(browser, begun)])
        assert heard[-1]["over"] == "void" and len(read_ticks(service, browser)) == 6


def test_only_players_of_such_a_game_get_its_partner(server: tuple[StudyService, str], tmp_path: Path) -> None:
    browser = Browser(server[1])
    browser.post("session", {})
    for name in ("kitchen", "partner"):
        with pytest.raises(OSError, match="409"):  # no game is open
            fetch(browser, name)
        with pytest.raises(OSError, match="401"):
            fetch(Browser(server[1]), name)
    with served(make_small_study(tmp_path)) as (_, address):
        player = start_playing(address)
        player.play(until=2)
        with pytest.raises(OSError, match="409"):  # the server plays it
            fetch(player, "partner")


def test_egos_that_cannot_play_there_are_refused(tmp_path: Path) -> None:
    make_small_study(tmp_path)
    spec = make_env(f"overcooked/{LAYOUTS[0]}", 1, cooking="auto", horizon=20).spec
    writer = PopulationWriter(tmp_path / "clones", spec, method="xpm_wm", config_digest="0" * 64, seed=0)
    writer.add_member(ClonePolicy(spec, CloneSettings(units=8)), seed=1, steps={})
    egos = [NamedMember("A", str(tmp_path / LAYOUTS[0])), NamedMember("B", str(tmp_path / "clones"))]
    tutorial = NamedMember("tutorial", str(tmp_path / LAYOUTS[0]), 2)
    with pytest.raises(UserError, match="host: is browser, but member 1 of .*clones cannot play there: .*human_clone"):
        make_study(tmp_path / "other", egos, tutorial, {"host": "browser"})
    assert not (tmp_path / "other").exists()
    make_study(tmp_path / "other", egos, tutorial, {"host": "server"})


@pytest.mark.skipif(find_engine() is None, reason="needs Node or Chromium")
def test_the_page_draws_what_the_simulator_draws() -> None:
    env = OvercookedEnv("counter_circuit_o_1order", 1)
    told, states = describe_kitchen(env), draw_transitions(env, 40, np.random.default_rng(0)).states
    with open_engine() as engine:
        data = engine.run_task("tiles", {"kitchen": told}, states.tobytes())
    found = np.frombuffer(data, "<u2").reshape(len(states), env.layout.height, env.layout.width)
    pictures = list_tiles(env.kitchen).pictures
    for state, numbers in zip(states, found, strict=True):
        env.set_state(state[None])
        assert (pictures[numbers].swapaxes(1, 2).reshape(env.render_rgb(0).shape) == env.render_rgb(0)).all()
