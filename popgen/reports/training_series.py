"""Further figures of a run's `metrics.jsonl`: of the world model, and what was imagined beside what was real."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from popgen.errors import UserError
from popgen.reports.training_curves import read_lines

Series = Mapping[int, Sequence[tuple[float, float]]]
"""Member -> (minutes since the run began, value)."""


@dataclass(frozen=True)
class SeriesPanel:
    """One panel of figures over time.

    Attributes:
        title: above it.
        lines: name of a figure -> its series; a member's lines have one colour and a dash each.
        unit: on the vertical axis.
    """

    title: str
    lines: Mapping[str, Series]
    unit: str = ""

    @property
    def members(self) -> list[int]:
        """Whose figures they are."""
        return sorted({member for series in self.lines.values() for member in series})

    @property
    def values(self) -> list[float]:
        """All of them."""
        return [value for series in self.lines.values() for points in series.values() for _, value in points]


SHARE, REWARD = "share", "training reward a step"

WORLD_MODEL = {
    "observations predicted exactly": {
        "of the present": "report/exact_posterior",
        "1 step ahead": "report/exact_step1",
        "4 steps ahead": "report/exact_step4",
    },
    "events, 1 step ahead": {"precision": "report/event_precision_step1", "recall": "report/event_recall_step1"},
    "events, 4 steps ahead": {"precision": "report/event_precision_step4", "recall": "report/event_recall_step4"},
    "loss": {"KL": "model/loss_kl", "observations": "model/loss_observation", "events": "model/loss_events"},
}
"""Panel -> name in the legend -> key of metrics.jsonl."""

IMAGINED = {
    "self-play, imagined and real": {"imagined": "agent/imagined_shaped_sp", "real": "real_shaped_sp"},
    "imagined cross-play": {"imagined": "agent/imagined_shaped_xp"},
}
"""The same: mean training reward of a step, in imagination and in the environment."""


UNITS = {"loss": "loss", **dict.fromkeys(IMAGINED, REWARD)}
"""Panel -> unit, where it is no share."""


def read_panels(path: Path, wanted: Mapping[str, Mapping[str, str]]) -> list[SeriesPanel]:
    """Panels of the figures in `metrics.jsonl`; those without figures are left out.

    Raises:
        UserError: the file holds something else.
    """
    rows = []
    for number, line in enumerate(read_lines(path) if path.exists() else [], start=1):
        try:
            row = json.loads(line)
            rows.append((int(row["member"]), float(row["seconds"]) / 60, row))
        except (ValueError, TypeError, KeyError) as error:
            raise UserError(str(path), f"line {number} is no point of metrics ({error})", "restore it") from None
    panels = []
    for title, names in wanted.items():
        lines: dict[str, dict[int, list[tuple[float, float]]]] = {}
        for name, key in names.items():
            for member, minutes, row in rows:
                if isinstance(value := row.get(key, row.get(key.removeprefix("report/"))), int | float):
                    lines.setdefault(name, {}).setdefault(member, []).append((minutes, float(value)))
        panels.append(SeriesPanel(title, lines, UNITS.get(title, SHARE)))
    return [panel for panel in panels if panel.values]
