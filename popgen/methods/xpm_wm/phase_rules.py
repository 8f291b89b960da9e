"""Rules that end a phase, and what is said of a round: functions of a progress record and the recipe; nothing runs for
them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from popgen.methods.training import Phase, Progress, Round, Sampled
from popgen.methods.xpm_wm.config import DiscoveryConfig, Phase1Config, Phase2Config
from popgen.methods.xpm_wm.member_progress import (
    Candidate,
    FirstMemberProgress,
    LaterMemberProgress,
    MemberWeights,
)
from popgen.methods.xpm_wm.real_play import Tally
from popgen.play.episodes import Episode
from popgen.types import Kind

CONFIRMED = 0.97
"""Share of the target that the last policy must reach by itself."""
GOOD_ENOUGH = 0.95
"""Share of the best window from which on the last weights are taken, which learned longer."""


# ---- what real play has shown ----------------------------------------------------------------------------------------


def goes_by_tally(config: DiscoveryConfig) -> bool:
    """Whether anything depends on what real play has shown."""
    return bool(config.count_bonus or config.found_events or config.rare_events or config.trust)


def rare_events(tally: Tally | None, config: DiscoveryConfig) -> tuple[int, ...]:
    """Events that real play has shown too seldom to imagine what follows them."""
    return () if tally is None else tuple(np.flatnonzero(tally.events < config.rare_events).tolist())


# ---- phases of the loop ----------------------------------------------------------------------------------------------

RANDOM_PLAY, MODEL_ALONE, SELF_PLAY, IMAGINATION = "random play", "world model", "self-play", "imagination"


def self_play_steps(phase: Phase1Config) -> int:
    """Environment steps of self-play at most."""
    return max(1, phase.max_steps - phase.prefill_steps)


def count_self_play(progress: FirstMemberProgress, phase: Phase1Config) -> int:
    """Environment steps after random play."""
    return max(0, progress.steps - phase.prefill_steps)


def count_imagination(phase: Phase2Config, rounds: int) -> int:
    """Agent updates of so many rounds."""
    return phase.first_updates + (rounds - 1) * phase.updates_per_round if rounds else 0


# ---- rules of phase 1 ------------------------------------------------------------------------------------------------


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
    return progress.plays and 0 < phase.plateau <= progress.since_gain


def is_done(progress: FirstMemberProgress, phase: Phase1Config) -> bool:
    """No longer improves, or where that does not matter has reached the target: the last policy is to be looked at."""
    return has_levelled_off(progress, phase) if phase.plateau else reached_target(progress, phase)


def should_stop(progress: FirstMemberProgress, phase: Phase1Config) -> bool:
    """Budget spent, done, or no better for `patience` rounds."""
    return progress.steps >= phase.max_steps or is_done(progress, phase) or progress.since_best >= phase.patience


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


def confirm_policy(progress: FirstMemberProgress, episodes: Sequence[Episode], phase: Phase1Config) -> float:
    """Whole episodes of the last policy alone: its score, and whether that confirms it, which takes the target or, with
    a plateau, the window that last counted as a gain. If not, gains are waited for anew."""
    progress.add_episodes(episodes)
    score = float(np.mean([episode.score for episode in episodes]))
    progress.confirmed = is_confirmed(score, progress.mark if phase.plateau else phase.target_score)
    progress.since_gain = 0
    return score


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
    done = count_self_play(progress, phase)
    return Round(member, steps, figures, done=done, shown=shown, number=progress.rounds)


def describe_confirmation(progress: FirstMemberProgress, score: float, episodes: int, score_name: str) -> str:
    """Whole episodes of the last policy in a line."""
    outcome = "taken" if progress.confirmed else "learning continues"
    return f"member 1: {score:.2f} {score_name} in {episodes} episodes of one policy: {outcome}"


def keep_best(progress: FirstMemberProgress, phase: Phase1Config, entropy_after: float) -> None:
    """Remember the policy that played, not the one learned meanwhile; rounds count once there is a full window."""
    if not has_full_window(progress):
        return
    score = mean_score(progress)
    progress.plays |= score >= entropy_after * phase.target_score
    count_gain(progress, score, phase)
    if progress.best is None or score > progress.best.sp:
        assert progress.played is not None
        progress.best, progress.since_best = Candidate(progress.played, score, 0.0), 0
    else:
        progress.since_best += 1


def count_gain(progress: FirstMemberProgress, score: float, phase: Phase1Config) -> None:
    """Of a full window, once self-play has begun."""
    if not progress.plays:
        return
    progress.since_gain += 1
    if score >= (1.0 + phase.least_gain) * progress.mark:
        progress.mark, progress.since_gain = score, 0


def choose_first(progress: FirstMemberProgress) -> Candidate:
    """The policy with the best window, unless the last one is about as good."""
    last, best = Candidate(progress.latest, mean_score(progress), 0.0), progress.best
    return last if progress.confirmed or best is None or last.sp >= GOOD_ENOUGH * best.sp else best


# ---- rules of phase 2 ------------------------------------------------------------------------------------------------


def cross_play_episodes(phase: Phase2Config, partners: int) -> int:
    """Of one round: at least one in each seating with each partner, since every partner's cross-play must be known to
    tell the strongest; none where members meet nobody."""
    return max(phase.episodes_xp, 2 * partners) if phase.episodes_xp else 0


def most_rounds(phase: Phase2Config, episodes_xp: int, horizon: int) -> int:
    """Rounds of real episodes at most: those configured, fewer where the environment steps end first."""
    most, each = max(phase.rounds, phase.max_rounds), (phase.episodes_sp + episodes_xp) * horizon
    return most if phase.max_steps is None else max(1, min(most, phase.max_steps // each))


def plays_on(progress: LaterMemberProgress, phase: Phase2Config, most: int) -> bool:
    """The configured rounds are played in any case, further ones only by a member that is still weak or, with a
    plateau, improves."""
    weak = progress.best is None or progress.best.sp < phase.target_score
    goes_on = weak or progress.since_best < phase.plateau
    return progress.rounds < (most if goes_on else min(phase.rounds, most))


def judge_round(
    progress: LaterMemberProgress, published: MemberWeights, episodes: Sequence[Episode], horizon: int
) -> Candidate:
    """Line 9's returns from B_XP, of every partner met, and what follows for its multiplier; the round's policy with
    its scores, kept if it is the best."""
    own = [e for e in episodes if e.kind is Kind.SP]
    partners = sorted({partner for e in episodes if e.kind is Kind.XP for partner in e.members} - set(own[0].members))
    cross = {k: [e for e in episodes if e.kind is Kind.XP and k in e.members] for k in partners}
    for partner, met in cross.items():
        progress.strength.add(partner, [e.shaped for e in met])
    scores = {k: float(np.mean([e.score for e in met])) for k, met in cross.items()}
    strongest = max(scores.values(), default=0.0)
    candidate = Candidate(published, float(np.mean([e.score for e in own])), strongest)
    limit = progress.constraint.limit
    progress.constraint.add(scores, candidate.sp)
    progress.since_best += 1
    if progress.best is None or candidate.merit(limit) > progress.best.merit(limit):
        progress.best, progress.since_best = candidate, 0
    progress.keep_skill(candidate)
    progress.rounds += 1
    progress.figures = {
        "real_sp": candidate.sp,
        **({"real_xp_max": strongest} if scores else {}),
        "real_shaped_sp": float(np.mean([e.shaped for e in own])) / horizon,
        "round": progress.rounds,
    }
    return candidate


def describe_round(progress: LaterMemberProgress, scored: Candidate, score_name: str) -> str:
    """A round in a line."""
    met = f", strongest XP {scored.xp:.2f}" if "real_xp_max" in progress.figures else ""
    scores = f"SP {scored.sp:.2f}{met} {score_name}"
    return f"round {progress.rounds}: {scores}, {progress.steps:,} steps"


def describe_imagination(progress: LaterMemberProgress, phase: Phase2Config, member: int, most: int) -> Phase:
    """The phase of a later member: updates of at most so many rounds, those of the rounds so far done."""
    total, done = (count_imagination(phase, rounds) for rounds in (most, progress.rounds))
    return Phase(IMAGINATION, total, member, done=done)


def describe_updates(progress: LaterMemberProgress, member: int, figures: dict[str, float], done: int) -> Progress:
    """So many of the member's updates in imagination are done."""
    shown = {"steps": progress.steps, "entropy": round(figures["agent/entropy"], 2), **progress.best_shown}
    return Progress(member, progress.steps, figures, done=done, shown=shown)


def describe_later_round(
    progress: LaterMemberProgress, member: int, scored: Candidate, score_name: str, trouble: str
) -> Round:
    """The round that has ended, with its figures, and its line with signs of trouble."""
    note = f"member {member}, {describe_round(progress, scored, score_name)}"
    note += f"; {trouble}" if trouble else ""
    return Round(member, progress.steps, progress.figures, note=note, number=progress.rounds)


@dataclass(frozen=True)
class ImaginationPlan:
    """Agent updates of one round: how many, how many came before, share of starts from the member's own data."""

    updates: int
    done: int
    new_share: float


def plan_imagination(rounds: int, phase: Phase2Config) -> ImaginationPlan:
    """Of the round after `rounds`: the first one has no data of its own, and more updates."""
    if rounds == 0:
        return ImaginationPlan(phase.first_updates, 0, 0.0)
    done = phase.first_updates + (rounds - 1) * phase.updates_per_round
    return ImaginationPlan(phase.updates_per_round, done, phase.starts_new)
