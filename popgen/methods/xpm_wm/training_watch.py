"""Signs that training goes wrong, told while it runs: rewards that only imagination pays, events that are made up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from popgen.methods.training import State
from popgen.methods.xpm_wm.config import WatchConfig

LEAST_PAY = 0.05
"""Imagined reward a step below which nothing is farmed: a pick-up every twenty steps."""


@dataclass
class Watch:
    """What a member's training has shown so far.

    Attributes:
        gap: rounds in a row in which imagination paid too much.
        best_precision: of events at one step, the highest so far.
        imprecise: reports in a row that were far below it.
        told: that imagination pays too much has been said; it is said again after a round in which it did not.
        told_precision: the same of precision.
    """

    gap: int = 0
    best_precision: float = 0.0
    imprecise: int = 0
    told: bool = False
    told_precision: bool = False

    def look(self, figures: Mapping[str, float], report: Mapping[str, float], config: WatchConfig, rounds: int) -> str:
        """What is to be said after a round, "" if nothing.

        Args:
            figures: of the round.
            report: of the world model, where one has come in with the round.
            config: of the watch.
            rounds: how many in a row it takes to speak of a gap.
        """
        lines = [self._look_at_pay(figures, config, rounds), self._look_at_events(report, config)]
        return "; ".join(line for line in lines if line)

    def _look_at_pay(self, figures: Mapping[str, float], config: WatchConfig, rounds: int) -> str:
        imagined, real = figures.get("agent/imagined_shaped_sp"), figures.get("real_shaped_sp")
        if imagined is None or real is None or not config.imagined_factor:
            return ""
        if imagined <= max(LEAST_PAY, config.imagined_factor * real):
            self.gap, self.told = 0, False
            return ""
        self.gap += 1
        if self.gap < rounds or self.told:
            return ""
        self.told = True
        return (
            f"imagination has paid {imagined:.2f} a step and real self-play {real:.2f} for {self.gap} rounds, the "
            "actor may be farming the world model's errors: give the model more updates (phase1.model_updates, "
            "phase2.model_updates) or trust its events less (discovery.trust=2)"
        )

    def _look_at_events(self, report: Mapping[str, float], config: WatchConfig) -> str:
        precision = report.get("report/event_precision_step1")
        if precision is None or not config.precision_share:
            return ""
        self.best_precision = max(self.best_precision, precision)
        if precision >= config.precision_share * self.best_precision:
            self.imprecise, self.told_precision = 0, False
            return ""
        self.imprecise += 1
        if self.imprecise < config.precision_reports or self.told_precision:
            return ""
        self.told_precision = True
        return (
            f"{precision:.0%} of the events that the world model predicts a step ahead are real, "
            f"{self.best_precision:.0%} were: give it more updates or a lower learning rate "
            "(world_model.learning_rate, phase2.model_lr)"
        )

    def to_state(self) -> State:
        """For a checkpoint."""
        return dict(vars(self))

    @staticmethod
    def from_state(state: State) -> Watch:
        """From `to_state()`, as it was read."""
        counts = {name: int(state[name]) for name in ("gap", "imprecise")}
        said = {name: bool(state[name]) for name in ("told", "told_precision")}
        return Watch(best_precision=float(state["best_precision"]), **counts, **said)
