"""How diverse partners are as JSON, CSV and Markdown: BR-Div of what they do, and how differently they act.

Keys of the JSON object (`diversity.json`):

    format, format_version   "popgen-diversity", 1
    environment              as in a population's manifest
    episodes, seed           for each partner and seat
    steps                    {"evaluation": N}
    partners                 group, source, member, sha256, in order
    responses                how many of them have a best response that was trained as `training` says
    training                 scale and settings (dotted field -> value on top of it) of best responses
    over                     `members`, and `best responses` where all have one: determinant, log_determinant (0 and
                             null for linearly dependent partners), effective_rank, rank, chosen (indices of partners),
                             hold_out (the same as arguments of `popgen evaluate --with`, a word for each population),
                             chosen_log_determinant, chosen_effective_rank, kinds (a list for each partner, what BR-Div
                             is of: mean counts of `popgen.envs.player_events.BR_DIV_EVENTS` in seat 0, then in seat 1),
                             counts (a list for each partner: of HSP's events, over both seats), kind_names and
                             count_names, spreads of the counts (a list: group, part as below, value, low, high)
    actions                  a list for the populations whose members can tell their probabilities: group, part (`all`,
                             or the skill or role that its members have), members, entropy, own_entropy, actions,
                             trajectories (objects: value, low, high, in nats), most, kernel
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd

from popgen.errors import UserError
from popgen.evaluation.action_diversity import MeasuredActions
from popgen.evaluation.holdout_players import Player
from popgen.evaluation.partner_diversity import PartnerDiversity
from popgen.evaluation.user_agents import is_agent_name
from popgen.jsonable import jsonable
from popgen.population.chosen_members import join_members
from popgen.population.manifest import EnvironmentInfo
from popgen.reports.frames import Sheet, number_text, range_text, to_csv

CSV_FIELDS = ("over", "partner", "member", "chosen")
"""First columns of diversity.csv; one for each event that is counted follows, event:NAME."""


def describe_diversity(
    environment: EnvironmentInfo,
    episodes: int,
    seed: int,
    measured: Mapping[str, PartnerDiversity],
    responses: int,
    *,
    actions: Sequence[MeasuredActions] = (),
    kernel: float = 0.0,
    training: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The JSON object of the module's docstring; `kernel` is that of the trajectories' divergence."""
    players = next(iter(measured.values())).players
    taken = sum(one.steps for one in measured.values()) + sum(one.found.steps for one in actions)
    return jsonable(
        {
            "format": "popgen-diversity",
            "format_version": 1,
            "environment": environment.model_dump(mode="json"),
            "episodes": episodes,
            "seed": seed,
            "steps": {"evaluation": taken},
            "partners": [
                {"group": one.group, "source": one.source, "member": one.member, "sha256": one.digest}
                for one in players
            ],
            "responses": responses,
            "training": dict(training or {}),
            "over": {name: _describe_one(one) for name, one in measured.items()},
            "actions": [_describe_actions(one, kernel) for one in actions],
        }
    )


def _describe_actions(one: MeasuredActions, kernel: float) -> dict[str, Any]:
    figures = {name: value for name, value in asdict(one.found).items() if name != "steps"}
    return {"group": one.group, "part": one.part, **figures, "kernel": kernel}


def _describe_one(one: PartnerDiversity) -> dict[str, Any]:
    return {
        "determinant": one.diversity.determinant,
        "log_determinant": one.diversity.log_determinant,
        "effective_rank": one.diversity.effective_rank,
        "rank": one.diversity.rank,
        "chosen": list(one.chosen),
        "hold_out": list_arguments([one.players[n] for n in one.chosen]),
        "chosen_log_determinant": one.chosen_diversity.log_determinant,
        "chosen_effective_rank": one.chosen_diversity.effective_rank,
        "kinds": one.kinds.tolist(),
        "counts": one.counts.tolist(),
        "kind_names": list(one.kind_names),
        "count_names": list(one.count_names),
        "spreads": [{"group": group, "part": part, **asdict(spread)} for (group, part), spread in one.spreads.items()],
    }


def list_arguments(players: Sequence[Player]) -> list[str]:
    """NAME=PATH:1,3 for each population of some players, and users' agents as they are."""
    members = dict[tuple[str, str], tuple[int, ...]]()
    for one in players:
        members[one.group, one.source] = (*members.get((one.group, one.source), ()), one.member)
    return [
        f"{group}={source if is_agent_name(source) else join_members(source, numbers)}"
        for (group, source), numbers in members.items()
    ]


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


def list_sheets(report: Mapping[str, Any]) -> list[Sheet]:
    """All tables of the report."""
    actions = [make_actions_sheet(report)] if report["actions"] else []
    return [make_sheet(report), make_spread_sheet(report), *actions]


