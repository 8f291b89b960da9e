"""Cross-play figures as JSON, CSV, Markdown and a table for the terminal.

Keys of the JSON object (`to_json`); a figure is `{"mean": x, "standard_error": x}`, null where unknown:

    format, format_version   "popgen-crossplay", 1
    environment              as in the population's manifest: name, params, fingerprint, cooking, horizon, score_name
    method, members          training method; ids in the order of the matrix
    mates                    of the members, in their order: the other of the pair that it was trained in, itself where
                             there is none; missing in a report of an older version (see `restate_pairs`)
    training_seed            of the population's run
    episodes, seed           episodes per ordered pair, seed of the evaluation
    unit                     of every score, such as dishes
    steps                    environment steps by ledger kind: {"evaluation": N}
    sp, xp                   figures: mean over members of play with the mate; mean cross-play over ordered pairs of
                             different members that are no mates
    matrix                   mean and standard_error, lists of rows: row = seat 0, column = seat 1
    beside                   random and idle: `both` seats, partner in `seat_0`, partner in `seat_1`, all figures
    obstruction              random and idle: is xp below `beside.*.both` by more than two standard errors; comparisons:
                             how many single ones were made; level: the chance of finding any by chance alone; pairs:
                             each that was found: pair, partner, member, xp, beside and p_value (corrected by Holm)
    mixed_play               what remains of a member's self-play after cross-play, empty where members were trained in
                             pairs: episodes; members: member, and
                             seat_0, seat_1 (the seat it had before), each with kept and reset (its memory at the
                             switch): shares as figures, and least (of its partners, kept), and fresh (the share
                             that a new game of as many steps gives: what is less is lost to partners); cases: member,
                             partner, seat, kept, reset and ordinary (scores after the switch) and fresh
    event_names, event_weights
    pairs                    every pairing: seat_0, seat_1 (a member's number, "random" or "idle"), score, reward and
                             shaped_return (sum over seats) as figures; scores of the episodes; events: mean count per
                             episode, a list per seat in the order of event_names

Standard errors are over episodes; they say nothing of how other members would do.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from popgen.errors import UserError
from popgen.evaluation.crossplay import LEVEL, PARTNERS, CrossPlayResult, Obstruction, Pairing
from popgen.evaluation.estimates import Estimate
from popgen.jsonable import jsonable
from popgen.population.manifest import EnvironmentInfo
from popgen.reports.frames import Sheet, estimate_text, number_text, to_csv

CSV_FIELDS = ("seat_0", "seat_1", "pairing", "figure", "seat", "mean", "standard_error", "episodes")
"""Long format: one figure a row. `pairing` is SP, XP, random, idle, or itself, of a member of a pair with itself;
`figure` is score, reward, shaped_return or event:NAME; `seat` is 0 or 1 for events, empty for the team's figures."""

CORNER = "seat 0 / seat 1"
"""Head of the first column of the matrix: rows are seat 0, columns seat 1."""


def to_dict(result: CrossPlayResult) -> dict[str, Any]:
    """The JSON object of the module's docstring."""
    beside = {
        partner: {
            "both": result.beside(partner).to_dict(),
            "seat_0": result.beside(partner, 0).to_dict(),
            "seat_1": result.beside(partner, 1).to_dict(),
        }
        for partner in PARTNERS
    }
    return {
        "format": "popgen-crossplay",
        "format_version": 1,
        "environment": result.environment.model_dump(mode="json"),
        "method": result.method,
        "members": list(result.members),
        "mates": [result.mate_of(member) for member in result.members],
        "training_seed": result.training_seed,
        "episodes": result.episodes,
        "seed": result.seed,
        "unit": result.environment.score_name,
        "steps": {"evaluation": result.steps},
        "sp": result.sp.to_dict(),
        "xp": result.xp.to_dict(),
        "matrix": {
            "mean": jsonable(result.to_frame("mean").to_numpy().tolist()),
            "standard_error": jsonable(result.to_frame("error").to_numpy().tolist()),
        },
        "beside": beside,
        "obstruction": _describe_obstructions(result),
        "mixed_play": _describe_mixed(result),
        "event_names": list(result.event_names),
        "event_weights": list(result.event_weights),
        "pairs": [_describe_pairing(pairing) for pairing in result.pairings.values()],
    }


