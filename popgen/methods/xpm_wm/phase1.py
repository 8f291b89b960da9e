"""Phase 1, member 1: how far its training has come, which is what a checkpoint holds, and the rules that end it.

Rules and what is said of a round are pure functions of the progress and the recipe; what a round changes in the
progress stands apart. Nothing runs for any of them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from popgen.methods.training import Pending, Phase, Progress, Round, Sampled, State
from popgen.methods.xpm_wm.config import Phase1Config
from popgen.methods.xpm_wm.real_play import Candidate, MemberWeights, Put, Tally, Watch
from popgen.methods.xpm_wm.workers import AgentTask
from popgen.methods.xpm_wm.world_model import Starts
from popgen.play.episodes import Episode
from popgen.types import Weights

RANDOM_PLAY, MODEL_ALONE, SELF_PLAY = "random play", "world model", "self-play"
CONFIRMED = 0.97
"""Share of the target that the last policy must reach by itself."""
RISING, FORESEEN = 0.02, 0.5
"""Shares of the target: where scores begin to rise, and from where on they foretell when it will be reached."""
GOOD_ENOUGH = 0.95
"""Share of the best window from which on the last weights are taken, which learned longer."""


@dataclass
class FirstMemberProgress:
    """Member 1.

    Attributes:
        window: episodes that a score is the mean of.
        steps: environment steps so far.
        rounds: that have ended.
        since_best: rounds since the best window, once there was one.
        rose_from: steps at the end of the last round before scores rose.
        mark, since_gain: the window that last counted as a gain, and the rounds since, once self-play has begun.
        confirmations: how often the last policy has been looked at by itself.
        restarted: actor and critics have started again.
        self_play_has_begun: real self-play has reached `agent.entropy_after` of the target.
        confirmed: the last policy is good by itself.
        recent, shaped: scores and shaped returns of the last episodes.
        figures: the last value of every figure.
        best: the policy of the best window.
        published, playing_weights: the weights learned last, and those that play.
        model, starts, recent_starts: of the world model's last update.
        watch: signs of trouble so far.
    """

    window: int
    steps: int = 0
    rounds: int = 0
    since_best: int = 0
    rose_from: int = 0
    mark: float = 0.0
    since_gain: int = 0
    confirmations: int = 0
    restarted: bool = False
    self_play_has_begun: bool = False
    confirmed: bool = False
    recent: deque[float] = field(default_factory=deque)
    shaped: deque[float] = field(default_factory=deque)
    figures: dict[str, float] = field(default_factory=dict)
    best: Candidate | None = None
    published: MemberWeights | None = None
    playing_weights: MemberWeights | None = None
    model: Pending[Weights] | None = None
    starts: Pending[Starts] | None = None
    recent_starts: Pending[Starts] | None = None
    watch: Watch = field(default_factory=Watch)

    @property
    def latest(self) -> MemberWeights:
        """The weights learned last; there are some from the first update on."""
        assert self.published is not None
        return self.published

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
            "rose_from": self.rose_from,
            "mark": self.mark,
            "since_gain": self.since_gain,
            "confirmations": self.confirmations,
            "restarted": self.restarted,
            "plays": self.self_play_has_begun,
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
            rose_from=int(state["rose_from"]),
            mark=float(state["mark"]),
            since_gain=int(state["since_gain"]),
            confirmations=int(state["confirmations"]),
            restarted=bool(state["restarted"]),
            self_play_has_begun=bool(state["plays"]),
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


def make_agent_task(progress: FirstMemberProgress, phase: Phase1Config, tally: Tally | None) -> AgentTask:
    """Updates of the agent in the world model published last, from the states published with it."""
    assert progress.model is not None and progress.starts is not None, "both are there from the first update on"
    return AgentTask(
        updates=phase.agent_updates,
        model=progress.model,
        starts=progress.starts,
        self_play_has_begun=progress.self_play_has_begun,
        tally=tally,
        recent=progress.recent_starts,
    )


# ---- rules -----------------------------------------------------------------------------------------------------------


def self_play_steps(phase: Phase1Config) -> int:
    """Environment steps of self-play at most."""
    return max(1, phase.max_steps - phase.prefill_steps)


def count_self_play(progress: FirstMemberProgress, phase: Phase1Config) -> int:
    """Environment steps after random play."""
    return max(0, progress.steps - phase.prefill_steps)


def mean_score(progress: FirstMemberProgress) -> float:
    """Of the last episodes; 0 where there are none."""
    return float(np.mean(progress.recent)) if progress.recent else 0.0


def has_full_window(progress: FirstMemberProgress) -> bool:
    """Enough episodes to judge by."""
    return len(progress.recent) == progress.window


def reached_target(progress: FirstMemberProgress, phase: Phase1Config) -> bool:
    """The target, over a full window of episodes."""
    return has_full_window(progress) and mean_score(progress) >= phase.target_score


def has_levelled_off(progress: FirstMemberProgress, phase: Phase1Config) -> bool:
    """Plays, and has not gained for `plateau` rounds."""
    return progress.self_play_has_begun and 0 < phase.plateau <= progress.since_gain


def is_done(progress: FirstMemberProgress, phase: Phase1Config) -> bool:
    """No longer improves, or where that does not matter has reached the target: the last policy is to be looked at."""
    return has_levelled_off(progress, phase) if phase.plateau else reached_target(progress, phase)


def should_stop(progress: FirstMemberProgress, phase: Phase1Config) -> bool:
    """Budget spent, done, or no better for `patience` rounds."""
    return progress.steps >= phase.max_steps or is_done(progress, phase) or progress.since_best >= phase.patience


def foresee_end(progress: FirstMemberProgress, phase: Phase1Config) -> float | None:
    """Steps of self-play at which the target will be reached, if scores rise as they have so far; None where a plateau
    ends the phase, or scores are still too low to tell."""
    score, target = mean_score(progress), phase.target_score
    if phase.plateau or score <= 0.0 or score < FORESEEN * target:
        return None
    missing = max(0.0, target / score - 1.0) * (progress.steps - progress.rose_from)
    return min(float(self_play_steps(phase)), count_self_play(progress, phase) + missing)


def restart_is_due(progress: FirstMemberProgress, phase: Phase1Config) -> bool:
    """Whether actor and critics start again, once (an actor can get stuck, a model less)."""
    wanted = phase.restart_updates > 0 and not progress.restarted
    return wanted and progress.steps >= phase.restart_after


def may_confirm(progress: FirstMemberProgress, phase: Phase1Config, horizon: int) -> bool:
    """Whether the budget leaves room for a whole episode of the last policy in each environment."""
    return progress.steps + phase.envs * horizon <= phase.max_steps


def is_confirmed(score: float, wanted: float) -> bool:
    """Whether a policy that scored so by itself is good enough: a window's episodes are of several policies."""
    return score >= CONFIRMED * wanted


