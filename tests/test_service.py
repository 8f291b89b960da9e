"""Jobs of a real cluster, started by the container's entry script: exit codes, resuming, token, tracking server."""

from __future__ import annotations

import importlib.util
import json
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest
from conftest import ROOT

from popgen import cli
from popgen.errors import UserError
from popgen.population import load_population
from popgen.runs.directory import describe_run
from popgen.runs.ledger import Ledger
from popgen.runs.preflight import check_kept

ENTRY = ROOT / "docker" / "entrypoint.sh"
BIN = Path(sys.executable).parent
PARTS = ("popgen", "actors", "pipelines", "conf", "pyproject.toml", ".gitignore", ".rayignore")
STEPS = 8000
JOB = (
    *(
        "scale=smoke",
        "population.size=1",
        "env.params.horizon=40",
        f"phase1.max_steps={STEPS}",
        "evaluation.episodes=1",
    ),
    *("seed=3", "cluster=nodes", "cluster.samplers=1", "cluster.sampler_cpus=0.1", "cluster.replay_cpus=0"),
    *("cluster.model_cpus=0.9", "cluster.agent_cpus=0.9", "cluster.model_gpus=0", "cluster.agent_gpus=0"),
    "cluster.threads=1",
)
pytestmark = [
    pytest.mark.timeout(1800),
    pytest.mark.skipif(
        importlib.util.find_spec("aiohttp_cors") is None, reason="Ray without its dashboard takes no jobs: ray[default]"
    ),
]


def until(what: str, ask: Callable[[], Any], process: subprocess.Popen[Any] | None = None, seconds: float = 600) -> Any:
    """The first true answer; AssertionError if there is none in time, or if the process has ended."""
    deadline = time.monotonic() + seconds
    while not (answer := ask()):
        if process is not None and process.poll() is not None:
            said = process.stdout.read() if process.stdout else ""
            raise AssertionError(f"{what}: the process ended with {process.returncode}\n{said}")
        assert time.monotonic() < deadline, f"{what}: not within {seconds:g} s"
        time.sleep(0.02)
    return answer


def answers(url: str, token: str = "") -> int:
    """HTTP status, 0 without an answer."""
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=30) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code
    except OSError:
        return 0


def free_ports(count: int) -> list[int]:
    held = [socket.socket() for _ in range(count)]
    for one in held:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in held]
    for one in held:
        one.close()
    return ports


