"""The faults of the campaign, each as what it does to one run."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import psutil
from chaos_testbed import SECOND, Testbed, count_events, send_signal, wait_until

ACTORS = {
    "sampler": {"xpm_wm": "SamplerActor", "xpm_sim": "SamplerActor", "default": "Runner"},
    "replay": {"xpm_wm": "ReplayActor"},
    "model learner": {"xpm_wm": "WorldModelActor"},
    "agent learner": {"xpm_wm": "AgentActor", "xpm_sim": "SimulatedAgentActor", "default": "Learner|Algorithm|Job"},
}
"""Who is killed -> method -> what its process is called; a method without an entry has no such actor."""


@dataclass
class Trial:
    """One fault on one run: where, when, and what came of it."""

    testbed: Testbed
    name: str
    method: str
    moment: int
    delay: float
    rng: random.Random
    injected: bool = False
    victim: str = ""
    code: int = 0
    submissions: int = 0
    error_lines: list[str] = field(default_factory=list)
    root: Path | None = None
    more: tuple[str, ...] = ()
    place: tuple[str, ...] = ()
    tracking: str = "off"

    @property
    def run(self) -> Path:
        return (self.root or self.testbed.folder / "runs") / self.name

    def start(self, *more: str) -> subprocess.Popen[bytes]:
        """Submit the run (again)."""
        self.submissions += 1
        given = (f"method={self.method}", f"tracking={self.tracking}", *self.more, *more)
        return self.testbed.start(
            self.testbed.list_settings(self.name, *given, root=self.root, place=self.place), self._log
        )

    def wait(self, process: subprocess.Popen[bytes]) -> int:
        """For the driver's end; its lines on stderr are kept."""
        outcome = self.testbed.finish(process, self._log)
        self.code = outcome.code
        if outcome.error:
            self.error_lines.append(outcome.error)
        return outcome.code

    def wait_for_moment(self, process: subprocess.Popen[bytes]) -> bool:
        """Wait for the moment; False if the run ends before."""
        if not wait_until(lambda: count_events(self.run) >= self.moment, process):
            return False
        time.sleep(self.delay)
        return process.poll() is None

    @property
    def _log(self) -> Path:
        return self.testbed.folder / f"{self.name}.{self.submissions}.out"


@dataclass(frozen=True)
class Fault:
    """A kind of fault; delay: seconds at most that it comes after its event; one_line: its first call ends with one."""

    name: str
    act: Callable[[Trial], None]
    applies: Callable[[str], bool] = lambda method: True
    delay: float = 0.4
    one_line: bool = False


def kill_actor(role: str) -> Fault:
    """kill -9 of one of the run's actors: the driver goes on by itself."""

    def act(trial: Trial) -> None:
        process = trial.start()
        pattern = ACTORS[role].get(trial.method) or ACTORS[role]["default"]
        if trial.wait_for_moment(process):
            kill_actor_process(trial, process, pattern)
        trial.wait(process)

    return Fault(role, act, lambda method: method in ACTORS[role] or "default" in ACTORS[role])


def kill_actor_process(trial: Trial, process: subprocess.Popen[bytes], pattern: str) -> None:
    found = wait_until(lambda: trial.testbed.find_actors(pattern), process)
    if found:
        victim = trial.rng.choice(found)
        trial.victim = " ".join(victim.cmdline())
        send_signal(victim)
        trial.injected = True


def kill_tracker(trial: Trial) -> None:
    """kill -9 of the tracker: the run goes on, and MLflow has every point once."""
    trial.tracking = "mlflow"
    process = trial.start()
    if trial.wait_for_moment(process):
        kill_actor_process(trial, process, "TrackerActor")
    if trial.wait(process) == 0 and trial.injected:
        check_tracking(trial)


def check_tracking(trial: Trial) -> None:
    """One parent and a nested run for each member, all finished, with as many points as metrics.jsonl."""
    import json
    import sqlite3

    with sqlite3.connect(trial.run.parent / "mlflow.db") as store:
        own = f"run_uuid in (select run_uuid from tags where key = 'popgen.run' and value = '{trial.run.name}')"
        runs = store.execute(f"select count(*), sum(status = 'FINISHED') from runs where {own}").fetchone()
        points = store.execute(f"select count(*) from metrics where key = 'real_sp' and {own}").fetchone()[0]
    rows = [json.loads(text) for text in (trial.run / "metrics.jsonl").read_text().splitlines()]
    wanted = sum("real_sp" in row for row in rows)
    if runs != (3, 3) or points != wanted:
        trial.code = 1
        trial.error_lines.append(f"MLflow has {runs} runs and {points} of {wanted} points")


def signal_driver(number: signal.Signals) -> Callable[[Trial], None]:
    """A signal to the driver; the same run id is submitted again."""

    def act(trial: Trial) -> None:
        process = trial.start()
        if trial.wait_for_moment(process):
            trial.victim, trial.injected = "driver", True
            send_signal(psutil.Process(process.pid), number)
        if process.wait(timeout=120) != 0 and trial.injected:
            trial.wait(trial.start())
        elif not trial.injected:
            trial.wait(process)

    return act


