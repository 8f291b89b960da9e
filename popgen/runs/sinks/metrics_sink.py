"""Metrics as JSON lines: metrics.jsonl in the run's folder."""

from __future__ import annotations

import json
import math
import os
import time
from pathlib import Path

from popgen.durable_files import read_regular
from popgen.runs.sinks.sink import MetricPoint, Sink


class MetricsSink(Sink):
    """Appends a line for each point. A process that died while it wrote one left half a line, which is cut off."""

    def __init__(self, folder: Path, began: float) -> None:
        self.path, self.began = folder / "metrics.jsonl", began
        data = read_regular(self.path) if self.path.exists() else b""
        if data and not data.endswith(b"\n"):
            os.truncate(self.path, data.rfind(b"\n") + 1)

    def on_metrics(self, point: MetricPoint) -> None:
        """One line: member, step, seconds of this attempt, figures."""
        row = {"member": point.member, "step": point.step, "seconds": round(time.time() - self.began, 2)}
        figures = {name: _round_figure(value) for name, value in point.figures.items()}
        with self.path.open("a") as file:
            file.write(json.dumps(row | figures) + "\n")


def _round_figure(value: float) -> float | None:
    return round(float(value), 5) if math.isfinite(value) else None
