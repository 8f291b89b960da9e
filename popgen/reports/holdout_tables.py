"""A hold-out evaluation as tables of 80 columns and Markdown, made from its JSON object."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd

from popgen.evaluation.holdout_figures import ALL, CROSS, OWN
from popgen.reports.frames import UNKNOWN, Sheet, estimate_text, number_text
from popgen.reports.method_titles import title_of
from popgen.reports.paper_ego_figures import AVERAGES, EGOS, average_by_method


def to_sheets(report: Mapping[str, Any]) -> Iterator[Sheet]:
    """Scores, figures relative to best responses, controls, margins, and the paper's table beside ours."""
    yield _make_score_sheet(report)
    yield _make_relative_sheet(report)
    yield _make_control_sheet(report)
    if report["margins"]:
        yield _make_margin_sheet(report)
    if report["paper"]:
        yield _make_paper_sheet(report)


def to_markdown(report: Mapping[str, Any]) -> str:
    """All tables, the worst pairs and the notes."""
    parts = [f"## {sheet.title}\n\n{sheet.to_markdown()}\n\n" for sheet in to_sheets(report)]
    lines = [f"- {line}\n" for line in list_lines(report)]
    return "".join([f"# Hold-out evaluation: {report['environment']['name']}\n\n", *parts, *lines])


def list_lines(report: Mapping[str, Any]) -> list[str]:
    """The worst pair of each ego, how it does beside its teachers, and the notes."""
    egos = [one["label"] for one in report["egos"]]
    lines = []
    for ego in egos:
        rows = [one for one in report["standings"] if one["ego"] == ego and not _is_apart(report, one["partners"])]
        if rows:
            worst = min((one["worst"] for one in rows), key=lambda one: one["score"])
            place = f"{worst['ego']} in seat {worst['seat']} beside {worst['partner']}"
            lines.append(f"worst of {ego}: {worst['score']:.2f} {report['unit']}, {place}")
    count = f"{report['episodes']} episodes for each pair and seat"
    lines += [_compare_with_best(one) for one in report["standings"] if _is_apart(report, one["partners"], "met")]
    return [*lines, *report["notes"], f"{count}, {report['steps']['evaluation']:,} environment steps"]


def _is_apart(report: Mapping[str, Any], label: str, *kinds: str) -> bool:
    """A group that counts in no average: people, or teachers of an ego."""
    groups = [one for one in report["partners"] if one["label"] == label]
    return any(one.get(kind) for one in groups for kind in kinds or ("human", "met"))


def _compare_with_best(standing: Mapping[str, Any]) -> str:
    """An ego beside those that taught it, as shares of what the best known does with each."""
    mean, least = (number_text(standing[f"br_prox_{name}"]) for name in ("unclipped", "least"))
    place = f"{standing['ego']} beside its training partners {title_of(standing['partners'])}"
    return f"{place}: {mean} of the best known with each on average, {least} with the least"


def _make_score_sheet(report: Mapping[str, Any]) -> Sheet:
    cells = [
        {
            "ego": one["ego"],
            "beside": title_of(one["partners"]),
            "mean": number_text(one["mean"]),
            "SD": number_text(one["sd"]),
            "SE": number_text(one["se"]),
            "low": number_text(one["interval"]["low"]),
            "high": number_text(one["interval"]["high"]),
            "seat 0": number_text(one["seat_0"]),
            "seat 1": number_text(one["seat_1"]),
            "worst": number_text(one["worst"]["score"]),
        }
        for one in report["standings"]
    ]
    title = f"{report['environment']['name']}: {report['unit']} per episode (low, high: 95 % of the mean)"
    return Sheet(title, pd.DataFrame(cells), labels=2)


def _make_relative_sheet(report: Mapping[str, Any]) -> Sheet:
    cells = [
        {
            "ego": one["ego"],
            "beside": title_of(one["partners"]),
            "IQM": number_text(one["br_prox_iqm"]["value"]),
            "low": number_text(one["br_prox_iqm"]["low"]),
            "high": number_text(one["br_prox_iqm"]["high"]),
            "raw": number_text(one["br_prox_unclipped"]),
            "norm": number_text(one["normalised_return"]),
            "regret": number_text(one["regret"]),
            "CVaR": number_text(one["cvar_25"]),
        }
        for one in report["standings"]
    ]
    title = "BR-Prox: IQM clipped at 1 (95 %), raw mean unclipped; normalised return, regret, CVaR of 25 %"
    return Sheet(title, pd.DataFrame(cells), labels=2)


def _make_control_sheet(report: Mapping[str, Any]) -> Sheet:
    cells, mates = [], any(row["mate"] for rows in report["controls"].values() for row in rows)
    for kind, rows in (("ego", report["controls"]["egos"]), ("partner", report["controls"]["partners"])):
        for row in rows:
            figures = {name: _show_control(row[key]) for name, key in _CONTROLS.items() if key != "mate" or mates}
            cells.append({"who": f"{kind} {title_of(row[kind])}", **figures})
    return Sheet("controls: mean ± SE", pd.DataFrame(cells))


def _show_control(figure: Mapping[str, float] | None) -> str:
    return UNKNOWN if figure is None else estimate_text({"mean": figure["mean"], "standard_error": figure["se"]})


_CONTROLS = {"with itself": "alone", "with its mate": "mate", "beside random": "random", "beside idle": "idle"}


def _make_margin_sheet(report: Mapping[str, Any]) -> Sheet:
    cells = [
        {
            "ego": one["ego"],
            "beside": title_of(one["partners"]),
            "gain": f"{one['gain']['value']:+.2f}",
            "95 %": _show_ends(one["gain"]),
        }
        for one in report["margins"]
    ]
    return Sheet(f"more than the control {report['margins'][0]['control']}", pd.DataFrame(cells), labels=2)


def _show_ends(gain: Mapping[str, float | None]) -> str:
    low, high = gain["low"], gain["high"]
    return UNKNOWN if low is None or high is None else f"{low:+.2f} to {high:+.2f}"


def _make_paper_sheet(report: Mapping[str, Any]) -> Sheet:
    """Ours (mean, SD) above the paper's (mean ± as printed); rows are hold-outs, columns egos."""
    egos = [one["label"] for one in report["egos"]]
    ours = {(one["ego"], title_of(one["partners"])): one for one in report["standings"]}
    labels = list(dict.fromkeys(title_of(one["partners"]) for one in report["standings"]))
    cells = []
    for label in labels:
        row = {"hold-out": label}
        for ego in egos:
            one = ours.get((ego, label))
            row[ego] = UNKNOWN if one is None else f"{one['mean']:.2f} SD {number_text(one['sd'])}"
        cells.append(row | {f"paper E-{name}": _paper_text(report, label, name) for name in EGOS})
    title = "ours, and the paper's egos with its own hold-outs (± as printed: an SD)"
    return Sheet(title, pd.DataFrame(cells))


def _paper_text(report: Mapping[str, Any], label: str, ego: str) -> str:
    name = report["environment"]["name"]
    if label == ALL:
        return number_text(AVERAGES[name][EGOS.index(ego)])
    if label in (OWN, CROSS):
        averages = average_by_method(name, ego)
        return UNKNOWN if averages is None else number_text(averages["own" if label == OWN else "others"])
    found = [one for one in report["paper"] if (one["holdout"], one["ego"]) == (label, ego)]
    return f"{found[0]['mean']:.2f} ± {found[0]['spread']:.2f}" if found else UNKNOWN
