from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.scripted import HORIZON, ONE, QUIT, TWO, Cast, Script

from popgen.cli import main
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.pages.game_recording import RecordedGame, draw_states, record_games
from popgen.pages.page_template import embed_json
from popgen.pages.replay_files import LAST_MILLISECONDS, STEP_MILLISECONDS, name_game, replay_page, to_replay, write_gif
from popgen.pages.tile_atlas import TILE, TileAtlas
from popgen.policies.simple_policies import RandomPolicy
from popgen.population import Population, PopulationWriter, load_population


@pytest.fixture(scope="module", params=["overcooked/cramped_room", "rendezvous/mppmr"])
def population(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Population:
    """Two random members with episodes of 20 steps."""
    path = tmp_path_factory.mktemp("population") / "two"
    spec = make_env(request.param, 1, horizon=20).spec
    writer = PopulationWriter(path, spec, method="xpm_wm", config_digest="0" * 64, seed=0)
    for member in (1, 2):
        writer.add_member(RandomPolicy(spec.num_actions), seed=member, steps={"SP": 100})
    return load_population(path)


@pytest.fixture(scope="module")
def games(population: Population) -> list[RecordedGame]:
    return record_games(population, [("1", "1"), ("1", "2"), ("2", "idle")], seed=5)


def put_together(replay: dict[str, Any], number: int) -> list[np.ndarray]:
    """The pictures of a game, from the JSON object alone."""
    data = base64.b64decode(replay["atlas"].partition(",")[2])
    atlas = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    rows, columns, across = replay["rows"], replay["columns"], replay["across"]
    tiles, pictures = np.zeros(rows * columns, int), []
    for changes in replay["games"][number]["frames"]:
        tiles[changes[::2]] = changes[1::2]
        picture = np.zeros((rows * TILE, columns * TILE, 3), np.uint8)
        for cell, tile in enumerate(tiles):
            (top, left), (y, x) = divmod(tile, across), divmod(cell, columns)
            part = atlas[top * TILE : (top + 1) * TILE, left * TILE : (left + 1) * TILE]
            picture[y * TILE : (y + 1) * TILE, x * TILE : (x + 1) * TILE] = part
        pictures.append(picture)
    return pictures


def test_a_recording_follows_the_simulator_and_is_the_seeds(population: Population, games: list[RecordedGame]) -> None:
    env = population.make_env()
    for game in games:
        following, batch = env.simulate(game.states[:-1], game.actions)
        assert (following == game.states[1:]).all() and np.allclose(batch.score, game.scores)
        assert (batch.events == game.events).all()
    again = record_games(population, [game.players for game in games], seed=5)
    assert all((a.states == b.states).all() for a, b in zip(games, again, strict=True))
    other = record_games(population, [game.players for game in games], seed=6)
    assert any(
        a.actions.shape != b.actions.shape or (a.actions != b.actions).any() for a, b in zip(games, other, strict=True)
    )
    assert [game.kind for game in games] == ["SP", "XP", "idle"]


def test_the_pictures_of_a_replay_are_the_environments(population: Population, games: list[RecordedGame]) -> None:
    env = population.make_env()
    replay = json.loads(json.dumps(to_replay(games, env)))
    for number, game in enumerate(games):
        drawn = draw_states(env, game.states)
        assert len(drawn) == game.steps + 1
        assert all((a == b).all() for a, b in zip(put_together(replay, number), drawn, strict=True))
        told = replay["games"][number]
        assert sum(gain for _, gain in told["gains"]) == pytest.approx(game.score, abs=0.01)
        assert len(told["happened"]) == np.count_nonzero(game.events)


def test_a_page_is_whole_and_an_animation_lasts_as_long_as_the_game(
    population: Population, games: list[RecordedGame], tmp_path: Path
) -> None:
    replay = to_replay(games[:2], population.make_env())
    page = replay_page(replay, title="a <b>", source="popgen play x")
    assert "a &lt;b&gt;" in page and page.count("<canvas") == 2 and 'type="range"' in page
    assert not re.search(r"""(src|href)=["'](?!#)|https?://""", page)
    held = re.search(r'<script type="application/json" id="replay">(.*?)</script>', page, re.DOTALL)
    assert held and json.loads(held[1]) == json.loads(json.dumps(replay))
    write_gif(games[0].cut(7), population.make_env(), tmp_path / "new" / "a.gif", scale=1)
    image = Image.open(tmp_path / "new" / "a.gif")
    height, width = population.make_env().render_rgb().shape[:2]
    times = [image.seek(frame) or image.info["duration"] for frame in range(image.n_frames)]
    assert image.size == (width, height) and sum(times) == 7 * STEP_MILLISECONDS + LAST_MILLISECONDS
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        write_gif(games[0], population.make_env(), tmp_path / "file" / "a.gif")


def test_figures_by_hand_and_an_episode_that_ends_early() -> None:
    cast: Any = Cast(Script([ONE], [TWO]), Script([ONE, QUIT]))
    whole, early = record_games(cast, [("1", "1"), ("2", "1")], 0)
    assert (whole.steps, whole.score) == (HORIZON, 21 * HORIZON)
    assert (early.steps, early.score) == (2, 21 + 20) and len(early.states) == 3
    assert whole.events.sum((0, 2)).tolist() == [HORIZON, HORIZON]


def test_players_that_are_not_there(random_population: Path) -> None:
    for players in (("1", "3"), ("0", "1"), ("x", "1"), ("-1", "1")):
        with pytest.raises(UserError, match="has no member"):
            record_games(load_population(random_population), [players], 0)
    with pytest.raises(UserError, match="nobody to watch"):
        record_games(load_population(random_population), [], 0)


def test_tiles_are_kept_once_and_odd_sizes_are_filled() -> None:
    atlas, picture = TileAtlas(), np.zeros((TILE, 3 * TILE + 1, 3), np.uint8)
    picture[:, TILE : 2 * TILE] = 9
    assert atlas.add(picture).tolist() == [0, 1, 0, 0] and len(atlas) == 2 and (atlas.rows, atlas.columns) == (1, 4)
    assert len(atlas.tile_urls(1)) == 1 and atlas.to_picture()[0, TILE].tolist() == [9, 9, 9]
    with pytest.raises(ValueError, match="1 x 4 tiles"):
        atlas.add(np.zeros((TILE, TILE, 3), np.uint8))


def test_text_cannot_leave_its_script() -> None:
    held = embed_json({"grid": "</script><!--", "x": float("nan")})
    assert "<" not in held and json.loads(held) == {"grid": "</script><!--", "x": None}
    assert name_game(("1", "1"), 11.0, "dishes") == "member 1 with itself: 11 dishes"
    assert name_game(("1", "idle"), -1.234, "reward") == "member 1 with idle partner: -1.23 reward"


def test_the_command_writes_a_page_and_an_animation(
    random_population: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["play", str(random_population), "--watch", "1", "random", "--json", "--steps", "5"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["players"] == ["1", "random"] and told["steps"] == 5
    assert told["files"] == {"html": f"{random_population.name}-1-random.html"}
    assert main(["play", str(random_population), "--gif", "a.gif", "--html", "b/b.html"]) == 0
    assert "member 1 with itself: 0 dishes in 20 steps (seed 0)" in capsys.readouterr().out
    assert {path.name for path in tmp_path.rglob("*.*")} == {
        f"{random_population.name}-1-random.html",
        "a.gif",
        "b.html",
    }
    assert main(["play", str(random_population), "--watch", "1", "9"]) == 2
    assert main(["play", str(random_population), "--html", "a.gif/b.html"]) == 2
    assert capsys.readouterr().err.count("popgen: error:") == 2
