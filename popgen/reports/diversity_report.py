"""BR-Div of partners as JSON, CSV and Markdown.

Keys of the JSON object (`diversity.json`):

    format, format_version   "popgen-diversity", 1
    environment              as in a population's manifest
    episodes, seed           for each partner and seat
    steps                    {"evaluation": N}
    partners                 group, source, member, sha256, in order
    responses                how many of them have a best response
    over                     `members`, and `best responses` where all have one: determinant, log_determinant (null for
                             dependent partners), effective_rank, chosen (indices of partners), chosen_log_determinant,
                             chosen_effective_rank, counts (a list of mean event counts for each partner)
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from popgen.errors import UserError
from popgen.evaluation.partner_diversity import PartnerDiversity
from popgen.jsonable import jsonable
from popgen.population.manifest import EnvironmentInfo
from popgen.reports.frames import Sheet, number_text, to_csv

CSV_FIELDS = ("over", "partner", "member", "chosen")
"""First columns of diversity.csv; a count for each kind of event follows."""


def describe_diversity(
    environment: EnvironmentInfo, episodes: int, seed: int, measured: Mapping[str, PartnerDiversity], responses: int
) -> dict[str, Any]:
    """The JSON object of the module's docstring."""
    players = next(iter(measured.values())).players
    return jsonable(
        {
            "format": "popgen-diversity",
            "format_version": 1,
            "environment": environment.model_dump(mode="json"),
            "episodes": episodes,
            "seed": seed,
            "steps": {"evaluation": sum(one.steps for one in measured.values())},
            "partners": [
                {"group": one.group, "source": one.source, "member": one.member, "sha256": one.digest}
                for one in players
            ],
            "responses": responses,
            "over": {name: _describe_one(one) for name, one in measured.items()},
        }
    )


def _describe_one(one: PartnerDiversity) -> dict[str, Any]:
    return {
        "determinant": one.diversity.determinant,
        "log_determinant": one.diversity.log_determinant,
        "effective_rank": one.diversity.effective_rank,
        "chosen": list(one.chosen),
        "chosen_log_determinant": one.chosen_diversity.log_determinant,
        "chosen_effective_rank": one.chosen_diversity.effective_rank,
        "counts": one.counts.tolist(),
    }


def make_sheet(report: Mapping[str, Any]) -> Sheet:
    """A row for each thing that events were counted of."""
    cells = []
    for name, one in report["over"].items():
        figures = {"determinant": f"{one['determinant']:.3g}", "log": number_text(one["log_determinant"])}
        figures |= {"effective rank": number_text(one["effective_rank"])}
        few = len(one["chosen"])
        if few < len(report["partners"]):
            figures |= {f"log of {few}": number_text(one["chosen_log_determinant"])}
            figures |= {f"rank of {few}": number_text(one["chosen_effective_rank"])}
        cells.append({"over": name, **figures})
    title = f"{report['environment']['name']}: BR-Div of {len(report['partners'])} partners"
    return Sheet(title, pd.DataFrame(cells))


def list_lines(report: Mapping[str, Any]) -> list[str]:
    """The chosen partners, and what is missing."""
    partners, lines = report["partners"], []
    for name, one in report["over"].items():
        if len(one["chosen"]) < len(partners):
            names = ", ".join(f"{partners[n]['group']} {partners[n]['member']}" for n in one["chosen"])
            lines.append(f"most diverse {len(one['chosen'])} over {name}: {names}")
    if report["responses"] < len(partners):
        count = f"{report['responses']} of {len(partners)}"
        lines.append(f"{count} partners have a best response: BR-Div over these needs all of them")
    steps = report["steps"]["evaluation"]
    return [*lines, f"{report['episodes']} episodes for each partner and seat, {steps:,} environment steps"]


def write_report(report: Mapping[str, Any], folder: str | Path) -> dict[str, Path]:
    """Write diversity.json, .csv and .md; gives the paths by suffix.

    Raises:
        UserError: the folder cannot be written.
    """
    folder = Path(folder)
    kinds = len(next(iter(report["over"].values()))["counts"][0])
    rows = [
        {
            **{
                "over": name,
                "partner": partner["group"],
                "member": partner["member"],
                "chosen": int(n in one["chosen"]),
            },
            **{f"event_{kind}": count for kind, count in enumerate(one["counts"][n])},
        }
        for name, one in report["over"].items()
        for n, partner in enumerate(report["partners"])
    ]
    sheet = make_sheet(report)
    lines = "".join(f"- {line}\n" for line in list_lines(report))
    texts = {
        "json": json.dumps(report, indent=1, allow_nan=False) + "\n",
        "csv": to_csv(rows, (*CSV_FIELDS, *(f"event_{kind}" for kind in range(kinds)))),
        "md": f"# {sheet.title}\n\n{sheet.to_markdown()}\n\n{lines}",
    }
    paths = {suffix: folder / f"diversity.{suffix}" for suffix in texts}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for suffix, text in texts.items():
            paths[suffix].write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(str(folder), f"cannot be written: {error.strerror}", "choose another folder") from error
    return paths
