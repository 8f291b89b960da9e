"""Painting on (H, W, 3) uint8 pictures with numpy alone; pixel (0, 0) is the upper left corner."""

from __future__ import annotations

import numpy as np

Colour = tuple[int, int, int]


def canvas(height: int, width: int, colour: Colour) -> np.ndarray:
    """A new picture (height, width, 3) of one colour."""
    return np.full((height, width, 3), colour, dtype=np.uint8)


def rectangle(picture: np.ndarray, top: float, left: float, height: float, width: float, colour: Colour) -> None:
    """Fill a rectangle, in pixels, in place; what lies outside the picture is cut off."""
    y0, x0 = max(round(top), 0), max(round(left), 0)
    y1, x1 = max(round(top + height), 0), max(round(left + width), 0)
    picture[y0:y1, x0:x1] = colour


def disc(picture: np.ndarray, row: float, column: float, radius: float, colour: Colour) -> None:
    """Fill a disc around (row, column), in pixels, in place; what lies outside the picture is cut off."""
    rows, columns = np.ogrid[: picture.shape[0], : picture.shape[1]]
    picture[(rows - row) ** 2 + (columns - column) ** 2 <= radius**2] = colour
