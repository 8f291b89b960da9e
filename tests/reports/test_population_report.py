from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
from rich.console import Console

from popgen.envs import make_env
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.simple_policies import RandomPolicy
from popgen.population import Population, PopulationWriter, load_population
from popgen.reports.population_report import describe_population, make_members_sheet, render_population


def make(path: Path) -> Path:
    spec = make_env("rendezvous/mppmr", 1).spec
    writer = PopulationWriter(path, spec, method="xpm_wm", config_digest="abcdef0123456789", seed=3)
    policy = FeedForwardPolicy(spec.views["features"], spec.num_actions, units=8, layers=1)
    writer.add_member(policy, seed=1, steps={"SP": 1_000, "random": 200}, training={"v": np.zeros(5, np.float32)})
    writer.add_member(RandomPolicy(5), seed=2, steps={"SP": 10, "XP": 4})
    return path


def test_describe_adds_up(tmp_path: Path) -> None:
    report = describe_population(load_population(make(tmp_path)))
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert report["steps"] == {"random": 200, "SP": 1_010, "XP": 4} and report["total_steps"] == 1_214
    assert list(report["steps"]) == ["random", "SP", "XP"]
    first, second = report["members"]
    assert first["parameters"] == (25 + 2) * 8 + 8 + 8 * 5 + 5 and second["parameters"] == 0
    assert first["total_steps"] == 1_200 and first["kind"] == "feed_forward" and second["kind"] == "random"
    on_disk = sum(path.stat().st_size for path in tmp_path.rglob("member_*/*"))
    assert first["bytes"] + second["bytes"] == report["bytes"] == on_disk
    assert report["manifest"]["method"] == "xpm_wm" and report["path"] == str(tmp_path)


def shown(population: Population) -> str:
    """What `popgen show` prints on a terminal of 80 columns."""
    text, report = io.StringIO(), describe_population(population)
    console = Console(file=text, width=80)
    for part in (
        render_population(report, population),
        *(sheet.to_rich(80) for sheet in make_members_sheet(report, population).split(80)),
    ):
        console.print(part)
    return text.getvalue()


def test_render_says_what_is_there(tmp_path: Path) -> None:
    text = shown(load_population(make(tmp_path)))
    assert max(map(len, text.splitlines())) <= 80
    for part in ("rendezvous/mppmr", "xpm_wm, seed 3, config abcdef012345", "1,214 environment steps", "feed_forward",
                 "1,000", "1,200", "members (continued)", "popgen 0."):  # fmt: skip
        assert part in text, part


def test_the_mates_of_pairs_are_named(tmp_path: Path) -> None:
    spec = make_env("rendezvous/mppmr", 1).spec
    writer = PopulationWriter(tmp_path, spec, method="hsp", config_digest="d", seed=0)
    for role, pair in (("biased", 3), ("partner", 3), ("biased", 12)):
        writer.add_member(RandomPolicy(5), seed=1, steps={"SP": 1}, extra={"role": role, "pair": pair})
    text = shown(load_population(tmp_path))
    assert "biased, mate 2" in text and "partner, mate 1" in text


def test_an_empty_population_can_be_shown(tmp_path: Path) -> None:
    spec = make_env("rendezvous/mppmr", 1).spec
    PopulationWriter(tmp_path, spec, method="xpm_wm", config_digest="d", seed=0)
    population = load_population(tmp_path)
    assert describe_population(population)["members"] == [] and describe_population(population)["total_steps"] == 0
    assert "0 environment steps" in shown(population)