def kill_node(trial: Trial) -> None:
    """kill -9 of the node that all actors are on; another one comes."""
    if trial.testbed.node is None:
        trial.testbed.add_node()
    trial.place = (f"cluster.address={trial.testbed.cluster.address}", f"cluster.resources.{SECOND}=1")
    process = trial.start()
    if trial.wait_for_moment(process):
        trial.testbed.remove_node()
        trial.testbed.add_node()
        trial.victim, trial.injected = "node", True
    trial.wait(process)


def kill_local(name: str) -> Callable[[Trial], None]:
    """kill -9 of a process of the driver's own Ray: the driver starts another one, or is made again where Ray's library
    ended it."""

    def act(trial: Trial) -> None:
        trial.place = ("cluster=laptop", "cluster.num_cpus=4")
        process = trial.start()
        if trial.wait_for_moment(process):
            for child in psutil.Process(process.pid).children(recursive=True):
                if child.name() == name:
                    trial.victim, trial.injected = name, True
                    send_signal(child)
                    break
        trial.wait(process)

    return act


def fill_disk(reserve: int) -> Callable[[Trial], None]:
    """The file system of the run is full, or nearly; room is made, and the run submitted again."""

    def act(trial: Trial) -> None:
        trial.root = trial.testbed.folder / f"disk-{trial.name}"
        trial.root.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=600m", "tmpfs", str(trial.root)], check=True)
        try:
            trial.more = ("replay.capacity=20000", f"run.disk_reserve={reserve}")
            process = trial.start()
            if trial.wait_for_moment(process):
                trial.victim, trial.injected = "disk", True
                fill_file(trial.root / "ballast", leave=reserve // 2)
            if trial.wait(process) == 2:
                (trial.root / "ballast").unlink(missing_ok=True)
                trial.wait(trial.start())
            else:
                trial.injected = False  # it needed no more room
            kept = trial.testbed.folder / "runs" / trial.name
            shutil.copytree(trial.run, kept)
        finally:
            subprocess.run(["umount", "-l", str(trial.root)], check=False)
        trial.root = None

    return act


def fill_file(path: Path, leave: int) -> None:
    """A file that takes all room but `leave` bytes."""
    with path.open("wb", buffering=0) as file:
        try:
            while shutil.disk_usage(path.parent).free > leave:
                file.write(b"\0" * min(2**20, max(4096, shutil.disk_usage(path.parent).free - leave)))
        except OSError:
            return


def damage_checkpoint(trial: Trial) -> None:
    """The driver is killed and a bit of the newest checkpoint turned: the one before it counts."""
    process = trial.start()
    folder = trial.run / "checkpoints"
    if trial.wait_for_moment(process) and wait_until(lambda: len(list(folder.glob("progress_*[0-9]"))) == 2, process):
        send_signal(psutil.Process(process.pid))
    process.wait(timeout=120)
    found = sorted(folder.glob("progress_*[0-9]"))
    if process.returncode != 0 and len(found) == 2:
        path = found[-1] / trial.rng.choice(["arrays.safetensors", "values.json"])
        data = bytearray(path.read_bytes())
        data[trial.rng.randrange(len(data))] ^= 1 << trial.rng.randrange(8)
        path.write_bytes(data)
        trial.victim, trial.injected = f"{found[-1].name}/{path.name}", True
    trial.wait(trial.start())


def lose_machine(trial: Trial) -> None:
    """The driver is killed and the run's folder gone: it comes back from the storage."""
    trial.more = (f"run.storage=file://{trial.testbed.folder}/storage",)
    process = trial.start()
    if trial.wait_for_moment(process):
        send_signal(psutil.Process(process.pid))
        process.wait(timeout=120)
        shutil.rmtree(trial.run)
        trial.victim, trial.injected = "folder", True
        trial.wait(trial.start())
    else:
        trial.wait(process)


def is_root(method: str) -> bool:
    """Mounting a small disk needs it."""
    return os.geteuid() == 0


FAULTS = {
    fault.name: fault
    for fault in (
        *(kill_actor(role) for role in ACTORS),
        Fault("tracker", kill_tracker),
        Fault("driver kill -9", signal_driver(signal.SIGKILL)),
        Fault("driver SIGTERM", signal_driver(signal.SIGTERM)),
        Fault("node", kill_node),
        Fault("local raylet", kill_local("raylet")),
        Fault("local control store", kill_local("gcs_server")),
        Fault("disk full", fill_disk(0), is_root, one_line=True),
        Fault("disk nearly full", fill_disk(64 * 2**20), is_root, one_line=True),
        Fault("damaged checkpoint", damage_checkpoint),
        Fault("machine lost", lose_machine),
    )
}
"""Name -> fault."""
