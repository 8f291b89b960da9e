"""Layouts: read from overcooked_ai's files or from text, checked before anything is built."""

from __future__ import annotations

import ast
import difflib
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from popgen.envs.overcooked.rules import rule_keys
from popgen.errors import UserError

DIRECTIONS = ((0, -1), (0, 1), (1, 0), (-1, 0))  # north, south, east, west as (dx, dy)
MAX_CELLS = 255
CUSTOM = "custom"  # the name of a grid that has no other
TILES = {
    "O": "onion dispenser", "T": "tomato dispenser", "D": "dish dispenser", "P": "pot", "S": "serving location",
}  # fmt: skip

Cell = tuple[int, int]


@dataclass(frozen=True)
class Layout:
    """A checked two-player layout.

    Attributes:
        name: what the user called it.
        rows: the grid, players included, one string per row.
        config: the rule keys of its file (orders, recipe values, cook times); {} for a bare grid.
        from_file: whether `name` alone finds it again among overcooked_ai's layouts.
    """

    name: str
    rows: tuple[str, ...]
    config: dict[str, Any]
    from_file: bool

    @property
    def width(self) -> int:
        return len(self.rows[0])

    @property
    def height(self) -> int:
        return len(self.rows)

    @cached_property
    def starts(self) -> tuple[Cell, Cell]:
        """Starting cells (x, y) of players 1 and 2."""
        return self.cells("1")[0], self.cells("2")[0]

    @cached_property
    def areas(self) -> tuple[frozenset[Cell], frozenset[Cell]]:
        """The floor cells that each player can walk to."""
        return _flood_floor(self, self.starts[0]), _flood_floor(self, self.starts[1])

    @property
    def floor(self) -> list[Cell]:
        """Cells that some player can walk to, in reading order."""
        return sorted(self.areas[0] | self.areas[1], key=lambda cell: (cell[1], cell[0]))

    def tile(self, cell: Cell) -> str:
        """Terrain at a cell: ' ' under a player."""
        mark = self.rows[cell[1]][cell[0]]
        return " " if mark in "12" else mark

    def cells(self, mark: str) -> list[Cell]:
        """All cells (x, y) with a mark, in reading order."""
        return [(x, y) for y, row in enumerate(self.rows) for x, tile in enumerate(row) if tile == mark]

    def users(self, cell: Cell) -> frozenset[int]:
        """Which players can stand next to a cell."""
        around = {(cell[0] + dx, cell[1] + dy) for dx, dy in DIRECTIONS}
        return frozenset(player for player in (0, 1) if around & self.areas[player])

    def usable(self, mark: str) -> list[Cell]:
        """The cells with a mark that some player can stand next to, in reading order."""
        return [cell for cell in self.cells(mark) if self.users(cell)]


def layout_names() -> list[str]:
    """Names of the layout files that the installed overcooked_ai brings."""
    folder = _layout_folder()
    return sorted(path.stem for path in folder.glob("*.layout")) if folder else []


def load_layout(layout: str, grid: str | None = None, rules: Mapping[str, Any] | None = None) -> Layout:
    """Find, parse and check a layout.

    Args:
        layout: name of one of overcooked_ai's layouts, or path of a .layout file; only a label if `grid` is given.
        grid: the grid itself, rows separated by newlines or '/'.
        rules: order and recipe keys as in a layout file, to go with `grid`.

    Raises:
        UserError: no such layout, or one that two players cannot cook in.
    """
    if grid is not None:
        if not isinstance(grid, str):
            raise UserError("env.grid", f"must be text, got {type(grid).__name__}")
        made = Layout(layout or CUSTOM, _split_rows(grid), rule_keys(rules or {}, "env.rules"), False)
        field = "env.grid"
    else:
        if rules:
            raise UserError("env.rules", "go with env.grid only", "put them into the layout file")
        made, field = _from_file(layout), "env.layout"
    _check_grid(made, field)
    _check_tiles(made, field)
    _check_flow(made, field)
    return made


