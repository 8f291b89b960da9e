"""Pictures as tiles: each distinct tile is kept once, and a frame is the numbers of its tiles."""

from __future__ import annotations

import base64
import io

import numpy as np

TILE = 32
"""Pixels of a tile's side; Overcooked's cells have this size."""

_COLUMNS = 16


class TileAtlas:
    """Collects the tiles of pictures of one size.

    Attributes:
        rows, columns: tiles of a picture, 0 before the first one.
    """

    def __init__(self) -> None:
        self.rows = self.columns = 0
        self._numbers: dict[bytes, int] = {}

    def __len__(self) -> int:
        return len(self._numbers)

    def add(self, picture: np.ndarray) -> np.ndarray:
        """Numbers (rows * columns,) of a picture's tiles, row by row; an incomplete tile repeats its last pixels.

        Args:
            picture: (H, W, 3) uint8.

        Raises:
            ValueError: the picture has another size than those before it.
        """
        height, width = -(-picture.shape[0] // TILE), -(-picture.shape[1] // TILE)
        if self._numbers and (height, width) != (self.rows, self.columns):
            raise ValueError(f"picture: expected {self.rows} x {self.columns} tiles, got {height} x {width}")
        self.rows, self.columns = height, width
        missing = [(0, height * TILE - picture.shape[0]), (0, width * TILE - picture.shape[1]), (0, 0)]
        whole = np.pad(picture, missing, mode="edge")
        tiles = whole.reshape(height, TILE, width, TILE, 3).swapaxes(1, 2).reshape(height * width, -1)
        return np.array([self._numbers.setdefault(tile.tobytes(), len(self._numbers)) for tile in tiles])

    def to_picture(self) -> np.ndarray:
        """All tiles in rows of `across`, in the order of their numbers: (H, W, 3) uint8."""
        rows = max(1, -(-len(self) // self.across))
        picture = np.zeros((rows * TILE, self.across * TILE, 3), np.uint8)
        for number, tile in enumerate(self._numbers):
            top, left = number // self.across * TILE, number % self.across * TILE
            picture[top : top + TILE, left : left + TILE] = np.frombuffer(tile, np.uint8).reshape(TILE, TILE, 3)
        return picture

    @property
    def across(self) -> int:
        """Tiles in a row of `to_picture`."""
        return _COLUMNS

    def tile_urls(self, since: int = 0) -> list[str]:
        """A `data:` URL of each tile from number `since`."""
        tiles = list(self._numbers)[since:]
        return [to_data_url(np.frombuffer(tile, np.uint8).reshape(TILE, TILE, 3)) for tile in tiles]


def to_data_url(picture: np.ndarray) -> str:
    """A picture (H, W, 3) uint8 as a PNG in a `data:` URL, with a palette where its colours are few enough."""
    from PIL import Image

    image, file = Image.fromarray(picture), io.BytesIO()
    if len(image.getcolors(picture.shape[0] * picture.shape[1]) or ()) <= 256:
        image = image.quantize(256, dither=Image.Dither.NONE)
    image.save(file, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"
