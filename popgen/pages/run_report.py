"""`popgen report`: a run or a population as one page that needs no other file, also the population's card."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from popgen.errors import UserError
from popgen.pages.game_recording import record_games
from popgen.pages.page_template import fill_page
from popgen.pages.replay_files import stage_of, to_replay
from popgen.pages.report_charts import colour_matrix, draw_curves, draw_diagnostics, draw_steps, title_run
from popgen.pages.report_source import ReportSource
from popgen.population.member_pairs import find_mates
from popgen.reports.crossplay_report import has_pairs, list_mates
from popgen.reports.frames import estimate_text, steps_text
from popgen.reports.method_titles import title_of
from popgen.reports.run_findings import Finding, explain_run, explain_scores, next_commands
from popgen.reports.run_record import REAL, RunRecord
from popgen.runs.provenance import read_attempts, recipe_differences, repeat_command
from popgen.types import Kind

CARD = "card.html"
"""Name of the page in a population's folder."""

_GAMES = 40
"""Replays of a report at most: eight members' self-play and their pairs are 36."""


def choose_games(mates: Sequence[int]) -> list[tuple[str, str]]:
    """Who plays the replays: each member with its mate or itself, then others, in both seats where they are few.

    Args:
        mates: number of each member's mate, from 1; its own where it has none.
    """
    names = [str(member) for member in range(1, len(mates) + 1)]
    own = [(name, str(mate)) for name, mate in zip(names, mates, strict=True)]
    pairs = [(i, j) for i in names for j in names if int(i) < int(j) and (i, j) not in own]
    both = [*pairs, *((j, i) for i, j in pairs)]
    return [*own, *(both if len(own) + len(both) <= _GAMES else pairs)][:_GAMES]


def report_page(source: ReportSource, *, seed: int = 0) -> str:
    """The page as text.

    Args:
        source: see `popgen.pages.report_source`.
        seed: of the replays.
    """
    run, population = source.run, source.population
    mates = find_mates(population.members)
    matches = choose_games(mates)
    replay = to_replay(record_games(population, matches, seed), population.make_env())
    first_pair = next((n for n, (i, j) in enumerate(matches) if mates[int(i) - 1] != int(j)), None)
    labels = [*map(str, run.scores["members"]), "random", "idle"]
    return fill_page(
        "report.html.jinja",
        title=title_run(run),
        scripts=("replay_player.js",),
        data={"replay": replay},
        facts=_list_facts(source),
        findings=[finding.as_dict() for finding in list_findings(source)],
        labels=labels,
        mates={str(member): str(mate) for member, mate in list_mates(run.scores).items()},
        paired=has_pairs(run.scores),
        matrix=colour_matrix(dict(run.scores)),
        unit=run.scores["unit"],
        episodes=run.scores["episodes"],
        curves=draw_curves(run),
        steps=_table_steps(run),
        step_charts=draw_steps(run),
        kept=_table_kept(run.scores),
        mixed=_table_mixed_play(source),
        diagnostics=draw_diagnostics(source),
        stage=stage_of(replay, [0] if first_pair is None else [0, first_pair]),
        seed=seed,
        provenance=_list_provenance(source),
        differences=_list_differences(source),
        commands=next_commands(_name_place(source), len(population)),
    )


def _name_place(source: ReportSource) -> str:
    """The run as a command takes it; a page that others read tells no folders above that."""
    if source.folder is None:
        return "POPULATION"
    return source.folder.name if source.folder.is_absolute() else str(source.folder)


def list_findings(source: ReportSource) -> list[Finding]:
    """What the numbers mean."""
    return explain_run(source.run) if source.folder else explain_scores(source.run.scores)


def write_run_report(source: ReportSource, out: Path | None = None, *, seed: int = 0) -> dict[str, Path]:
    """Write the page of a run or a population, and the population's card.

    Args:
        source: see `popgen.pages.report_source`.
        out: the page; RUN/report/report.html, or POPULATION/evaluation/report.html.
        seed: of the replays.

    Returns:
        Paths by name: report and card; no card where the population's folder cannot be written.

    Raises:
        UserError: the page cannot be written.
    """
    folder = source.folder / "report" if source.folder else source.population.path / "evaluation"
    place = out or folder / "report.html"
    page = report_page(source, seed=seed).encode()
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(page)
    except OSError as error:
        raise UserError(str(place), f"cannot be written: {error.strerror}", "choose another place") from error
    card = source.population.path / CARD
    try:
        card.write_bytes(page)
    except OSError:  # somebody else's population: its card is theirs
        return {"report": place}
    return {"report": place, "card": card}