def make_spread_sheet(report: Mapping[str, Any]) -> Sheet:
    """How far apart the members of a population are by what they do, over the same events."""
    cells = [
        {"over": name, "population": _name_part(one), "distance of two": range_text({**one, "mean": one["value"]})}
        for name, found in report["over"].items()
        for one in found["spreads"]
    ]
    return Sheet("Spread of events (two jackknife errors)", pd.DataFrame(cells), labels=2)


def _name_part(one: Mapping[str, Any]) -> str:
    return one["group"] if one["part"] == "all" else f"{one['group']}, {one['part']}"


def make_actions_sheet(report: Mapping[str, Any]) -> Sheet:
    """A row for each population, and for each skill or role in it."""
    cells = []
    for one in report["actions"]:
        figures = {
            title: f"{one[name]['value']:.3f} ({one[name]['low']:.3f} to {one[name]['high']:.3f})"
            for name, title in _TITLES.items()
        }
        share = one["trajectories"]["value"] / one["most"] if one["most"] else None
        head = {"population": _name_part(one), "members": str(one["members"])}
        cells.append({**head, **figures, "of ln members": number_text(share)})
    return Sheet("How differently members act, in nats (95 % interval)", pd.DataFrame(cells))


_TITLES = {"entropy": "entropy", "actions": "actions", "trajectories": "trajectories"}


def list_lines(report: Mapping[str, Any]) -> list[str]:
    """The chosen partners, and what is missing."""
    partners, lines = report["partners"], []
    for name, one in report["over"].items():
        if len(one["chosen"]) < len(partners):
            names = ", ".join(f"{partners[n]['group']} {partners[n]['member']}" for n in one["chosen"])
            lines.append(f"most diverse {len(one['chosen'])} over {name}: {names}")
        if one["rank"] < len(partners):
            told = f"over {name} only {one['rank']} of {len(partners)} partners are linearly independent"
            lines.append(f"{told}: the determinant is 0, its logarithm has no value")
    if training := report["training"] if report["responses"] else {}:
        settings = "".join(f", {name}={value}" for name, value in training["settings"].items())
        lines.append(f"best responses were trained with scale={training['scale']}{settings}")
    if report["responses"] < len(partners):
        count = f"{report['responses']} of {len(partners)}"
        lines.append(f"{count} partners have a best response: BR-Div over these needs all of them")
    if report["actions"]:
        kernel = report["actions"][0]["kernel"]
        lines.append("entropy: of the members' mean policy, over the states of their own games")
        lines.append(f"actions, trajectories (kernel {kernel:g}): divergence, at most ln of the number of members")
        lines.append("of ln members: trajectories' share of the most there is; populations of any size compare by it")
    steps = report["steps"]["evaluation"]
    return [*lines, f"{report['episodes']} episodes for each partner and seat, {steps:,} environment steps"]


def list_commands(report: Mapping[str, Any]) -> list[str]:
    """How each set of chosen partners is held out, to be copied."""
    found = [one["hold_out"] for one in report["over"].values() if len(one["chosen"]) < len(report["partners"])]
    return list(dict.fromkeys(f"popgen evaluate EGO --with {shlex.join(words)}" for words in found))


def write_report(report: Mapping[str, Any], folder: str | Path) -> dict[str, Path]:
    """Write diversity.json, .csv and .md; gives the paths by suffix.

    Raises:
        UserError: the folder cannot be written.
    """
    folder = Path(folder)
    columns = [f"event:{name}" for name in next(iter(report["over"].values()))["count_names"]]
    rows = [
        {
            **{
                "over": name,
                "partner": partner["group"],
                "member": partner["member"],
                "chosen": int(n in one["chosen"]),
            },
            **dict(zip(columns, one["counts"][n], strict=True)),
        }
        for name, one in report["over"].items()
        for n, partner in enumerate(report["partners"])
    ]
    first, *others = list_sheets(report)
    tables = "".join(f"\n\n## {sheet.title}\n\n{sheet.to_markdown()}" for sheet in others)
    lines = "".join(f"- {line}\n" for line in list_lines(report))
    commands = "".join(f"\n    {line}\n" for line in list_commands(report))
    texts = {
        "json": json.dumps(report, indent=1, allow_nan=False) + "\n",
        "csv": to_csv(rows, (*CSV_FIELDS, *columns)),
        "md": f"# {first.title}\n\n{first.to_markdown()}{tables}\n\n{lines}{commands}",
    }
    paths = {suffix: folder / f"diversity.{suffix}" for suffix in texts}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for suffix, text in texts.items():
            paths[suffix].write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(str(folder), f"cannot be written: {error.strerror}", "choose another folder") from error
    return paths
