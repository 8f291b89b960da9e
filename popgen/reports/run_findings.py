"""What a population's numbers mean, in sentences: is it good, is it diverse, and is its low cross-play honest?"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from popgen.errors import UserError
from popgen.methods.registry import METHODS
from popgen.reports import paper_figures as paper
from popgen.reports.comparison import SHARE_SP, SHARE_XP
from popgen.reports.crossplay_report import has_pairs, leave_out, list_own_scores, list_warnings
from popgen.reports.frames import number_text
from popgen.reports.method_titles import title_of
from popgen.reports.run_record import RunRecord, differences, read_run

WEAK = 0.5
"""A member is weak with less self-play than this share of the best member's."""

_PENALTY, _OF_PENALTY = "lambda_xp", ("lambda_", "warmup")
_LOOKED_AT = 500


@dataclass(frozen=True)
class Finding:
    """A sentence about a population.

    Attributes:
        text: without a full stop.
        good: whether that is as it should be; None where it is neither.
    """

    text: str
    good: bool | None = None

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {"text": self.text, "good": self.good}


def explain_run(run: RunRecord) -> list[Finding]:
    """All that can be said of a finished run."""
    return [*explain_scores(leave_out(run.scores, run.unfinished), run.weak_members), *_compare_with_control(run)]


def explain_scores(scores: Mapping[str, Any], weak_members: Sequence[str] = ()) -> list[Finding]:
    """What an evaluation (`popgen.reports.crossplay_report`) says by itself, and who of its run does not play."""
    members = [Finding(line, False) for line in weak_members] or _judge_members(scores)
    return [*_judge_self_play(scores), *members, *_judge_cross_play(scores), *_judge_obstruction(scores)]


def _judge_self_play(scores: Mapping[str, Any]) -> Iterator[Finding]:
    """SP beside the paper's, of the same method where it has it."""
    layout, mean = scores["environment"]["name"], scores["sp"]["mean"]
    if scores["method"] in METHODS and METHODS[scores["method"]].trains_ego:
        yield Finding("an ego agent: `popgen evaluate EGO --with POPULATION` tells what it is good for; SP is no aim")
        return
    row = paper.find_row(layout, title_of(scores["method"])) or paper.find_row(layout, paper.OWN_METHOD)
    told = f"SP {number_text(mean)} {scores['unit']}"
    if mean is None:
        return
    if row is None:
        yield Finding(f"{told}: the paper has no figure for {layout} to compare it with")
        return
    beside = f"the paper's {row.method} has {row.sp:g} with 8 members"
    if row.sp <= 0:
        yield Finding(f"{told}; {beside}")
        return
    good = mean >= SHARE_SP * row.sp
    yield Finding(f"{'good' if good else 'weak'} for this layout: {told}; {beside}", good)


def _judge_members(scores: Mapping[str, Any]) -> Iterator[Finding]:
    """Is one of them much weaker than the best?"""
    known = {member: score for member, score in list_own_scores(scores).items() if score is not None}
    if len(known) < 2 or max(known.values()) <= 0:
        return
    best = max(known.values())
    weak = [f"{member} ({score:.2f})" for member, score in known.items() if score < WEAK * best]
    itself, themselves = ("its mate", "their mates") if has_pairs(scores) else ("itself", "themselves")
    if weak:
        who = f"member{'s' if len(weak) > 1 else ''} {', '.join(weak)}"
        yield Finding(f"weak with {themselves if len(weak) > 1 else itself}: {who}; the best has {best:.2f}", False)
    else:
        least = min(known, key=lambda member: known[member])
        yield Finding(f"every member plays with {itself}; the weakest is {least} with {known[least]:.2f}", True)


def _judge_cross_play(scores: Mapping[str, Any]) -> Iterator[Finding]:
    """Is XP low beside SP?"""
    sp, xp = scores["sp"]["mean"], scores["xp"]["mean"]
    if xp is None or sp is None:
        yield Finding(f"one {'pair' if has_pairs(scores) else 'member'}: there is no cross-play")
    elif sp <= 0:
        yield Finding(f"XP {xp:.2f} says nothing while SP is {sp:.2f}")
    elif xp <= SHARE_XP * sp:
        yield Finding(f"diverse: XP {xp:.2f} is {max(0.0, xp / sp):.0%} of SP", True)
    else:
        yield Finding(f"not very diverse: members get {xp / sp:.0%} of SP with each other (XP {xp:.2f})", False)


def _judge_obstruction(scores: Mapping[str, Any]) -> Iterator[Finding]:
    """Is cross-play worse than play beside somebody who does nothing useful, and what remains after it?"""
    if scores["xp"]["mean"] is None:
        return
    if scores["episodes"] < 2:
        yield Finding("obstruction cannot be judged by one episode a pair: evaluate with --episodes 20")
        return
    warnings = list_warnings(scores)
    yield from (Finding(text, False) for text in warnings)
    if not any(text.startswith("obstruction") for text in warnings):
        yield Finding("no obstruction found: no pair is worse than play beside a random or idle partner", True)


def _compare_with_control(run: RunRecord) -> Iterator[Finding]:
    """How much of the low cross-play is the penalty's work? A run without it, all else equal, tells."""
    field = next((name for name in run.settings if name.rpartition(".")[2] == _PENALTY), None)
    xp = run.scores["xp"]["mean"]
    if xp is None:
        return
    if field is None or not run.settings[field]:
        yield Finding("trained without a penalty on cross-play: what XP is low here, it is by chance")
        return
    control = find_control(run, field)
    if control is None:
        yield Finding(f"not known: XP without the penalty; a run with {field}=0 beside this one would tell")
        return
    other = control.scores["xp"]["mean"]
    told = f"with {field}=0 ({control.run_id}) XP is {number_text(other)}, here {number_text(xp)}"
    yield Finding(told, None if other is None else xp < other)


def find_control(run: RunRecord, field: str) -> RunRecord | None:
    """A finished run beside this one with the same settings but a penalty (`field`) of 0; the same seed if there is."""
    section, _, last = field.rpartition(".")
    found = []
    for folder in sorted(run.path.resolve().parent.iterdir())[:_LOOKED_AT]:
        try:
            values = json.loads((folder / "config.json").read_text(encoding="utf-8"))
            if values["method"] != run.method or values[section][last] != 0:
                continue
            other = read_run(folder)
        except (OSError, ValueError, KeyError, TypeError, UserError):
            continue
        names = (name.rpartition(".")[2] for name in differences(run, other))
        if other.environment.fingerprint == run.environment.fingerprint and all(
            name.startswith(_OF_PENALTY) for name in names
        ):
            found.append(other)
    return min(found, key=lambda other: (other.seed != run.seed, other.run_id), default=None)


def next_commands(folder: str | Path, members: int) -> list[tuple[str, str]]:
    """Commands to go on with and what each does; `folder` is a run's or a population's."""
    place = shlex.quote(str(folder))
    second = 2 if members > 1 else 1
    return [
        (f"popgen play {place} --watch 1 {second}", "watch members play"),
        (f"popgen play {place}", "play with a member in the browser"),
        (f"popgen report {place}", "write the report again"),
        (f"popgen evaluate {place} --episodes 100", "smaller errors"),
    ]
