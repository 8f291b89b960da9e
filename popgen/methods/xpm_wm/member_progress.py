"""How far a member's training has come: the records that a checkpoint holds, and signs that it goes wrong."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from popgen.methods.skill_checkpoints import SkillCheckpoint, SkillCheckpoints
from popgen.methods.training import Pending, State
from popgen.methods.xpm_wm.config import WatchConfig
from popgen.methods.xpm_wm.imagination import Starts
from popgen.nets.weights import Weights
from popgen.play.episodes import Episode
from popgen.play.partner_strength import PartnerConstraint, PartnerStrength

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


Put = Callable[[Any], Pending[Any]]


@dataclass(frozen=True)
class MemberWeights:
    """Handles of what a member's learner published: filter and actor (`acting`), critics, and the world model, of the
    same filter, that it learned in."""

    acting: Pending[Weights]
    critics: Pending[Weights]
    model: Pending[Weights]

    def to_state(self) -> State:
        """For a checkpoint."""
        return {"acting": self.acting, "critics": self.critics, "model": self.model}

    @staticmethod
    def from_state(state: State, put: Put) -> MemberWeights:
        """From `to_state()`, as it was read."""
        return MemberWeights(put(state["acting"]), put(state["critics"]), put(state["model"]))


@dataclass(frozen=True)
class Candidate:
    """A policy as it played some real episodes, and what it scored in self-play and strongest cross-play."""

    weights: MemberWeights
    sp: float
    xp: float

    def merit(self, xp_limit: float | None = None) -> float:
        """Self-play less the strongest cross-play: what a member is chosen by. Cross-play below its limit is worth no
        more than at it."""
        return self.sp - (self.xp if xp_limit is None else max(self.xp, xp_limit))

    def to_state(self) -> State:
        """For a checkpoint."""
        return {"published": self.weights.to_state(), "sp": self.sp, "xp": self.xp}

    @staticmethod
    def from_state(state: State, put: Put) -> Candidate:
        """From `to_state()`, as it was read."""
        return Candidate(MemberWeights.from_state(state["published"], put), float(state["sp"]), float(state["xp"]))


@dataclass
class FirstMemberProgress:
    """Member 1.

    Attributes:
        window: episodes that a score is the mean of.
        steps: environment steps so far.
        rounds: that have ended.
        since_best: rounds since the best window, once there was one.
        mark, since_gain: the window that last counted as a gain, and the rounds since, once self-play has begun.
        confirmations: how often the last policy has been looked at by itself.
        restarted: actor and critics have started again.
        plays: self-play has begun (`agent.entropy_after` of the target).
        confirmed: the last policy is good by itself.
        recent, shaped: scores and shaped returns of the last episodes.
        figures: the last value of every figure.
        best: the policy of the best window.
        published, played: the weights learned last, and those that play.
        model, starts, recent_starts: of the world model's last update.
        watch: signs of trouble so far.
    """

    window: int
    steps: int = 0
    rounds: int = 0
    since_best: int = 0
    mark: float = 0.0
    since_gain: int = 0
    confirmations: int = 0
    restarted: bool = False
    plays: bool = False
    confirmed: bool = False
    recent: deque[float] = field(default_factory=deque)
    shaped: deque[float] = field(default_factory=deque)
    figures: dict[str, float] = field(default_factory=dict)
    best: Candidate | None = None
    published: MemberWeights | None = None
    played: MemberWeights | None = None
    model: Pending[Weights] | None = None
    starts: Pending[Starts] | None = None
    recent_starts: Pending[Starts] | None = None
    watch: Watch = field(default_factory=Watch)

    @property
    def latest(self) -> MemberWeights:
        """The weights learned last; there are some from the first update on."""
        assert self.published is not None
        return self.published

    @property
    def imagination(self) -> tuple[Pending[Weights], Pending[Starts]]:
        """World model and start states to imagine with; there are some from the first update on."""
        assert self.model is not None and self.starts is not None
        return self.model, self.starts

    def add_episodes(self, episodes: Sequence[Episode]) -> None:
        """Episodes that have ended; only the last `window` count."""
        self.add_scores([e.score for e in episodes], [e.shaped for e in episodes])

    def add_scores(self, scores: Iterable[float], shaped: Iterable[float]) -> None:
        """Scores and shaped returns of episodes."""
        self.recent = deque([*self.recent, *scores], self.window)
        self.shaped = deque([*self.shaped, *shaped], self.window)

    def to_state(self) -> State:
        """For a checkpoint."""
        return {
            "rounds": self.rounds,
            "since_best": self.since_best,
            "mark": self.mark,
            "since_gain": self.since_gain,
            "confirmations": self.confirmations,
            "restarted": self.restarted,
            "plays": self.plays,
            "recent": list(self.recent),
            "shaped": list(self.shaped),
            "figures": dict(self.figures),
            "best": None if self.best is None else self.best.to_state(),
            "published": self.latest.to_state(),
            "model": self.model,
            "starts": self.starts,
            "recent_starts": self.recent_starts,
            "watch": self.watch.to_state(),
        }

    @staticmethod
    def from_state(state: State, window: int, steps: int, put: Put) -> FirstMemberProgress:
        """From `to_state()`, as it was read."""
        progress = FirstMemberProgress(
            window,
            steps,
            rounds=int(state["rounds"]),
            since_best=int(state["since_best"]),
            mark=float(state["mark"]),
            since_gain=int(state["since_gain"]),
            confirmations=int(state["confirmations"]),
            restarted=bool(state["restarted"]),
            plays=bool(state["plays"]),
            figures={str(name): float(value) for name, value in state["figures"].items()},
            best=None if state["best"] is None else Candidate.from_state(state["best"], put),
            published=MemberWeights.from_state(state["published"], put),
            model=put(state["model"]),
            starts=put(Starts(**state["starts"])),
            recent_starts=None if state["recent_starts"] is None else put(Starts(**state["recent_starts"])),
            watch=Watch.from_state(state["watch"]),
        )
        progress.add_scores(map(float, state["recent"]), map(float, state["shaped"]))
        return progress


@dataclass
class LaterMemberProgress:
    """Members 2..M.

    Attributes:
        strength: each partner's returns in real cross-play.
        constraint: the multipliers that its scores there have led to.
        steps: environment steps so far.
        rounds: of real episodes that have ended; since_best: since the best of them.
        plays: self-play has begun (`agent.entropy_after` of the target).
        best: the policy of the best round.
        figures: of the last round.
        watch: signs of trouble so far.
        skills: policies on the way by their real self-play; None where the best alone is kept.
    """

    strength: PartnerStrength
    steps: int = 0
    rounds: int = 0
    plays: bool = False
    best: Candidate | None = None
    figures: dict[str, float] = field(default_factory=dict)
    since_best: int = 0
    watch: Watch = field(default_factory=Watch)
    constraint: PartnerConstraint = field(default_factory=lambda: PartnerConstraint(None, 0.0))
    skills: SkillCheckpoints | None = None

    def keep_skill(self, scored: Candidate) -> None:
        """The policy of a round, where such are kept."""
        if self.skills is not None:
            self.skills.add(SkillCheckpoint(self.steps, scored.sp, scored.weights.acting.result()))

    @property
    def best_shown(self) -> dict[str, float]:
        """The best round so far, for the progress line."""
        return {} if self.best is None else {"SP": round(self.best.sp, 2), "XP": round(self.best.xp, 2)}

    def to_state(self) -> State:
        """For a checkpoint, after the first round."""
        assert self.best is not None
        return {
            "rounds": self.rounds,
            "plays": self.plays,
            "since_best": self.since_best,
            "watch": self.watch.to_state(),
            "best": self.best.to_state(),
            "strength": self.strength.state(),
            "constraint": self.constraint.state(),
            "skills": None if self.skills is None else self.skills.state(),
        }

    def load_state(self, state: State, put: Put) -> None:
        """Go on from `to_state()`, as it was read; the steps are known."""
        self.strength.load_state(state["strength"])
        self.constraint.load_state(state["constraint"])
        self.best = Candidate.from_state(state["best"], put)
        self.rounds, self.plays = int(state["rounds"]), bool(state["plays"])
        self.since_best, self.watch = int(state["since_best"]), Watch.from_state(state["watch"])
        self.skills = None if state["skills"] is None else SkillCheckpoints.from_state(state["skills"])