def _list_facts(source: ReportSource) -> list[dict[str, str]]:
    """Headline figures: name, value and a word below."""
    run, scores = source.run, source.run.scores
    unit = scores["unit"]
    itself, another = ("its mate", "a member of another pair") if has_pairs(scores) else ("itself", "another member")
    real = sum(member.real for member in run.members)
    simulated = sum(member.steps.get(str(Kind.SIMULATED), 0) for member in run.members)
    seconds = [member.seconds for member in run.members if member.seconds is not None]
    facts = [
        {"name": "SP", "value": estimate_text(scores["sp"]), "below": f"{unit} with {itself}"},
        {"name": "XP", "value": estimate_text(scores["xp"]), "below": f"{unit} with {another}"},
        {"name": "members", "value": str(len(run.members)), "below": title_of(run.method)},
        {"name": "real environment steps", "value": steps_text(real), "below": "of training, all members"},
    ]
    if simulated:
        facts.append({"name": "simulated steps", "value": steps_text(simulated), "below": "of the exact simulator"})
    if seconds:
        facts.append({"name": "training", "value": f"{sum(seconds) / 60:.1f} min", "below": "all members"})
    return facts


def _table_steps(run: RunRecord) -> dict[str, Any]:
    """Environment steps by member and kind; simulated ones stand apart."""
    shown = [str(kind) for kind in REAL if any(member.steps.get(str(kind)) for member in run.members)]
    simulated = str(Kind.SIMULATED)
    with_simulated = any(member.steps.get(simulated) for member in run.members)
    rows = []
    for member in run.members:
        cells = [f"{member.steps.get(kind, 0):,}" for kind in shown]
        cells += [f"{member.real:,}"] + ([f"{member.steps.get(simulated, 0):,}"] if with_simulated else [])
        rows.append((f"member {member.member}", [*cells, _minutes_text(member.seconds)]))
    sums = [sum(member.steps.get(kind, 0) for member in run.members) for kind in shown]
    sums.append(sum(member.real for member in run.members))
    sums += [sum(member.steps.get(simulated, 0) for member in run.members)] if with_simulated else []
    times = [member.seconds for member in run.members if member.seconds is not None]
    rows.append(("all", [*(f"{value:,}" for value in sums), _minutes_text(sum(times) if times else None)]))
    head = [*shown, "real in all", *([simulated] if with_simulated else []), "minutes"]
    return {"head": head, "rows": rows, "evaluation": run.evaluation_steps, "lost": run.lost_steps}


def _minutes_text(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds / 60:.1f}"


def _table_kept(scores: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """What remains of each member's self-play after cross-play, by the seat it had before; empty where not played."""
    rows = []
    for one in (scores.get("mixed_play") or {}).get("members", []):
        cells = [estimate_text(one[seat][memory]) for seat in ("seat_0", "seat_1") for memory in ("kept", "reset")]
        rows.append((f"member {one['member']}", cells))
    return rows


def _table_mixed_play(source: ReportSource) -> list[tuple[str, list[str]]]:
    """Mixed play in training: steps, episodes and their mean score; empty where there was none."""
    if source.ledger is None:
        return []
    totals: dict[int, list[float]] = {}
    for entry in source.ledger:
        if entry.kind is Kind.MP:
            total = totals.setdefault(entry.member, [0, 0, 0.0])
            total[:] = [total[0] + entry.steps, total[1] + entry.episodes, total[2] + entry.score]
    return [
        (f"member {member}", [f"{steps:,.0f}", f"{episodes:,.0f}", f"{score / episodes:.2f}" if episodes else "-"])
        for member, (steps, episodes, score) in sorted(totals.items())
    ]


def _list_provenance(source: ReportSource) -> list[tuple[str, str]]:
    """Name and value of all that says where the figures come from."""
    run, manifest = source.run, source.population.manifest
    facts = [("run", run.run_id)]
    if source.config is not None:
        facts.append(("command", repeat_command(source.config)))
    attempts = read_attempts(source.folder) if source.folder else []
    commits = list(dict.fromkeys(_commit_text(attempt) for attempt in attempts))
    facts.append(("commit", "; ".join(commits) or "not recorded"))
    facts += [("seed", str(run.seed)), ("config", manifest.config_digest), ("rules", run.environment.fingerprint)]
    if run.environment.params:
        told = ", ".join(f"{name}={value}" for name, value in run.environment.params.items() if name != "grid")
        facts.append(("environment", f"{run.environment.name} ({told})"))
    if attempts:
        facts.append(("began", f"{attempts[0].get('began')}, {len(attempts)} attempt{'s' * (len(attempts) > 1)}"))
    versions = ", ".join(f"{name} {value}" for name, value in manifest.versions.model_dump().items())
    scores = run.scores
    told = f"{scores['episodes']} episodes a pair, seed {scores['seed']}, {scores['steps']['evaluation']:,} steps"
    return [*facts, ("versions", versions), ("machine", platform.machine()), ("evaluation", told)]


def _commit_text(attempt: dict[str, Any]) -> str:
    commit = attempt.get("commit")
    return "no checkout" if not commit else f"{commit}{' with changes' if attempt.get('changed') else ''}"


def _list_differences(source: ReportSource) -> list[Sequence[str]]:
    """Field, the recipe's value and the run's, where they differ."""
    if source.config is None:
        return []
    found = recipe_differences(source.config)
    return [(name, _value_text(theirs), _value_text(own)) for name, (theirs, own) in found.items()]


def _value_text(value: Any) -> str:
    text = "not set" if value is None else str(value)
    return text if len(text) <= 200 else f"{text[:197]}..."
