"""What all charts share: sizes, colours, the file that a figure is saved to, and the legend below it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from popgen.reports.frames import steps_text

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

COLUMN = 3.4
"""Width of a figure in inches: one column of a two-column page."""

PAGE = 6.9
"""Width in inches of a figure over both columns."""

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, yellow left out (too pale for lines)."""

MARKERS = "<>hpdosD^v"

GREY = "#444444"
"""Of legend entries that stand for every colour."""

_STYLE: Any = {
    "text.parse_math": False,  # a "$" in a name is a letter
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "popgen",  # the same figure gives the same file
}
_LEGEND = {"handlelength": 2.6, "columnspacing": 1.2}


class Pictures:
    """Names the picture files of a report; every picture is written as PNG and as SVG.

    Attributes:
        files: name with suffix -> path.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.files = folder, dict[str, Path]()

    def add(self, name: str) -> list[Path]:
        """Paths of one more picture."""
        paths = {f"{name}.{suffix}": self.folder / f"{name}.{suffix}" for suffix in ("png", "svg")}
        self.files.update(paths)
        return [*paths.values()]


@contextmanager
def styled_figure(paths: Sequence[str | Path], width: float, height: float, *, dense: bool = False) -> Iterator[Figure]:
    """A styled figure that is saved to `paths` (by suffix) on leaving; needs no display. `dense` panels touch."""
    engine = ConstrainedLayoutEngine(w_pad=0.015, h_pad=0.015, wspace=0.0, hspace=0.0) if dense else "constrained"
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout=engine)
        FigureCanvasAgg(figure)
        yield figure
        for path in paths:
            dateless = {"Date": None} if Path(path).suffix == ".svg" else {}
            figure.savefig(path, dpi=300, metadata=dateless)


def add_panels(figure: Figure, count: int, columns: int) -> list[Axes]:
    """Axes of `count` panels in rows of `columns`."""
    rows = -(-count // max(1, columns))
    grid = np.atleast_1d(figure.subplots(max(1, rows), max(1, columns), squeeze=False).ravel())
    for axes in grid[count:]:
        axes.set_visible(False)
    return list(grid[:count])


def format_steps(axes: Axes, which: str) -> None:
    """Ticks of the `x` or `y` axis as 250k or 1.5M, with a faint grid."""
    getattr(axes, f"{which}axis").set_major_formatter(steps_text)
    axes.grid(alpha=0.25, linewidth=0.5)
    axes.set_axisbelow(True)


def fit_legend_columns(handles: Sequence[Artist], width: float) -> int:
    """Columns of a legend that fit into `width` inches."""
    longest = max((len(str(handle.get_label())) for handle in handles), default=1)
    return max(1, min(len(handles), int(width / (0.054 * longest + 0.5))))


def legend_height(handles: Sequence[Artist], width: float) -> float:
    """Inches that the legend takes."""
    return 0.15 + 0.15 * -(-len(handles) // fit_legend_columns(handles, width)) if handles else 0.0


def add_legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """Put the legend below everything else."""
    if handles:
        columns = fit_legend_columns(handles, figure.get_figwidth())
        figure.legend(handles=list(handles), loc="outside lower center", ncols=columns, frameon=False, **_LEGEND)