def choose_cooking(layout: Layout, cooking: str | None) -> str:
    """How pots start: what is asked for, else what the layout's file says (`old_dynamics`), else by themselves.

    Raises:
        UserError: the two contradict each other.
    """
    old = layout.config.get("old_dynamics")
    if old is not None and not isinstance(old, bool):
        raise UserError("env.layout", f"old_dynamics must be True or False, got {old!r}", "correct it")
    meant = None if old is None else "auto" if old else "interact"
    if cooking is not None and meant is not None and cooking != meant:
        problem = f"is {cooking}, but the layout's old_dynamics={old} means {meant}"
        raise UserError("env.cooking", problem, f"leave it out, or set cooking={meant}")
    return cooking or meant or "auto"


def _layout_folder() -> Path | None:
    spec = importlib.util.find_spec("overcooked_ai_py")
    places = spec.submodule_search_locations if spec else None
    return Path(list(places)[0], "data", "layouts") if places else None


def _from_file(layout: str) -> Layout:
    path = Path(str(layout)).expanduser()
    named = path.suffix != ".layout" and len(path.parts) == 1
    if named:
        folder = _layout_folder()
        if folder is None:
            raise UserError(
                "env.layout", "overcooked_ai is not installed", "pip install overcooked-ai, or give env.grid"
            )
        path = folder / f"{layout}.layout"
    if layout == CUSTOM and not path.is_file():
        fix = "give rows separated by '/', or a file by env.name=overcooked/PATH.layout"
        raise UserError("env.grid", f"is missing: {CUSTOM!r} is no layout, but a grid of your own", fix)
    if not named and path.suffix == ".layout" and not path.is_file():
        raise UserError("env.layout", f"there is no file {path}", "give the path of a .layout file")
    if path.suffix != ".layout" or not path.is_file():
        close = difflib.get_close_matches(path.stem, layout_names(), 3) if named else []
        fix = f"did you mean {' or '.join(close)}?" if close else "give a layout of overcooked_ai or a .layout file"
        raise UserError("env.layout", f"unknown layout {layout!r}", fix)
    try:
        config = _parse_literal(path.read_text())
        rows = _split_rows(_take_grid(config))
    except (OSError, SyntaxError, ValueError, TypeError, RecursionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        fix = "write a dict with a 'grid', of Python's literals"
        raise UserError("env.layout", f"cannot read {path.name}: {reason}", fix) from None
    return Layout(layout if named else path.stem, rows, rule_keys(config, "env.layout"), named)


class _Infinities(ast.NodeTransformer):
    """Replaces float('inf'), the one call that layout files make, by its value."""

    def visit_Call(self, node: ast.Call) -> ast.AST:
        if isinstance(node.func, ast.Name) and node.func.id == "float" and len(node.args) == 1 and not node.keywords:
            return ast.copy_location(ast.Constant(float(ast.literal_eval(node.args[0]))), node)
        return node


_JSON_WORDS = {"null": "None", "true": "True", "false": "False"}


def _parse_literal(text: str) -> Any:
    """The value of a layout file, a literal of Python.

    Raises:
        ValueError: it holds anything else, such as JSON's own words, which the message names with their line.
    """
    tree = ast.parse(text.removeprefix("\ufeff").strip(), mode="eval")
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id != "float":
            hint = f", write {_JSON_WORDS[node.id]}" if node.id in _JSON_WORDS else " is no literal"
            raise ValueError(f"line {node.lineno}: {node.id}{hint}")
    try:
        return ast.literal_eval(_Infinities().visit(tree))
    except ValueError as error:  # Python's own words end with the node's address in memory
        raise ValueError(str(error).partition(": <")[0].replace("malformed node or string", "no literal")) from None


def _take_grid(config: Any) -> str:
    """The grid, taken out of a layout file's value; the rules are left.

    Raises:
        ValueError: the value is no dict, or has no text as its grid.
    """
    if not isinstance(config, dict):
        raise ValueError("it is no dict")
    if not isinstance(grid := config.pop("grid", None), str):
        raise ValueError("it has no 'grid' of text")
    return grid


def _split_rows(text: str) -> tuple[str, ...]:
    return tuple(row.strip() for row in text.strip().replace("/", "\n").split("\n"))


def _check_grid(layout: Layout, field: str) -> None:
    rows = layout.rows
    if not any(rows):
        raise UserError(field, "is empty", "give rows of X, O, T, D, P, S, 1, 2 and spaces")
    if len({len(row) for row in rows}) != 1:
        raise UserError(field, f"rows of different lengths {[len(row) for row in rows]}", "make all rows equally long")
    if layout.width * layout.height > MAX_CELLS:
        raise UserError(field, f"{layout.width} x {layout.height} cells are too many", f"use at most {MAX_CELLS}")
    unknown = sorted(set("".join(rows)) - set("XOTDPS 123456789"))
    if unknown:
        raise UserError(field, f"unknown characters {''.join(unknown)!r}", "use X, O, T, D, P, S, 1, 2 and spaces")
    players = sorted(mark for mark in "".join(rows) if mark.isdigit())
    if players != ["1", "2"]:
        raise UserError(field, f"has players {''.join(players) or 'none'}", "mark exactly two players, 1 and 2")
    edge = rows[0] + rows[-1] + "".join(row[0] + row[-1] for row in rows)
    if set(edge) & set(" 12"):
        raise UserError(field, "the border is open", "close it with X or other tiles")


def _check_tiles(layout: Layout, field: str) -> None:
    for mark, what in (
        ("P", "pot"),
        ("OT", "ingredient dispenser"),
        ("D", "dish dispenser"),
        ("S", "serving location"),
    ):
        if not any(layout.cells(one) for one in mark):
            raise UserError(field, f"has no {what}", f"add {' or '.join(mark)} where a player can reach it")
    for mark, what in TILES.items():
        for x, y in layout.cells(mark):
            beside = [layout.rows[y + dy][x + dx] for dx, dy in DIRECTIONS if _is_inside(layout, x + dx, y + dy)]
            part = mark == "S" and "S" in beside and layout.usable("S")  # serving areas may be more than one tile deep
            if not layout.users((x, y)) and not part:
                raise UserError(
                    field, f"no player can reach the {what} at column {x}, row {y}", "free a cell next to it"
                )


def _check_flow(layout: Layout, field: str) -> None:
    """Ingredients and a dish must get to one pot and its soup to a serving location, over counters if need be."""
    shared = any(len(layout.users(cell)) == 2 for cell in layout.cells("X"))

    def holders(cells: list[Cell]) -> frozenset[int]:
        first = frozenset().union(*(layout.users(cell) for cell in cells))
        return frozenset((0, 1)) if first and (shared or layout.areas[0] == layout.areas[1]) else first

    cooks = holders(layout.usable("O") + layout.usable("T"))
    waiters = holders(layout.usable("D"))
    filled = [pot for pot in layout.usable("P") if layout.users(pot) & cooks]
    if not filled:
        raise UserError(field, "no ingredient can be brought to a pot", "let the players' areas share a counter")
    emptied = [pot for pot in filled if layout.users(pot) & waiters]
    if not emptied:
        raise UserError(field, "no dish can be brought to a pot", "let the players' areas share a counter")
    servers = frozenset().union(*(layout.users(pot) & waiters for pot in emptied))
    servers = frozenset((0, 1)) if shared else servers
    if not any(layout.users(spot) & servers for spot in layout.usable("S")):
        raise UserError(field, "no soup can be brought to a serving location", "let the players' areas share a counter")


def _is_inside(layout: Layout, x: int, y: int) -> bool:
    return 0 <= x < layout.width and 0 <= y < layout.height


def _flood_floor(layout: Layout, start: Cell) -> frozenset[Cell]:
    seen, front = {start}, [start]
    while front:
        x, y = front.pop()
        for dx, dy in DIRECTIONS:
            cell = (x + dx, y + dy)
            if layout.tile(cell) == " " and cell not in seen:
                seen.add(cell)
                front.append(cell)
    return frozenset(seen)
