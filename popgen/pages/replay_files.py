"""Recorded games as JSON, as a page with a slider and as a GIF.

Keys of the JSON object (`to_replay`):

    format, format_version   "popgen-replay", 1
    environment              name and params
    unit                     of the score, such as dishes
    actions, events          names
    tile, rows, columns      side of a tile in pixels; tiles of a picture
    atlas, across            all tiles as a PNG in a data: URL, so many in a row
    games                    list: players (labels by seat), kind (SP, XP, random, idle, itself), seed, score; frames,
                             T + 1 lists of cell, tile, cell, tile, ... that differ from the frame before; actions, a
                             list for each seat; gains, lists of step and what it added to the score; happened, lists of
                             step, seat and event
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.errors import UserError
from popgen.evaluation.crossplay import PARTNERS
from popgen.pages.game_recording import RecordedGame, draw_states
from popgen.pages.page_template import fill_page
from popgen.pages.tile_atlas import TILE, TileAtlas, to_data_url

STEP_MILLISECONDS = 150
"""Time of a step in the game as people play it."""

LAST_MILLISECONDS = 1500
"""Of the last picture of an animation."""


def to_replay(games: Sequence[RecordedGame], env: BatchedEnv) -> dict[str, Any]:
    """The JSON object of the module's docstring.

    Args:
        games: of one environment.
        env: draws them; the state of its first row is overwritten.
    """
    atlas = TileAtlas()
    described = [_describe_game(game, env, atlas) for game in games]
    return {
        "format": "popgen-replay",
        "format_version": 1,
        "environment": {"name": env.spec.name, "params": env.spec.params},
        "unit": env.spec.score_name,
        "actions": list(env.spec.action_names),
        "events": list(env.spec.event_names),
        "tile": TILE,
        "rows": atlas.rows,
        "columns": atlas.columns,
        "atlas": to_data_url(atlas.to_picture()),
        "across": atlas.across,
        "games": described,
    }


def _describe_game(game: RecordedGame, env: BatchedEnv, atlas: TileAtlas) -> dict[str, Any]:
    frames: list[list[int]] = []
    before: np.ndarray | None = None
    for picture in draw_states(env, game.states):
        numbers = atlas.add(picture)
        changed = np.arange(len(numbers)) if before is None else np.flatnonzero(numbers != before)
        frames.append([int(value) for cell in changed for value in (cell, numbers[cell])])
        before = numbers
    gains = np.flatnonzero(game.scores)
    return {
        "players": list(game.players),
        "kind": game.kind,
        "seed": game.seed,
        "score": round(game.score, 4),
        "frames": frames,
        "actions": game.actions.T.tolist(),
        "gains": [[int(step) + 1, round(float(game.scores[step]), 4)] for step in gains],
        "happened": [[int(step) + 1, int(seat), int(event)] for step, seat, event in np.argwhere(game.events)],
    }


def name_player(label: str) -> str:
    """A label as people read it."""
    if label in PARTNERS:
        return f"{label} partner"
    return f"member {label}" if label.isdecimal() else label


def name_game(players: Sequence[str], score: float, unit: str) -> str:
    """One game in a line."""
    first, second = players
    told = f"{score:g} {unit}" if abs(score) >= 10 or score == round(score) else f"{score:.2f} {unit}"
    who = f"{name_player(first)} with itself" if first == second else f"{name_player(first)} with {name_player(second)}"
    return f"{who}: {told}"


def replay_page(replay: dict[str, Any], *, title: str, source: str) -> str:
    """A self-contained page: the games of `to_replay` under one slider, side by side.

    Args:
        replay: of `to_replay`.
        title: of the page.
        source: where the games come from: population, method, seed and command, in one line.
    """
    return fill_page(
        "replay.html.jinja",
        title=title,
        scripts=("replay_player.js",),
        data={"replay": replay},
        source=source,
        stage=stage_of(replay, list(range(len(replay["games"])))),
    )


def stage_of(replay: dict[str, Any], chosen: Sequence[int]) -> dict[str, Any]:
    """What the template `replay_stage` needs: the games to choose from, and the ones shown at first."""
    games = [name_game(game["players"], game["score"], replay["unit"]) for game in replay["games"]]
    last = max((len(replay["games"][number]["frames"]) - 1 for number in chosen), default=0)
    return {"games": games, "chosen": list(chosen), "last": last, "milliseconds": STEP_MILLISECONDS}


def write_gif(
    game: RecordedGame, env: BatchedEnv, path: Path, *, scale: int = 2, milliseconds: int = STEP_MILLISECONDS
) -> None:
    """An animation of a game, one picture a step.

    Args:
        game: to show.
        env: draws it; the state of its first row is overwritten.
        path: of the file.
        scale: pixels of the file for each one of a picture.
        milliseconds: of a step.

    Raises:
        UserError: the file cannot be written.
    """
    from PIL import Image

    images = []
    atlas, pictures = TileAtlas(), draw_states(env, game.states)
    for picture in pictures:
        atlas.add(picture)
    palette = Image.fromarray(atlas.to_picture()).quantize(256, dither=Image.Dither.NONE)
    for picture in pictures:
        image = Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        images.append(image.resize((image.width * scale, image.height * scale), Image.Resampling.NEAREST))
    times = [milliseconds] * (len(images) - 1) + [LAST_MILLISECONDS]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "wb") as file:
            images[0].save(file, "GIF", save_all=True, append_images=images[1:], duration=times, loop=0, optimize=False)
    except OSError as error:
        raise UserError(str(path), f"cannot be written: {error.strerror}", "choose another place") from error