@dataclass
class Cluster:
    """A head and a tracking server."""

    folder: Path
    source: Path
    environment: dict[str, str]
    dashboard: str
    tracking: str

    @property
    def runs(self) -> Path:
        return self.folder / "runs"

    def submit(self, *overrides: str, **environment: str) -> subprocess.Popen[str]:
        """`ray job submit`, as docs/cluster.md has it."""
        command = [BIN / "ray", "job", "submit", "--working-dir", ".", "--", "python", "-m", "popgen", "run"]
        return subprocess.Popen(
            [*command, *JOB, f"run.root={self.runs}", *overrides],
            cwd=self.source,
            env=self.environment | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def run(self, *overrides: str, **environment: str) -> tuple[int, str]:
        """The same, waited for: exit code and output."""
        process = self.submit(*overrides, **environment)
        out, _ = process.communicate(timeout=600)
        return process.returncode, out

    def start(self, name: str, *words: str) -> subprocess.Popen[bytes]:
        with open(self.folder / f"{name}.log", "wb") as log:
            return subprocess.Popen([ENTRY, *words], env=self.environment, stdout=log, stderr=log, cwd=self.folder)


def end(process: subprocess.Popen[Any]) -> None:
    """A process and all that it has started, at once."""
    if process.poll() is None:
        family = [*psutil.Process(process.pid).children(recursive=True), psutil.Process(process.pid)]
        for one in family:
            try:
                one.kill()
            except psutil.NoSuchProcess:
                continue
    process.wait()


@pytest.fixture(scope="module")
def cluster(one_cluster_at_a_time: None) -> Iterator[Cluster]:
    folder = Path(tempfile.mkdtemp(prefix="pg-", dir="/tmp"))  # Ray's sockets need a short path
    source = folder / "source"
    for name in PARTS:
        path = ROOT / name
        if path.is_dir():
            shutil.copytree(path, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(path, source / name)
    for left in ("runs/other/config.json", ".venv/bin/python"):  # what must not travel
        (source / left).parent.mkdir(parents=True)
        (source / left).write_text("{}")
    gcs, dashboard, agent, grpc, metrics, mlflow = free_ports(6)
    environment = {name: os.environ[name] for name in ("LANG", "LC_ALL", "OMP_NUM_THREADS") if name in os.environ}
    environment |= {"PATH": f"{BIN}:{os.environ['PATH']}", "HOME": str(folder), "PYTHONUNBUFFERED": "1"}
    environment |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    waits = (
        "raylet_start_wait_time_s",
        "DASHBOARD_STARTUP_TIMEOUT_S",
        "DASHBOARD_SUBPROCESS_MODULE_WAIT_READY_TIMEOUT",
    )
    environment |= {f"RAY_{name}": "600" for name in waits}  # for a busy machine
    environment |= {"RAY_PORT": str(gcs), "DASHBOARD_PORT": str(dashboard), "AGENT_PORT": str(agent)}
    environment |= {"MLFLOW_PORT": str(mlflow), "MLFLOW_HOST": "127.0.0.1", "MLFLOW_WORKERS": "1"}
    environment |= {"RAY_API_SERVER_ADDRESS": f"http://127.0.0.1:{dashboard}", "MLFLOW_DISABLE_TELEMETRY": "true"}
    made = Cluster(folder, source, environment, f"http://127.0.0.1:{dashboard}", f"http://127.0.0.1:{mlflow}")
    ports = (f"--dashboard-agent-grpc-port={grpc}", f"--metrics-export-port={metrics}")
    small = ("--num-cpus=2", "--object-store-memory=100000000", f"--temp-dir={folder / 'r'}")
    head, server = made.start("head", "head", *ports, *small), made.start("mlflow", "mlflow")
    try:
        until("the head", lambda: answers(f"{made.dashboard}/api/gcs_healthz") == 200, head)
        until("the tracking server", lambda: answers(f"{made.tracking}/health") == 200, server)
        yield made
    except AssertionError:
        for name in ("head", "mlflow"):
            print((folder / f"{name}.log").read_text()[-3000:])
        raise
    finally:
        end(head)
        end(server)
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def unbroken(cluster: Cluster) -> Path:
    """A run's folder: a job that nothing happens to, tracked on the server."""
    code, out = cluster.run("run.id=unbroken", "tracking=server", f"tracking.uri={cluster.tracking}")
    assert code == 0 and "succeeded" in out, out
    return cluster.runs / "unbroken"


def entries(run: Path) -> list[tuple[Any, ...]]:
    """The ledger, but for what tells runs and attempts apart."""
    ledger = Ledger(run / "ledger.jsonl")
    return [(e.member, e.kind, e.sampler.partition(".")[0], e.steps, e.episodes, e.score) for e in ledger]


def sha256s(run: Path) -> list[str]:
    return [info.policy_sha256 for info in load_population(run / "population").members]


def test_the_cluster_is_healthy_closed_and_on_the_loopback(cluster: Cluster) -> None:
    for role in ("head", "worker", "mlflow"):
        until(role, lambda role=role: subprocess.run([ENTRY, "health", role], env=cluster.environment).returncode == 0)
    url = f"{cluster.dashboard}/api/version"
    assert (answers(url), answers(url, "0" * 64), answers(url, cluster.environment["RAY_AUTH_TOKEN"])) == (
        401,
        403,
        200,
    )
    port = int(cluster.dashboard.rpartition(":")[2])
    listening = {c.laddr.ip for c in psutil.net_connections("tcp") if c.status == "LISTEN" and c.laddr.port == port}
    assert listening == {"127.0.0.1"}
    assert not (cluster.folder / ".ray").exists()  # no token is kept in the home


def test_a_job_ends_with_exit_code_0_its_population_and_its_mlflow_run(
    cluster: Cluster, unbroken: Path, tmp_path: Path
) -> None:
    from mlflow.tracking import MlflowClient

    assert len(load_population(unbroken / "population")) == 1
    told = describe_run(unbroken)
    assert (told["state"], told["member"], told["size"], told["error"]) == ("finished", 1, 1, None)
    assert told["steps"]["random"] + told["steps"]["SP"] == STEPS and told["seconds"] > 0
    client = MlflowClient(cluster.tracking)
    experiment = client.get_experiment_by_name("popgen")
    assert experiment is not None
    runs = {run.info.run_name: run for run in client.search_runs([experiment.experiment_id])}
    assert runs.keys() == {"unbroken", "unbroken/member_001"}
    assert {run.info.status for run in runs.values()} == {"FINISHED"}
    assert runs["unbroken"].data.metrics["environment_steps_by_members"] == STEPS
    there = {file.path for file in client.list_artifacts(runs["unbroken"].info.run_id)}
    assert there == {"config.json", "ledger.csv", "ledger.jsonl", "population", "report"}
    copy = client.download_artifacts(runs["unbroken"].info.run_id, "population", str(tmp_path))
    assert [info.policy_sha256 for info in load_population(copy).members] == sha256s(unbroken)


def test_runs_and_virtual_environments_stay_at_home(cluster: Cluster, unbroken: Path) -> None:
    (unpacked,) = (cluster.folder / "r").glob("session_2*/runtime_resources/working_dir_files/_ray_pkg_*/")
    there = {path.name for path in unpacked.iterdir()}
    assert {"popgen", "actors", "pipelines", "conf"} <= there and not {"runs", ".venv"} & there


def test_a_users_error_fails_the_job_with_its_one_line(cluster: Cluster) -> None:
    code, out = cluster.run("run.id=refused", "population.size=0")
    assert code == 1 and "failed with exit code 2" in out
    lines = {line for line in out.splitlines() if line.startswith("popgen: error: ")}
    assert len(lines) == 1 and "population.size" in lines.pop() and "Traceback" not in out
    assert not (cluster.runs / "refused").exists()


def test_the_entry_script_submits_a_job(cluster: Cluster) -> None:
    """One that is refused at once; popgen is the nodes' own here."""
    words = [ENTRY, "run", "run.id=refused", f"run.root={cluster.runs}", "population.size=0"]
    done = subprocess.run(
        words, env=cluster.environment, cwd=cluster.folder, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 1 and "popgen: error: population.size: " in done.stdout + done.stderr
    assert not (cluster.runs / "refused").exists()


def test_a_killed_job_submitted_again_ends_as_one_that_was_not(
    cluster: Cluster, unbroken: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, tracking = cluster.runs / "killed", "tracking=off"
    ledger = run / "ledger.jsonl"

    def begin() -> subprocess.Popen[str] | None:
        """None where the job found its folder half unpacked, which Ray was seen to do: nothing has begun then."""
        job = cluster.submit("run.id=killed", tracking)
        try:
            until("some work", lambda: ledger.exists() and ledger.read_bytes().count(b"\n") > 4, job)
        except AssertionError as error:
            if "Cannot find primary config" not in str(error) or run.exists():
                raise
            return None
        return job

    first = begin() or begin()
    assert first is not None
    state = json.loads((run / "state.json").read_text())
    os.kill(state["pid"], signal.SIGSTOP)  # it must not end while we look
    assert describe_run(run)["state"] == "running"
    # Another driver on the same run: refused before anything starts or changes.
    capsys.readouterr()
    assert cli.main(["run", *JOB, f"run.root={cluster.runs}", "run.id=killed", tracking]) == 2
    assert f"killed is being run by process {state['pid']} on {socket.gethostname()}" in capsys.readouterr().err
    os.kill(state["pid"], signal.SIGKILL)
    out, _ = first.communicate(timeout=240)
    assert first.returncode == 1, out
    told = describe_run(run)
    assert told["state"] == "interrupted" and 0 < told["total_steps"] < STEPS
    code, out = cluster.run("run.id=killed", tracking)
    assert code == 0 and "continuing after" in out, out
    assert entries(run) == entries(unbroken) and sha256s(run) == sha256s(unbroken)
    told = describe_run(run)
    assert (told["state"], told["attempt"], told["member"]) == ("finished", 2, 1)
    assert told["steps"] == describe_run(unbroken)["steps"]


def test_a_worker_joins_the_cluster(cluster: Cluster) -> None:
    """A second node on this machine, with ports of its own; it is healthy, and leaves when it is told to."""

    def alive() -> int:
        headers = {"Authorization": f"Bearer {cluster.environment['RAY_AUTH_TOKEN']}"}
        asked = urllib.request.Request(f"{cluster.dashboard}/nodes?view=summary", headers=headers)
        with urllib.request.urlopen(asked, timeout=30) as answer:
            nodes = json.load(answer)["data"]["summary"]
        return sum(node["raylet"]["state"] == "ALIVE" for node in nodes)

    agent, grpc, metrics = free_ports(3)
    own = {"RAY_HEAD": f"127.0.0.1:{cluster.environment['RAY_PORT']}", "AGENT_PORT": str(agent)}
    environment = cluster.environment | own
    options = (f"--dashboard-agent-grpc-port={grpc}", f"--metrics-export-port={metrics}", "--num-cpus=1")
    command = [ENTRY, "worker", *options, "--object-store-memory=100000000"]

    def join() -> subprocess.Popen[bytes] | None:
        """Ray gives a node's agents 15 s to start: on a busy machine that may be too few, and it does not try again."""
        with open(cluster.folder / "worker.log", "wb") as log:
            worker = subprocess.Popen(command, env=environment, stdout=log, stderr=log, cwd=cluster.folder)
        try:
            until("the second node", lambda: alive() == 2, worker, seconds=60)
        except AssertionError:
            end(worker)
            return None
        return worker

    worker = join() or join() or join()
    assert worker is not None, (cluster.folder / "worker.log").read_text()
    try:
        health = [ENTRY, "health", "worker"]
        until("its health", lambda: subprocess.run(health, env=environment).returncode == 0, worker)
        worker.terminate()
        until("its end", lambda: alive() == 1)
        assert subprocess.run(health, env=environment).returncode == 1
    finally:
        end(worker)


def test_a_job_without_the_token_is_not_taken(cluster: Cluster) -> None:
    code, out = cluster.run("run.id=stranger", RAY_AUTH_TOKEN=secrets.token_hex(32))
    assert code != 0 and "token" in out and not (cluster.runs / "stranger").exists()


def test_a_run_in_the_jobs_own_folder_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "_ray_pkg_0123456789abcdef"
    folder.mkdir()
    monkeypatch.chdir(folder)
    for root in ("runs", str(folder / "runs")):
        with pytest.raises(UserError, match="run.root: .* which Ray deletes"):
            check_kept(Path(root))
    check_kept(tmp_path / "runs")
