"""A study with simulated participants, its server in a process of its own that may be killed now and then."""

from __future__ import annotations

import asyncio
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sqlalchemy as sa

from popgen.errors import UserError
from popgen.study.simulated_participants import Casting, SimulatedParticipant, Visit, simulate_people
from popgen.study.study_definition import Study
from popgen.study.study_tables import Database, games, ticks

START_SECONDS = 240


@dataclass(frozen=True)
class Lateness:
    """How late steps were, in milliseconds.

    Attributes:
        steps: measured.
        median, p99, most: after they were due.
        missed: steps that were later than a whole period, so that all later ones moved.
    """

    steps: int
    median: float
    p99: float
    most: float
    missed: int


def measure_lateness(database: Database, period_ms: float, since: int = 0) -> Lateness:
    """Of the recorded steps of games above row `since`."""
    with database.read() as connection:
        rows = connection.scalars(sa.select(ticks.c.late_us).where(ticks.c.game > since))
        late = np.array(list(rows), np.float64) / 1000
    if not len(late):
        return Lateness(0, 0.0, 0.0, 0.0, 0)
    figures = [float(value) for value in (np.median(late), np.percentile(late, 99), late.max())]
    return Lateness(len(late), *figures, missed=int((late > period_ms).sum()) if period_ms else 0)


def find_last_game(database: Database) -> int:
    """The newest row of `games`, 0 where there is none."""
    with database.read() as connection:
        return connection.scalar(sa.select(sa.func.max(games.c.id))) or 0


class ServerProcess:
    """`popgen study serve` as a process.

    Args:
        study: to serve.
        speed: times real time; 0: as fast as participants answer.
    """

    def __init__(self, study: Study, speed: int) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.address = f"127.0.0.1:{self.port}"
        self._command = [sys.executable, "-m", "popgen", "study", "serve", str(study.folder), "--port", str(self.port)]
        self._command += ["--speed", str(speed)]
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Return when it serves.

        Raises:
            UserError: it ended at once.
        """
        self._process = subprocess.Popen(self._command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        if "study at" not in self._process.stdout.readline():
            raise UserError("server", "has ended at once", "start it with popgen study serve to see why")

    def kill(self) -> None:
        """As a power cut would."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def stop(self) -> None:
        """As Ctrl-C would."""
        if self._process is None or self._process.poll() is not None:
            return
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(30)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@dataclass(frozen=True)
class DryRun:
    """A simulated study.

    Attributes:
        visits: of all participants.
        seconds: of wall time, from the first session on.
        lateness: of the steps.
        kills: how often the server was killed.
    """

    visits: list[Visit]
    seconds: float
    lateness: Lateness
    kills: int


@dataclass(frozen=True)
class DryRunPlan:
    """What is simulated.

    Attributes:
        participants: in all.
        together: at once.
        speed: times real time; 0: as fast as they answer.
        games: of each; None: all.
        kills: of the server, at random times.
        kill_seconds: between a start and a kill, at least and at most.
        seed: of all draws.
    """

    participants: int
    together: int
    speed: int = 0
    games: int | None = None
    kills: int = 0
    kill_seconds: tuple[float, float] = (4.0, 10.0)
    seed: int = 0


def run_dry(study: Study, casting: Casting, plan: DryRunPlan, told: Callable[[int], None]) -> DryRun:
    """Serve the study in a process and let simulated participants take part.

    Args:
        study: its folder gets their records.
        casting: who plays.
        plan: see `DryRunPlan`.
        told: gets how many participants are through.

    Raises:
        UserError: the server does not start or does not answer.
    """
    casting.warm_up()
    server = ServerProcess(study, plan.speed)
    server.start()
    database = Database(study.database, study)
    since, began = find_last_game(database), time.perf_counter()
    seeds = np.random.SeedSequence(plan.seed).generate_state(plan.participants)
    people = [SimulatedParticipant(server.address, study, casting, int(seed), plan.games) for seed in seeds]
    stop, killed = threading.Event(), [0]
    rng = np.random.default_rng(plan.seed)

    def kill_now_and_then() -> None:
        for _ in range(plan.kills):
            if stop.wait(float(rng.uniform(*plan.kill_seconds))):
                return
            server.kill()
            killed[0] += 1
            server.start()

    killer = threading.Thread(target=kill_now_and_then, daemon=True)
    killer.start()
    try:
        visits = asyncio.run(simulate_people(people, plan.together, told))
    finally:
        stop.set()
        killer.join(START_SECONDS)
        server.stop()
    seconds = time.perf_counter() - began
    period = study.definition.step_milliseconds / plan.speed if plan.speed else 0.0
    lateness = measure_lateness(database, period, since)
    database.close()
    return DryRun(visits, seconds, lateness, killed[0])


def summarize_visits(visits: Sequence[Visit]) -> dict[str, Any]:
    """Statuses, games, breaks, and the most steps that were lost at once."""
    statuses = [visit.status for visit in visits]
    return {
        "statuses": {status: statuses.count(status) for status in sorted(set(statuses))},
        "games": sum(visit.games for visit in visits),
        "steps": sum(visit.steps for visit in visits),
        "breaks": sum(visit.breaks for visit in visits),
        "most_lost": max((visit.lost for visit in visits), default=0),
    }
