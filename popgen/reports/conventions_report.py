"""What players do and how dishes go with it, as tables in 80 columns, JSON and CSV."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from popgen.errors import UserError
from popgen.evaluation.convention_coverage import Coverage
from popgen.evaluation.convention_effects import Effect
from popgen.jsonable import jsonable
from popgen.reports.frames import to_csv

PAPER: dict[str, dict[str, tuple[float, float]]] = {
    "plating": {"E-LIPO": (1.76, -1.17), "E-CoMeDi": (1.72, -1.87), "E-XPM-WM": (0.74, -0.43)},
    "onion picking": {"E-LIPO": (1.14, -0.40), "E-CoMeDi": (0.90, -0.44), "E-XPM-WM": (1.30, -1.33)},
    "movement": {"E-LIPO": (1.13, -0.51), "E-CoMeDi": (0.30, -0.59), "E-XPM-WM": (0.17, -0.20)},
}
"""Table 3 of the paper: dishes of the high and of the low group of 40 people less those of all, by ego agent."""


@dataclass(frozen=True)
class PlayersReport:
    """Of one group of players.

    Attributes:
        label: people, or a population's.
        games: how many.
        within: effects within layout and seat.
        pooled: effects pooled as in the paper.
        coverage: layout -> how much of people's play they cover; empty for people themselves.
    """

    label: str
    games: int
    within: list[Effect]
    pooled: list[Effect]
    coverage: dict[str, Coverage]

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return asdict(self)


def effects_table(report: PlayersReport) -> Table:
    """High and low of every behaviour, with group sizes, interval and corrected p."""
    title = f"{report.label}, {report.games} games: dishes of a group less those of all"
    table = Table(title=Text(title), title_justify="left")
    table.add_column("within layout and seat")
    for name in ("group", "n", "dishes", "95 % interval", "p (Holm)", "pooled"):
        table.add_column(name, justify="right")
    for effect, pooled in zip(report.within, report.pooled, strict=True):
        measured = math.isfinite(effect.effect)
        interval = f"{effect.low:+.2f} to {effect.high:+.2f}" if measured else ""
        table.add_row(
            Text(effect.behaviour),
            effect.group,
            str(effect.size),
            _show_signed(effect.effect),
            interval,
            f"{effect.p_holm:.3f}" if measured else "",
            _show_signed(pooled.effect),
        )
    return table


def coverage_table(reports: Sequence[PlayersReport]) -> Table | None:
    """One row a population and layout; None where there are no populations."""
    rows = [(report.label, layout, found) for report in reports for layout, found in report.coverage.items()]
    if not rows:
        return None
    table = Table(title="distance of people to the nearest member, in people's SD", title_justify="left")
    for name in ("population", "layout", "people", "nearest", "shuffled", "average person"):
        table.add_column(name, justify="left" if name in ("population", "layout") else "right")
    for label, layout, found in rows:
        figures = (f"{found.nearest:.2f}", f"{found.shuffled:.2f}", f"{found.average:.2f}")
        table.add_row(Text(label), layout, str(found.people), *figures)
    return table


def paper_table() -> Table:
    """The paper's Table 3."""
    table = Table(title="the paper's Table 3 (40 people; high / low, no sizes or intervals)", title_justify="left")
    table.add_column("behaviour")
    for ego in PAPER["plating"]:
        table.add_column(ego, justify="right")
    for behaviour, egos in PAPER.items():
        table.add_row(behaviour, *(f"{high:+.2f} / {low:+.2f}" for high, low in egos.values()))
    return table


def to_sentences(reports: Sequence[PlayersReport]) -> list[str]:
    """What the tables say."""
    lines = []
    for report in reports:
        found = [f"{one.group} {one.behaviour}" for one in report.within if one.significant]
        what = ", ".join(found) if found else "nothing"
        lines.append(f"{report.label}: dishes go with {what} after correction")
        for layout, one in report.coverage.items():
            near = "nearer than shuffled people" if one.nearest < one.shuffled else "no nearer than shuffled people"
            lines.append(f"{report.label}, {layout}: people are {near} ({one.nearest:.2f}, {one.shuffled:.2f} SD)")
    return lines


def write_conventions(reports: Sequence[PlayersReport], folder: Path) -> list[Path]:
    """Write conventions.json and effects.csv; gives the paths.

    Raises:
        UserError: the folder cannot be written.
    """
    written = [folder / "conventions.json", folder / "effects.csv"]
    described = jsonable({"players": [report.as_dict() for report in reports]})
    rows = [
        {"players": report.label, "means": means, **jsonable(asdict(effect))}
        for report in reports
        for means, effects in (("within", report.within), ("pooled", report.pooled))
        for effect in effects
    ]
    columns = ("players", "means", *(field.name for field in fields(Effect)))
    texts = (json.dumps(described, indent=2, allow_nan=False) + "\n", to_csv(rows, columns))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in zip(written, texts, strict=True):
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(str(folder), f"cannot be written: {error.strerror}", "choose another folder") from error
    return written


def _show_signed(value: float) -> str:
    return f"{value:+.2f}" if math.isfinite(value) else ""
