"""The simulated study behind `popgen reproduce conventions`; its server runs in this process."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from study.study_folders import served

from popgen.envs import make_env
from popgen.pipelines import simulated_study
from popgen.pipelines.simulated_study import StudyToSimulate, play_study
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy
from popgen.population import PopulationWriter
from popgen.reports.reproduction.run_lists import list_conventions, list_study_rows
from popgen.reports.reproduction.target_records import StudyBudget
from popgen.reports.reproduction.target_registry import BUDGETS
from popgen.study.simulated_participants import Casting, SimulatedParticipant, simulate_people
from popgen.study.study_definition import Study
from popgen.study.study_dry_run import DryRun, DryRunPlan, Lateness

LAYOUTS = ("cramped_room", "coordination_ring")


def run_here(study: Study, casting: Casting, plan: DryRunPlan, told: Callable[[int], None]) -> DryRun:
    with served(study) as (_, address):
        people = [SimulatedParticipant(address, study, casting, plan.seed + one) for one in range(plan.participants)]
        return DryRun(asyncio.run(simulate_people(people, plan.together, told)), 1.0, Lateness(0, 0, 0, 0, 0), 0)


def write_members(path: Path, layout: str) -> Path:
    """A population of a random and an idle member."""
    spec = make_env(f"overcooked/{layout}", 1, cooking="auto", horizon=20).spec
    writer = PopulationWriter(path, spec, method="x", config_digest="0" * 64, seed=0)
    for policy in (RandomPolicy(spec.num_actions), IdlePolicy(spec.action_names)):
        writer.add_member(policy, seed=1, steps={})
    return path


@pytest.mark.end_to_end
def test_one_study_serves_all_egos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulated_study, "run_dry", run_here)
    egos = {name: [write_members(tmp_path / f"{name}-{one}", one) for one in LAYOUTS] for name in ("E-A", "E-B")}
    spec = make_env("overcooked/cramped_room", 1, cooking="auto", horizon=20).spec
    tutor = PopulationWriter(tmp_path / "tutor", spec, method="x", config_digest="0" * 64, seed=0)
    tutor.add_member(IdlePolicy(spec.action_names), seed=1, steps={})
    size = StudyBudget(participants=4, pairs=1, tutorials=1, steps=20, random_keys=True)
    wanted = StudyToSimulate(tmp_path / "studies", "E-A", egos, tmp_path / "tutor", size, 3)
    first = play_study(wanted)
    monkeypatch.setattr(simulated_study, "run_dry", None)  # not again
    second = play_study(replace(wanted, ego="E-B"))
    assert len(first) + len(second) == 4 * 4  # a pair in two layouts each; the practice games are left out
    assert {game.layout for game in (*first, *second)} == set(LAYOUTS) and first[0].steps == 20
    assert all(sum(game.judged) == 1 for game in (*first, *second))
    (folder,) = (tmp_path / "studies").iterdir()
    told = json.loads((folder / "finished.json").read_text())
    assert (told["statuses"], told["steps"], told["proven"]) == ({"completed": 4}, 400, 20)
    assert json.loads((folder / "study.json").read_text())["host"] == "browser"
    tables = json.loads((folder / "conventions" / "conventions.json").read_text())
    assert [one["label"] for one in tables["players"]] == ["people with E-A", "people with E-B"]


def test_a_row_for_each_ego_over_all_layouts() -> None:
    budget = BUDGETS["laptop"]
    rows = list_study_rows(budget, 1)
    assert [row.row for row in rows] == [f"E-{name}, clones of people" for name in ("LIPO", "CoMeDi", "XPM-WM")]
    people = rows[0].people
    assert people is not None and {row.people for row in rows} == {people}
    assert len(people.egos) == 3 * len(budget.layouts)
    assert {one for ego in people.egos for one in ego.teachers} <= set(rows[0].needs) and set(people.egos) <= set(
        rows[0].needs
    )
    games = people.size.tutorials + 2 * people.size.pairs * len(budget.layouts)
    assert (people.size.participants, games) == (40, 23)
    assert rows[0] in list_conventions(budget, [1])