def _describe_obstructions(result: CrossPlayResult) -> dict[str, Any]:
    return {
        **result.obstruction,
        "comparisons": len(result.comparisons),
        "level": LEVEL,
        "pairs": [_describe_obstruction(one) for one in result.obstructions],
    }


def _describe_obstruction(one: Obstruction) -> dict[str, Any]:
    return {
        "pair": list(one.pair),
        "partner": one.partner,
        "member": one.member,
        "xp": one.xp.to_dict(),
        "beside": one.beside.to_dict(),
        "p_value": one.p_value,
    }


def _describe_mixed(result: CrossPlayResult) -> dict[str, Any]:
    cases = [
        {
            **{"member": one.member, "partner": one.partner, "seat": one.seat},
            **{name: getattr(one, name).to_dict() for name in ("kept", "reset", "ordinary", "fresh")},
        }
        for one in result.mixed
    ]
    members = [
        {
            "member": member,
            **{f"seat_{seat}": _describe_shares(result, member, seat) for seat in (0, 1)},
            "fresh": result.fresh_share(member).to_dict(),
        }
        for member in (result.members if cases else ())
    ]
    return {"episodes": -(-result.episodes // 2), "members": members, "cases": cases}


def _describe_shares(result: CrossPlayResult, member: int, seat: int) -> dict[str, Any]:
    own = [one.share().mean for one in result.mixed if (one.member, one.seat) == (member, seat)]
    known = [share for share in own if math.isfinite(share)]
    ways = {"kept": result.share(member, seat), "reset": result.share(member, seat, reset=True)}
    return {**{name: share.to_dict() for name, share in ways.items()}, "least": min(known) if known else None}


def _describe_pairing(pairing: Pairing) -> dict[str, Any]:
    return {
        "seat_0": pairing.seats[0],
        "seat_1": pairing.seats[1],
        "score": pairing.score.to_dict(),
        "reward": pairing.reward.to_dict(),
        "shaped_return": pairing.shaped.to_dict(),
        "scores": [float(score) for score in pairing.scores],
        "events": pairing.events.tolist(),
    }


def to_json(result: CrossPlayResult) -> str:
    """`to_dict` as text."""
    return json.dumps(to_dict(result), indent=2, allow_nan=False) + "\n"


def figures_csv(result: CrossPlayResult) -> str:
    """Long format, one figure a row, with the header CSV_FIELDS."""
    return to_csv(_list_figures(result), CSV_FIELDS)


def name_pairing(seats: tuple[str, str], mates: Mapping[str, str]) -> str:
    """SP, XP, random, idle, or itself, of a member of a pair with itself.

    Args:
        seats: label of the player in each seat.
        mates: label of a member -> that of its mate; those that are missing have none.
    """
    if partner := next((name for name in PARTNERS if name in seats), None):
        return partner
    if mates.get(seats[0], seats[0]) == seats[1]:
        return "SP"
    return "itself" if seats[0] == seats[1] else "XP"


def _list_figures(result: CrossPlayResult) -> Iterator[dict[str, Any]]:
    mates = {str(member): str(result.mate_of(member)) for member in result.members}
    for pairing in result.pairings.values():
        first, second = pairing.seats
        kind = name_pairing(pairing.seats, mates)
        head = {"seat_0": first, "seat_1": second, "pairing": kind, "episodes": result.episodes}
        for name in ("score", "reward", "shaped"):
            figure = "shaped_return" if name == "shaped" else name
            yield head | {"figure": figure} | getattr(pairing, name).to_dict()
        for seat, counts in enumerate(pairing.events):
            for name, count in zip(result.event_names, counts, strict=True):
                yield head | {"figure": f"event:{name}", "seat": seat, "mean": float(count)}


def list_mates(report: Mapping[str, Any]) -> dict[int, int]:
    """Member -> its mate, itself where it has none."""
    return dict(zip(report["members"], report.get("mates", report["members"]), strict=True))


def has_pairs(report: Mapping[str, Any]) -> bool:
    """Some member was trained in a pair."""
    return any(member != mate for member, mate in list_mates(report).items())


def list_own_scores(report: Mapping[str, Any]) -> dict[int, float | None]:
    """Member -> mean score with its mate over both seatings, or with itself; None where it is not known."""
    own = estimate_play(report, list_mates(report))
    return {member: None if math.isnan(play.mean) else play.mean for member, play in own.items()}


def estimate_play(report: Mapping[str, Any], partners: Mapping[int, int | str]) -> dict[int, Estimate]:
    """Member -> score with its partner, mean over the seatings that are known; NaN where none is.

    Args:
        report: of an evaluation.
        partners: member -> another member's number, its own, `random` or `idle`.
    """
    known = {(one["seat_0"], one["seat_1"]): one["score"] for one in report["pairs"]}
    found = {}
    for member, partner in partners.items():
        seats = dict.fromkeys([(str(member), str(partner)), (str(partner), str(member))])
        both = [read_estimate(known[one]) for one in seats if one in known and known[one]["mean"] is not None]
        found[member] = Estimate.average(both)
    return found


def restate_pairs(report: Mapping[str, Any], mates: Sequence[int]) -> dict[str, Any]:
    """The JSON object with what it says of pairs put right, where an older version took their members for strangers.

    Then `sp` was play of a member with itself, `xp` held play with the mate, and so did obstruction; mixed play went on
    with one member in both seats. They are computed anew from its `pairs`; mixed play is emptied.

    Args:
        report: of an evaluation.
        mates: number of the mate of each member of its population, from 1.
    """
    own = report["members"] if "mates" in report else [mates[member - 1] for member in report["members"]]
    if own == report["members"]:
        return dict(report)
    pairs = zip(report["members"], own, strict=True)
    result = _read_result(report, {member: mate for member, mate in pairs if member != mate})
    return {**report, "mates": own, **_describe_play(result), "mixed_play": _describe_mixed(result)}


def leave_out(report: Mapping[str, Any], members: Collection[int]) -> dict[str, Any]:
    """The JSON object as if some members were not there, without `matrix` and `beside`.

    Args:
        report: of an evaluation.
        members: to leave out; with none of them the report is as it was.
    """
    if not members:
        return dict(report)
    kept = [member for member in report["members"] if member not in members]
    mates = {member: mate for member, mate in list_mates(report).items() if member in kept}
    result = replace(_read_result(report, {m: mate for m, mate in mates.items() if m != mate}), members=tuple(kept))
    out = {str(member) for member in members}
    mixed = {**report["mixed_play"]}
    for part in ("members", "cases"):
        mixed[part] = [one for one in mixed.get(part, []) if not {one["member"], one.get("partner")} & set(members)]
    changed = {
        "members": kept,
        "mates": list(mates.values()),
        **_describe_play(result),
        "mixed_play": mixed,
        "pairs": [one for one in report["pairs"] if not {one["seat_0"], one["seat_1"]} & out],
    }
    return {key: value for key, value in report.items() if key not in ("matrix", "beside")} | changed


def _describe_play(result: CrossPlayResult) -> dict[str, Any]:
    return {"sp": result.sp.to_dict(), "xp": result.xp.to_dict(), "obstruction": _describe_obstructions(result)}


def _read_result(report: Mapping[str, Any], mates: Mapping[int, int]) -> CrossPlayResult:
    """All that SP, XP and obstruction follow from."""
    return CrossPlayResult(
        environment=EnvironmentInfo.model_validate(report["environment"]),
        method=report["method"],
        event_names=tuple(report["event_names"]),
        event_weights=tuple(report["event_weights"]),
        members=tuple(report["members"]),
        episodes=report["episodes"],
        seed=report["seed"],
        training_seed=report["training_seed"],
        steps=report["steps"]["evaluation"],
        pairings={(one["seat_0"], one["seat_1"]): _read_pairing(one) for one in report["pairs"]},
        mates=mates,
    )


def _read_pairing(told: Mapping[str, Any]) -> Pairing:
    score, reward, shaped = (read_estimate(told[name]) for name in ("score", "reward", "shaped_return"))
    seats = (told["seat_0"], told["seat_1"])
    return Pairing(seats, np.array(told.get("scores", [])), score, reward, shaped, np.array(told["events"]))


def read_estimate(figure: Mapping[str, float | None]) -> Estimate:
    """Of a figure of the JSON object."""
    mean, error = figure["mean"], figure["standard_error"]
    return Estimate(math.nan if mean is None else mean, math.nan if error is None else error)


def summary(report: Mapping[str, Any]) -> list[str]:
    """The headline figures of the JSON object, a line of plain text each."""
    unit, beside = report["unit"], report["beside"]
    lines = [PAIRS_LINE] if has_pairs(report) else []
    lines += [f"SP mean {estimate_text(report['sp'])} {unit}", f"XP mean {estimate_text(report['xp'])} {unit}"]
    for partner in PARTNERS:
        row = beside[partner]
        parts = ", ".join(f"partner in seat {seat} {estimate_text(row[f'seat_{seat}'])}" for seat in (0, 1))
        lines.append(f"beside {partner} {estimate_text(row['both'])} {unit} ({parts})")
    if report["episodes"] == 1:
        lines.append("obstruction: not judged, since one episode has no standard error; ask for more episodes")
    lines += list_warnings(report)
    if shares := _list_shares(report):
        means = [f"{name} {min(values):.2f} to {max(values):.2f}" for name, values in shares.items()]
        lines.append(f"self-play that remains after cross-play, by member: {', '.join(means)}")
    lines.append(f"{report['episodes']} episodes per pair, {report['steps']['evaluation']:,} environment steps")
    return lines


PAIRS_LINE = "members of pairs: SP is play with the mate, XP is across pairs, mixed play is left out"
"""What is different where members were trained in pairs."""

GOOD_SHARE = 0.9
"""Share of ordinary self-play below which a member's play after cross-play is flagged."""

_SHOWN = 10
"""Pairs that a line names."""


def list_warnings(report: Mapping[str, Any]) -> list[str]:
    """What speaks against low cross-play as a sign of different conventions, a line each; empty where nothing does."""
    low, lines = report["obstruction"], []
    if blocked := [partner for partner in PARTNERS if low[partner]]:
        lines.append(f"obstruction: XP is below play beside {' and '.join(blocked)} partners")
    if pairs := sorted({tuple(one["pair"]) for one in low["pairs"]}):
        names = ", ".join(f"{i}-{j}" for i, j in pairs[:_SHOWN]) + (", ..." if len(pairs) > _SHOWN else "")
        mates = list_mates(report)
        met = sum(j not in (i, mate) for i, mate in mates.items() for j in mates)
        count = f"{len(pairs)} of {met} pairs"
        lines.append(
            f"obstruction: {count} are worse than a random or idle partner (p <= {low.get('level', LEVEL)}): {names}"
        )
    short = [
        f"{one['member']} (seat {seat}: {share:.2f})"
        for one in _list_mixed(report)
        for seat in (0, 1)
        if (share := one[f"seat_{seat}"]["kept"]["mean"]) is not None and share < GOOD_SHARE
    ]
    if short:
        more = ", ..." if len(short) > _SHOWN else ""
        told = f"members with less than {GOOD_SHARE} of their self-play after cross-play"
        lines.append(f"{told}: {', '.join(short[:_SHOWN])}{more}")
    return lines


def _list_mixed(report: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Members' shares; none in a report of an older version."""
    return report.get("mixed_play", {}).get("members", [])


def _list_shares(report: Mapping[str, Any]) -> dict[str, list[float]]:
    """Way of going on and seat -> the members' shares; nothing where none is known."""
    found: dict[str, list[float]] = {}
    for one in _list_mixed(report):
        for seat in (0, 1):
            for way in ("kept", "reset"):
                share = one[f"seat_{seat}"][way]["mean"]
                if share is not None:
                    found.setdefault(f"seat {seat}, memory {way}", []).append(share)
    return found


def mixed_play_sheet(report: Mapping[str, Any]) -> Sheet | None:
    """Shares of self-play after cross-play, a member a row; None where there are none."""
    cells, seats = [], ("seat_0", "seat_1")
    remember = any(one[seat]["kept"] != one[seat]["reset"] for one in _list_mixed(report) for seat in seats)
    ways = {"kept": " kept", "reset": " reset"} if remember else {"kept": ""}
    for one in _list_mixed(report):
        row = {"member": str(one["member"])}
        for seat in (0, 1):
            here = one[f"seat_{seat}"]
            row |= {f"seat {seat}{name}": estimate_text(here[way]) for way, name in ways.items()}
            row[f"least {seat}"] = number_text(here["least"])
        if "fresh" in one:  # not in a report of an older version
            row["new game"] = estimate_text(one["fresh"])
        cells.append(row)
    if not cells:
        return None
    memory = " with memory kept and reset" if remember else ""
    title = f"share of ordinary self-play after cross-play, by seat{memory}; least of its partners"
    title += "; and that of a new game of as many steps" if "new game" in cells[0] else ""
    return Sheet(title, pd.DataFrame(cells))


def matrix_sheet(report: Mapping[str, Any], *, narrow: bool = False) -> Sheet:
    """The matrix of the JSON object; `narrow` puts errors below their means, so that six members fit 80 columns."""
    members = [str(member) for member in report["members"]]
    long = pd.DataFrame(report["pairs"])
    long["text"] = [estimate_text(score).replace(" ± ", "\n±" if narrow else " ± ") for score in long["score"]]
    texts = long.pivot(index="seat_0", columns="seat_1", values="text").loc[members, [*members, *PARTNERS]]
    frame = texts.rename_axis(index=CORNER.replace(" / ", "\n/ ") if narrow else CORNER, columns=None).reset_index()
    title = f"{report['environment']['name']}: {report['unit']} per episode (± standard error)"
    own = enumerate(map(str, list_mates(report).values()))
    bold = frozenset((row, 1 + members.index(mate)) for row, mate in own if mate in members)
    return Sheet(title, frame, bold=bold)


def to_markdown(report: Mapping[str, Any]) -> str:
    """The matrix and the headline figures."""
    sheet = matrix_sheet(report)
    mixed = mixed_play_sheet(report)
    more = [] if mixed is None else [mixed.title, "", mixed.to_markdown(), ""]
    lines = [sheet.title, "", sheet.to_markdown(), "", *more, *(f"- {line}" for line in summary(report))]
    return "\n".join(lines) + "\n"


def write_report(result: CrossPlayResult, folder: str | Path) -> dict[str, Path]:
    """Write crossplay.json, .csv, .md, .png and .svg; gives the paths by suffix.

    Raises:
        UserError: the folder cannot be written.
    """
    from popgen.reports.charts.matrix_chart import crossplay_heat_map

    folder = Path(folder)
    paths = {suffix: folder / f"crossplay.{suffix}" for suffix in ("json", "csv", "md", "png", "svg")}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        paths["json"].write_text(to_json(result), encoding="utf-8")
        paths["csv"].write_text(figures_csv(result), encoding="utf-8")
        paths["md"].write_text(to_markdown(to_dict(result)), encoding="utf-8")
        crossplay_heat_map(result, [paths["png"], paths["svg"]])
    except OSError as error:
        raise UserError(str(folder), f"cannot be written: {error.strerror}", "choose another folder") from error
    return paths
