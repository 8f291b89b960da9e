"""Draws overview.svg: how a member is made, and the matrix that judges the population. Nothing in it is measured.

python docs/img/overview.py
"""

from __future__ import annotations

from pathlib import Path

WIDTH, HEIGHT = 860, 280
BOXES = {  # name -> left, top, width, height, colour, lines of text
    "env": (20, 110, 150, 70, "#dbe9f6", ("environment", "few real episodes")),
    "replay": (215, 110, 130, 70, "#dbe9f6", ("buffers", "B_SP and B_XP")),
    "model": (390, 30, 150, 70, "#fde3c8", ("world model", "or exact simulator")),
    "imagined": (390, 190, 150, 70, "#fde3c8", ("simulated play", "self and cross")),
    "agent": (585, 110, 110, 70, "#d9efd6", ("member m", "actor, critics")),
}
ARROWS = (
    ("M170 145 H213", "", 0, 0),
    ("M345 135 H367 V65 H388", "", 0, 0),
    ("M465 100 V188", "dynamics", 472, 148),
    ("M345 155 H367 V225 H388", "start states", 296, 205),
    ("M540 225 H562 V155 H583", "", 0, 0),
    ("M640 110 V22 H95 V108", "plays with itself and with members 1 .. m-1", 110, 16),
)
CELL, LEFT, TOP = 36, 735, 92


def draw_box(left: int, top: int, width: int, height: int, colour: str, lines: tuple[str, str]) -> str:
    """A rounded box with a title and a line under it."""
    middle = left + width // 2
    return (
        f'<rect x="{left}" y="{top}" width="{width}" height="{height}" rx="8" fill="{colour}" stroke="#555"/>'
        f'<text x="{middle}" y="{top + 31}" text-anchor="middle" font-weight="bold">{lines[0]}</text>'
        f'<text x="{middle}" y="{top + 51}" text-anchor="middle" font-size="12">{lines[1]}</text>'
    )


def draw_arrow(path: str, text: str, left: int, top: int) -> str:
    """A line with a head, and its label."""
    label = f'<text x="{left}" y="{top}" font-size="11" fill="#333">{text}</text>' if text else ""
    return f'<path d="{path}" fill="none" stroke="#333" stroke-width="1.5" marker-end="url(#head)"/>{label}'


def draw_matrix() -> str:
    """Three members: SP on the diagonal, XP beside it."""
    cells = []
    for row in range(3):
        for column in range(3):
            same = row == column
            x, y = LEFT + column * CELL, TOP + row * CELL
            cells.append(
                f'<rect x="{x}" y="{y}" width="{CELL}" height="{CELL}" stroke="#fff" '
                f'fill="{"#2c6e49" if same else "#e6e6e6"}"/>'
                f'<text x="{x + CELL // 2}" y="{y + 22}" text-anchor="middle" font-size="11" '
                f'fill="{"#fff" if same else "#333"}">{"SP" if same else "XP"}</text>'
            )
    title = f'<text x="{LEFT + 54}" y="{TOP - 12}" text-anchor="middle" font-size="12">all pairs play</text>'
    legend = f'<text x="{LEFT + 54}" y="{TOP + 126}" text-anchor="middle" font-size="12">SP high, XP low</text>'
    return title + "".join(cells) + legend


def draw() -> str:
    """The whole picture."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" '
        'font-family="Helvetica, Arial, sans-serif" font-size="14">'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>'
        '<defs><marker id="head" markerWidth="8" markerHeight="8" refX="7" refY="4" orient="auto">'
        '<path d="M0 0 L8 4 L0 8 z" fill="#333"/></marker></defs>'
    )
    parts = [*(draw_box(*box) for box in BOXES.values()), *(draw_arrow(*arrow) for arrow in ARROWS), draw_matrix()]
    to_matrix = draw_arrow("M695 145 H731", "", 0, 0)
    return "\n".join([head, *parts, to_matrix, "</svg>"]) + "\n"


if __name__ == "__main__":
    Path(__file__).with_suffix(".svg").write_text(draw())
