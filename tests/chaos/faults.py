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
from site_of_chaos import FAR, Site, end, events, until

ACTORS = {
    "sampler": {"xpm_wm": "SamplerActor", "xpm_sim": "SamplerActor", "default": "Runner"},
    "replay": {"xpm_wm": "ReplayActor"},
    "model learner": {"xpm_wm": "WorldModelActor"},
    "agent learner": {"xpm_wm": "AgentActor", "xpm_sim": "SimulatedAgentActor", "default": "Learner|Algorithm|Job"},
}
"""Who is killed -> method -> what its process is called; a method without an entry has no such actor."""


@dataclass
class Hit:
    """One fault on one run: where, when, and what came of it."""

    site: Site
    name: str
    method: str
    moment: int
    delay: float
    rng: random.Random
    struck: bool = False
    victim: str = ""
    code: int = 0
    submissions: int = 0
    told: list[str] = field(default_factory=list)
    root: Path | None = None
    more: tuple[str, ...] = ()
    place: tuple[str, ...] = ()
    tracking: str = "off"

    @property
    def run(self) -> Path:
        return (self.root or self.site.folder / "runs") / self.name

    def start(self, *more: str) -> subprocess.Popen[bytes]:
        """Submit the run (again)."""
        self.submissions += 1
        given = (f"method={self.method}", f"tracking={self.tracking}", *self.more, *more)
        return self.site.start(self.site.overrides(self.name, *given, root=self.root, place=self.place), self._log)

    def wait(self, process: subprocess.Popen[bytes]) -> int:
        """For the driver's end; what it told is kept."""
        outcome = self.site.finish(process, self._log)
        self.code = outcome.code
        if outcome.error:
            self.told.append(outcome.error)
        return outcome.code

    def reached(self, process: subprocess.Popen[bytes]) -> bool:
        """Wait for the moment; False if the run ends before."""
        if not until(lambda: events(self.run) >= self.moment, process):
            return False
        time.sleep(self.delay)
        return process.poll() is None

    @property
    def _log(self) -> Path:
        return self.site.folder / f"{self.name}.{self.submissions}.out"


@dataclass(frozen=True)
class Fault:
    """A kind of fault; delay: seconds at most that it comes after its event; one_line: its first call ends with one."""

    name: str
    act: Callable[[Hit], None]
    hits: Callable[[str], bool] = lambda method: True
    delay: float = 0.4
    one_line: bool = False


def kill_actor(role: str) -> Fault:
    """kill -9 of one of the run's actors: the driver goes on by itself."""

    def act(hit: Hit) -> None:
        process = hit.start()
        pattern = ACTORS[role].get(hit.method) or ACTORS[role]["default"]
        if hit.reached(process):
            strike_actor(hit, process, pattern)
        hit.wait(process)

    return Fault(role, act, lambda method: method in ACTORS[role] or "default" in ACTORS[role])


def strike_actor(hit: Hit, process: subprocess.Popen[bytes], pattern: str) -> None:
    found = until(lambda: hit.site.workers(pattern), process)
    if found:
        victim = hit.rng.choice(found)
        hit.victim = " ".join(victim.cmdline())
        end(victim)
        hit.struck = True


def kill_tracker(hit: Hit) -> None:
    """kill -9 of the tracker: the run goes on, and MLflow has every point once."""
    hit.tracking = "sqlite"
    process = hit.start()
    if hit.reached(process):
        strike_actor(hit, process, "TrackerActor")
    if hit.wait(process) == 0 and hit.struck:
        check_tracking(hit)


def check_tracking(hit: Hit) -> None:
    """One parent and a nested run for each member, all finished, with as many points as metrics.jsonl."""
    import json
    import sqlite3

    with sqlite3.connect(hit.run.parent / "mlflow.db") as store:
        own = f"run_uuid in (select run_uuid from tags where key = 'popgen.run' and value = '{hit.run.name}')"
        runs = store.execute(f"select count(*), sum(status = 'FINISHED') from runs where {own}").fetchone()
        points = store.execute(f"select count(*) from metrics where key = 'real_sp' and {own}").fetchone()[0]
    rows = [json.loads(text) for text in (hit.run / "metrics.jsonl").read_text().splitlines()]
    wanted = sum("real_sp" in row for row in rows)
    if runs != (3, 3) or points != wanted:
        hit.code = 1
        hit.told.append(f"MLflow has {runs} runs and {points} of {wanted} points")


