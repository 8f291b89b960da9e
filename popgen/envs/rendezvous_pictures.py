"""Rendezvous as text and as a picture."""

from __future__ import annotations

import numpy as np

from popgen.envs.drawing import canvas, disc, rectangle


def draw_map(players: np.ndarray, landmarks: np.ndarray, bounds: float, figures: str) -> str:
    """31 columns by 15 rows (L landmark, 0 and 1 players, 8 both), and a line of figures; positions are (..., 2)."""
    rows, columns = 15, 31
    grid = [["."] * columns for _ in range(rows)]
    for mark, (x, y) in [("L", point) for point in landmarks] + [(str(p), players[p]) for p in range(2)]:
        row = round((1.0 - np.clip(y / bounds, -1, 1)) / 2.0 * (rows - 1))
        column = round((1.0 + np.clip(x / bounds, -1, 1)) / 2.0 * (columns - 1))
        grid[row][column] = "8" if grid[row][column] == "0" else mark
    places = "  ".join(f"player {p} ({x:+.2f}, {y:+.2f})" for p, (x, y) in enumerate(players))
    return "\n".join(["".join(line) for line in grid] + [f"{figures}  {places}"])


def draw_picture(players: np.ndarray, landmarks: np.ndarray, bounds: float) -> np.ndarray:
    """(256, 256, 3) uint8, y upwards: grey landmarks, a blue player 0, a smaller vermilion player 1 with a dot.

    The two differ in brightness, size and shape, not in hue alone.
    """
    size, edge = 256, 16
    picture = canvas(size, size, (90, 90, 90))
    rectangle(picture, edge, edge, size - 2 * edge, size - 2 * edge, (250, 250, 250))
    pixels = (size - 2 * edge) / (2.0 * bounds)
    marks = [(point, 10, (160, 160, 160)) for point in landmarks]
    marks += [(players[0], 8, (0, 114, 178)), (players[1], 6, (213, 94, 0)), (players[1], 2, (255, 255, 255))]
    for (x, y), radius, colour in marks:
        disc(picture, size / 2 - y * pixels, size / 2 + x * pixels, radius, colour)
    return picture