def choose_first(progress: FirstMemberProgress) -> Candidate:
    """The policy with the best window, unless the last one is about as good."""
    last, best = Candidate(progress.latest, mean_score(progress), 0.0), progress.best
    return last if progress.confirmed or best is None or last.sp >= GOOD_ENOUGH * best.sp else best


# ---- what a round changes --------------------------------------------------------------------------------------------


def keep_best(progress: FirstMemberProgress, phase: Phase1Config, entropy_after: float) -> None:
    """Remember the policy that played, not the one learned meanwhile; rounds count once there is a full window."""
    if mean_score(progress) < RISING * phase.target_score:
        progress.rose_from = progress.steps
    if not has_full_window(progress):
        return
    score = mean_score(progress)
    progress.self_play_has_begun |= score >= entropy_after * phase.target_score
    count_gain(progress, score, phase)
    if progress.best is None or score > progress.best.sp:
        assert progress.playing_weights is not None
        progress.best, progress.since_best = Candidate(progress.playing_weights, score, 0.0), 0
    else:
        progress.since_best += 1


def count_gain(progress: FirstMemberProgress, score: float, phase: Phase1Config) -> None:
    """Of a full window, once self-play has begun."""
    if not progress.self_play_has_begun:
        return
    progress.since_gain += 1
    if score >= (1.0 + phase.least_gain) * progress.mark:
        progress.mark, progress.since_gain = score, 0


def confirm_policy(progress: FirstMemberProgress, episodes: Sequence[Episode], phase: Phase1Config) -> float:
    """Whole episodes of the last policy alone: its score, and whether that confirms it, which takes the target or, with
    a plateau, the window that last counted as a gain. If not, gains are waited for anew."""
    progress.add_episodes(episodes)
    score = float(np.mean([episode.score for episode in episodes]))
    progress.confirmed = is_confirmed(score, progress.mark if phase.plateau else phase.target_score)
    progress.since_gain = 0
    return score


# ---- what is said ----------------------------------------------------------------------------------------------------


def window_figures(progress: FirstMemberProgress, horizon: int) -> dict[str, float]:
    """Scores and shaped reward per step of the last episodes; nothing where there are none."""
    if not progress.recent:
        return {}
    return {"real_sp": mean_score(progress), "real_shaped_sp": float(np.mean(progress.shaped)) / horizon}


def describe_random_play(progress: FirstMemberProgress, sampled: tuple[Sampled, ...]) -> Progress:
    """Random episodes so far."""
    steps, member = progress.steps, 1
    return Progress(member, steps, sampled=sampled, done=steps, shown={"steps": steps})


def describe_pretraining(progress: FirstMemberProgress, figures: dict[str, float], done: int) -> Progress:
    """So many of the world model's first updates are done."""
    shown = {"model_loss": round(figures["model/loss_observation"], 2)}
    return Progress(1, progress.steps, figures, done=done, shown=shown)


def describe_self_play(progress: FirstMemberProgress, phase: Phase1Config) -> Phase:
    """The phase of member 1 after random play: what was played of it so far is done."""
    return Phase(SELF_PLAY, self_play_steps(phase), 1, done=count_self_play(progress, phase))


def describe_first_round(progress: FirstMemberProgress, phase: Phase1Config, score_name: str) -> Round:
    """The round that has ended, with the figures so far."""
    figures, steps, member = dict(progress.figures), progress.steps, 1
    shown = {"steps": steps, score_name: round(figures.get("real_sp", 0.0), 2)}
    done, ends_at = count_self_play(progress, phase), foresee_end(progress, phase)
    return Round(member, steps, figures, done=done, ends_at=ends_at, shown=shown, number=progress.rounds)


def describe_confirmation(progress: FirstMemberProgress, score: float, episodes: int, score_name: str) -> str:
    """Whole episodes of the last policy in a line."""
    outcome = "taken" if progress.confirmed else "learning continues"
    return f"member 1: {score:.2f} {score_name} in {episodes} episodes of one policy: {outcome}"