def signal_driver(number: signal.Signals) -> Callable[[Hit], None]:
    """A signal to the driver; the same run id is submitted again."""

    def act(hit: Hit) -> None:
        process = hit.start()
        if hit.reached(process):
            hit.victim, hit.struck = "driver", True
            end(psutil.Process(process.pid), number)
        if process.wait(timeout=120) != 0 and hit.struck:
            hit.wait(hit.start())
        elif not hit.struck:
            hit.wait(process)

    return act


def kill_node(hit: Hit) -> None:
    """kill -9 of the node that all actors are on; another one comes."""
    if hit.site.node is None:
        hit.site.add_node()
    hit.place = (f"cluster.address={hit.site.cluster.address}", f"cluster.resources.{FAR}=1")
    process = hit.start()
    if hit.reached(process):
        hit.site.remove_node()
        hit.site.add_node()
        hit.victim, hit.struck = "node", True
    hit.wait(process)


def kill_local(name: str) -> Callable[[Hit], None]:
    """kill -9 of a process of the driver's own Ray: the driver starts another one, or is made again where Ray's library
    ended it."""

    def act(hit: Hit) -> None:
        hit.place = ("cluster=laptop", "cluster.num_cpus=4")
        process = hit.start()
        if hit.reached(process):
            for child in psutil.Process(process.pid).children(recursive=True):
                if child.name() == name:
                    hit.victim, hit.struck = name, True
                    end(child)
                    break
        hit.wait(process)

    return act


def fill_disk(reserve: int) -> Callable[[Hit], None]:
    """The file system of the run is full, or nearly; room is made, and the run submitted again."""

    def act(hit: Hit) -> None:
        hit.root = hit.site.folder / f"disk-{hit.name}"
        hit.root.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=600m", "tmpfs", str(hit.root)], check=True)
        try:
            hit.more = ("replay.capacity=20000", f"run.disk_reserve={reserve}")
            process = hit.start()
            if hit.reached(process):
                hit.victim, hit.struck = "disk", True
                fill(hit.root / "ballast", leave=reserve // 2)
            if hit.wait(process) == 2:
                (hit.root / "ballast").unlink(missing_ok=True)
                hit.wait(hit.start())
            else:
                hit.struck = False  # it needed no more room
            kept = hit.site.folder / "runs" / hit.name
            shutil.copytree(hit.run, kept)
        finally:
            subprocess.run(["umount", "-l", str(hit.root)], check=False)
        hit.root = None

    return act


def fill(path: Path, leave: int) -> None:
    """A file that takes all room but `leave` bytes."""
    with path.open("wb", buffering=0) as file:
        try:
            while shutil.disk_usage(path.parent).free > leave:
                file.write(b"\0" * min(2**20, max(4096, shutil.disk_usage(path.parent).free - leave)))
        except OSError:
            return


def damage_checkpoint(hit: Hit) -> None:
    """The driver is killed and a bit of the newest checkpoint turned: the one before it counts."""
    process = hit.start()
    folder = hit.run / "checkpoints"
    if hit.reached(process) and until(lambda: len(list(folder.glob("progress_*[0-9]"))) == 2, process):
        end(psutil.Process(process.pid))
    process.wait(timeout=120)
    found = sorted(folder.glob("progress_*[0-9]"))
    if process.returncode != 0 and len(found) == 2:
        path = found[-1] / hit.rng.choice(["arrays.safetensors", "values.json"])
        data = bytearray(path.read_bytes())
        data[hit.rng.randrange(len(data))] ^= 1 << hit.rng.randrange(8)
        path.write_bytes(data)
        hit.victim, hit.struck = f"{found[-1].name}/{path.name}", True
    hit.wait(hit.start())


def lose_machine(hit: Hit) -> None:
    """The driver is killed and the run's folder gone: it comes back from the storage."""
    hit.more = (f"run.storage=file://{hit.site.folder}/storage",)
    process = hit.start()
    if hit.reached(process):
        end(psutil.Process(process.pid))
        process.wait(timeout=120)
        shutil.rmtree(hit.run)
        hit.victim, hit.struck = "folder", True
        hit.wait(hit.start())
    else:
        hit.wait(process)


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
