from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
import sqlalchemy as sa
from study.study_folders import LAYOUTS, STEPS, make_small_study, served

from popgen.envs import make_env
from popgen.errors import UserError
from popgen.policies.simple_policies import RandomPolicy
from popgen.population import PopulationWriter, load_population
from popgen.study.recording_check import check_recordings
from popgen.study.simulated_participants import Casting, SimulatedParticipant, press_key, simulate_people
from popgen.study.study_dry_run import find_last_game, measure_lateness, summarize_visits
from popgen.study.study_tables import ticks


@pytest.mark.parametrize("host", ["server", "browser"])
def test_simulated_participants_take_part_as_people_do(host: str, tmp_path: Path) -> None:
    study = make_small_study(tmp_path, host=host)
    casting = Casting(study, [load_population(tmp_path / layout) for layout in LAYOUTS])
    with served(study) as (service, address):
        people = [SimulatedParticipant(address, study, casting, seed) for seed in range(3)]
        people.append(SimulatedParticipant(address, study, casting, 3, most_games=2))
        visits = asyncio.run(simulate_people(people, 4))
        told = summarize_visits(visits)
        assert told["statuses"] == {"active": 1, "completed": 3} and told["games"] == 3 * 5 + 2
        assert told["steps"] == told["games"] * STEPS and told["breaks"] == told["most_lost"] == 0
        database = service.people.database
        assert not [one for one in check_recordings(study, database) if one.problem]
        late = measure_lateness(database, 0.0)
        assert late.steps == told["steps"] and 0 <= late.median <= late.p99 <= late.most
        assert measure_lateness(database, 0.0, find_last_game(database)).steps == 0
        with database.read() as connection:
            measured = connection.scalar(sa.select(sa.func.count()).where(ticks.c.latency_ms.is_not(None)))
            assert bool(measured) == (host == "server")


def test_steps_follow_a_clock_that_does_not_drift(tmp_path: Path) -> None:
    study = make_small_study(tmp_path)
    with served(study, speed=30) as (service, address):  # a step each 5 ms
        person = SimulatedParticipant(address, study, Casting(study, []), 0, most_games=1)
        asyncio.run(simulate_people([person], 1))
        with service.people.database.read() as connection:
            steps = list(connection.scalars(sa.select(ticks.c.step)))
        assert steps == list(range(STEPS))


def test_populations_of_other_layouts_cannot_take_part(tmp_path: Path, random_population: Path) -> None:
    study = make_small_study(tmp_path)
    Casting(study, [load_population(random_population)])
    spec = make_env("overcooked/forced_coordination", 1, horizon=20).spec
    writer = PopulationWriter(tmp_path / "other", spec, method="xpm_wm", config_digest="0" * 64, seed=0)
    writer.add_member(RandomPolicy(spec.num_actions), seed=1, steps={})
    with pytest.raises(UserError, match="plays forced_coordination"):
        Casting(study, [load_population(tmp_path / "other")])


def test_messages_say_when_a_step_may_be_played() -> None:
    assert press_key(None, 0) == {"ready": 0}
    assert press_key("Space", 8) == {"ready": 8, "seen": 8, "keys": [["Space", 1, 0], ["Space", 0, 0]]}
