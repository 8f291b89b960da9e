"""The container files, checked as far as that goes without an engine."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import ROOT

from popgen.cli.compose import compose

DOCKER = ROOT / "docker"
ENTRY = DOCKER / "entrypoint.sh"
INSTRUCTIONS = {"FROM", "SHELL", "ARG", "ENV", "RUN", "COPY", "WORKDIR", "USER", "ENTRYPOINT", "CMD"}
COMPOSE = {
    "": "name services volumes networks",
    "services": "image build command entrypoint environment ports volumes networks depends_on healthcheck deploy "
    "profiles restart init shm_size stop_grace_period security_opt cap_drop",
    "build": "context dockerfile target",
    "healthcheck": "test interval timeout retries start_period",
    "deploy": "replicas resources",
}
"""Part of a Compose file -> the keys of the specification that ours may have; another one is most likely a slip."""

ROLES = ("head", "worker", "run", "mlflow", "health")
TOKEN = "0123456789abcdef" * 4

# --- Dockerfile


def instructions() -> list[tuple[str, str]]:
    """(instruction, arguments) in order, continued lines joined, comments left out."""
    lines = [line for line in (DOCKER / "Dockerfile").read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines))
    found = [line.partition(" ") for line in joined.splitlines() if line.strip()]
    return [(word, rest.strip()) for word, _, rest in found]


def stages() -> dict[str, dict[str, Any]]:
    """name -> base and instructions, in order."""
    found: dict[str, dict[str, Any]] = {}
    for word, rest in instructions():
        if word == "FROM":
            base, _, name = rest.partition(" AS ")
            assert name and name not in found, rest
            found[name] = {"base": base, "lines": []}
        else:
            list(found.values())[-1]["lines"].append((word, rest))
    return found


def lineage(name: str) -> list[tuple[str, str]]:
    """All instructions of a stage and of those it is built on, in order."""
    known, lines = stages(), []
    while name in known:
        lines = known[name]["lines"] + lines
        name = known[name]["base"]
    return lines


def test_the_dockerfile_has_known_instructions_and_a_syntax() -> None:
    assert (DOCKER / "Dockerfile").read_text().startswith("# syntax=docker/dockerfile:1.")
    assert {word for word, _ in instructions()} <= INSTRUCTIONS  # no ADD, which may fetch from anywhere


def test_the_dockerfile_keeps_the_rules_of_linters() -> None:
    """What hadolint asks for, as far as it applies: the numbers are its rules'."""
    for word, rest in instructions():
        if word in ("CMD", "ENTRYPOINT", "SHELL"):
            assert isinstance(yaml.safe_load(rest), list), rest  # DL3025: the form without a shell
        if word == "WORKDIR":
            assert rest.startswith("/"), rest  # DL3000
        if word in ("ARG", "ENV"):
            assert not re.search("token|password|secret", rest, re.IGNORECASE), rest
        if word != "RUN":
            continue
        assert not re.search(r"\b(sudo|cd|apt)\s", rest), rest  # DL3004, DL3003, DL3027
        if "apt-get" in rest:  # DL3009, DL3014, DL3015, and the list of packages is of the same layer
            assert rest.startswith("apt-get update") and "install -y --no-install-recommends" in rest
            assert "rm -rf /var/lib/apt/lists/*" in rest
        if "pip install" in rest:  # DL3042: no cache of pip's in a layer
            assert "--mount=type=cache,target=/root/.cache/pip" in rest or "--no-cache-dir" in rest
        if " | " in rest:  # DL4006
            assert all(("SHELL", '["/bin/bash", "-o", "pipefail", "-c"]') in lineage(name) for name in stages())


def test_the_base_is_pinned_and_fits_the_project() -> None:
    known = stages()
    outside = {stage["base"] for stage in known.values()} - known.keys()
    assert len(outside) == 1
    tag = re.fullmatch(r"python:(\d+)\.(\d+)\.\d+-slim-[a-z]+", outside.pop())
    assert tag, "the base image needs an exact tag"
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    assert (int(tag[1]), int(tag[2])) >= tuple(int(part) for part in wanted.removeprefix(">=").split("."))


@pytest.mark.parametrize("target", ["cpu", "gpu"])
def test_both_targets_end_as_a_user_with_the_entry_script(target: str) -> None:
    lines = lineage(target)
    assert lines[-1] == ("USER", "popgen") and "gpu" in stages() and "cpu" in stages()
    user = next(index for index, (word, rest) in enumerate(lines) if word == "RUN" and "useradd" in rest)
    assert user < lines.index(("USER", "popgen"))
    assert ("ENTRYPOINT", '["popgen-entrypoint"]') in lines
    assert ("COPY", "--chmod=755 docker/entrypoint.sh /usr/local/bin/popgen-entrypoint") in lines
    assert ("COPY", f"--from=dependencies-{target} /opt/venv /opt/venv") in lines


def test_cpu_is_what_a_build_without_a_target_gives() -> None:
    assert list(stages())[-1] == "cpu"


def test_what_is_copied_is_there_and_sent_to_the_builder() -> None:
    sent = [
        line.strip("!/ \n") for line in (DOCKER / "Dockerfile.dockerignore").read_text().splitlines() if "!" in line
    ]
    for name, stage in stages().items():
        for word, rest in stage["lines"]:
            if word != "COPY":
                continue
            options, paths = [], shlex.split(rest)
            while paths[0].startswith("--"):
                options.append(paths.pop(0))
            origin = next((option.partition("=")[2] for option in options if option.startswith("--from=")), None)
            if origin is not None:
                assert list(stages()).index(origin) < list(stages()).index(name)
                continue
            for path in paths[:-1]:
                assert (ROOT / path).exists() and path in sent, path
    copied = {path for _, rest in stages()["wheel"]["lines"] for path in rest.split()}
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]["find"]["include"]
    assert {name.rstrip("*") for name in packages} <= copied


@pytest.mark.parametrize("target", ["cpu", "gpu"])
def test_an_edit_of_the_code_does_not_install_the_dependencies_again(target: str) -> None:
    """Nothing of the code is copied into the stages in which dependencies are installed, nor before them."""
    lines = lineage(f"dependencies-{target}") + lineage("requirements")
    copied = [rest for word, rest in lines if word == "COPY"]
    assert copied == ["--from=requirements /requirements.txt /requirements.txt", "pyproject.toml ./"]
    installs = [rest for word, rest in lines if "pip install" in rest]
    assert len(installs) == 2 and "torch==" in installs[0] and "--mount=type=cache" in installs[1]


def test_torch_is_a_version_the_project_takes() -> None:
    pins = {rest for word, rest in instructions() if word == "ARG" and rest.startswith("TORCH_VERSION=")}
    assert len(pins) == 1
    version = pins.pop().partition("=")[2]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    wanted = next(line for line in project if line.startswith("torch"))
    low, high = re.findall(r"[0-9.]+", wanted)
    assert [*map(int, low.split("."))] <= [*map(int, version.split("."))][:2] <= [*map(int, high.split("."))]


# --- compose


def load(name: str) -> dict[str, Any]:
    return yaml.safe_load((DOCKER / name).read_text())


def test_every_service_is_complete() -> None:
    content = load("compose.yaml")
    services = content["services"]
    assert services.keys() == {"head", "worker", "mlflow", "run"}
    for name, service in services.items():
        assert service["build"]["target"] == "${POPGEN_TARGET:-cpu}" and service["build"]["context"] == ".."
        assert (ROOT / service["build"]["dockerfile"]).is_file()
        assert set(service["networks"]) <= content["networks"].keys()
        for volume in service.get("volumes", []):
            assert volume.partition(":")[0] in content["volumes"]
        for other, condition in service.get("depends_on", {}).items():
            assert condition == {"condition": "service_healthy"} and "healthcheck" in services[other], name
        word = service["command"][0] if "command" in service else service["entrypoint"][1]
        assert word == name and word in ROLES
        for port in service.get("ports", []):
            assert port.startswith("127.0.0.1:")  # never on the host's other addresses


@pytest.mark.parametrize("name", ["compose.yaml", "compose.gpu.yaml"])
def test_compose_files_have_keys_of_the_specification(name: str) -> None:
    content = load(name)
    top = {key for key in content if not key.startswith("x-")}
    assert top <= set(COMPOSE[""].split())
    for service in content["services"].values():
        assert service.keys() <= set(COMPOSE["services"].split())
        for part in ("build", "healthcheck", "deploy"):
            assert service.get(part, {}).keys() <= set(COMPOSE[part].split())
    for name in ("volumes", "networks"):
        assert all(value is None for value in content.get(name, {}).values())  # made by Compose, with its defaults


def test_health_checks_ask_the_entry_script() -> None:
    for name, service in load("compose.yaml")["services"].items():
        if name == "run":
            continue
        check = service["healthcheck"]
        assert check["test"] == ["CMD", "popgen-entrypoint", "health", name]
        assert {"interval", "timeout", "retries", "start_period"} <= check.keys()


def test_the_token_is_asked_for_and_nowhere_written_down() -> None:
    services = load("compose.yaml")["services"]
    for name in ("head", "worker", "run"):
        environment = services[name]["environment"]
        assert environment["RAY_AUTH_MODE"] == "token"
        assert re.fullmatch(r"\$\{RAY_AUTH_TOKEN:\?[^}]+\}", environment["RAY_AUTH_TOKEN"])
    assert "RAY_AUTH_TOKEN" not in services["mlflow"]["environment"]


def test_every_variable_of_the_compose_files_has_a_default_or_is_asked_for() -> None:
    for name in ("compose.yaml", "compose.gpu.yaml"):
        lines = [line.partition("#")[0] for line in (DOCKER / name).read_text().splitlines()]
        for text in re.findall(r"\$\{?[^}\s]*[^}]*\}?", "\n".join(lines)):
            assert re.fullmatch(r"\$\{[A-Z_]+(:-[^}]+|:\?[^}]+)\}", text), text


def test_volumes_go_where_the_image_has_folders_of_the_user() -> None:
    made = next(rest for word, rest in stages()["runtime"]["lines"] if "useradd" in rest)
    services = load("compose.yaml")["services"]
    for service in services.values():
        for volume in service.get("volumes", []):
            assert volume.split(":")[1] in made.split()
    assert services["head"]["volumes"] == services["worker"]["volumes"] == ["runs:/home/popgen/runs"]
    assert "run.root=/home/popgen/runs" in services["run"]["entrypoint"]


def test_the_gpu_file_changes_the_workers_alone() -> None:
    services = load("compose.gpu.yaml")["services"]
    assert services.keys() == {"worker"}
    (device,) = services["worker"]["deploy"]["resources"]["reservations"]["devices"]
    assert device["driver"] == "nvidia" and device["capabilities"] == ["gpu"]


# --- KubeRay


def rayjob() -> tuple[dict[str, Any], dict[str, Any]]:
    claim, job = yaml.safe_load_all((DOCKER / "kuberay" / "rayjob.yaml").read_text())
    return claim, job


def test_the_rayjob_has_what_its_kind_asks_for() -> None:
    _, job = rayjob()
    assert (job["apiVersion"], job["kind"]) == ("ray.io/v1", "RayJob")
    spec = job["spec"]
    assert spec.keys() == {
        *("entrypoint", "submissionMode", "backoffLimit", "shutdownAfterJobFinishes", "ttlSecondsAfterFinished"),
        "rayClusterSpec",
    }
    cluster = spec["rayClusterSpec"]
    assert cluster.keys() == {"rayVersion", "authOptions", "headGroupSpec", "workerGroupSpecs"}
    assert cluster["authOptions"] == {"mode": "token"}
    assert spec["submissionMode"] == "K8sJobMode" and spec["shutdownAfterJobFinishes"] is True
    for group in cluster["workerGroupSpecs"]:
        assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"] and group["groupName"]
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    assert any(line.startswith("ray[") and f">={cluster['rayVersion'].rpartition('.')[0]}," in line for line in wanted)


def test_the_pods_of_the_rayjob_share_the_runs_and_are_no_root() -> None:
    claim, job = rayjob()
    cluster = job["spec"]["rayClusterSpec"]
    assert claim["kind"] == "PersistentVolumeClaim" and claim["spec"]["accessModes"] == ["ReadWriteMany"]
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        pod = group["template"]["spec"]
        assert pod["securityContext"]["runAsNonRoot"] is True and pod["securityContext"]["runAsUser"] == 1000
        (container,) = pod["containers"]
        assert container["resources"]["requests"] == container["resources"]["limits"]
        (volume,) = pod["volumes"]
        assert volume["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]
        assert container["volumeMounts"] == [{"name": volume["name"], "mountPath": "/home/popgen/runs"}]


def test_the_entrypoint_of_the_rayjob_is_a_run_that_its_cluster_can_hold() -> None:
    from popgen.config.run_config import RunConfig
    from popgen.runs.resources import check_room, demands

    _, job = rayjob()
    program, command, *overrides = shlex.split(job["spec"]["entrypoint"])
    assert (program, command) == ("popgen", "run")
    config = RunConfig.parse(compose(overrides))
    assert config.run.id and Path(config.run.root).is_absolute() and config.cluster.address == "auto"
    cluster = job["spec"]["rayClusterSpec"]
    (workers,) = cluster["workerGroupSpecs"]
    pods = [cluster["headGroupSpec"]] + [workers] * workers["replicas"]
    cpus = [int(pod["template"]["spec"]["containers"][0]["resources"]["limits"]["cpu"]) for pod in pods]
    check_room(demands(config), [{"CPU": float(count)} for count in cpus])


# --- the entry script


def entry(*words: str, path: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    places = [*([str(path)] if path else []), str(Path(sys.executable).parent), os.environ["PATH"]]  # it has a `python`
    known = {"PATH": ":".join(places), "HOME": "/nonexistent"}
    return subprocess.run([ENTRY, *words], env=known | environment, capture_output=True, text=True, timeout=60)


@pytest.fixture
def echoes(tmp_path: Path) -> Path:
    """A folder of programs that print how they were called."""
    for name in ("ray", "popgen", "mlflow"):
        program = tmp_path / name
        program.write_text(f'#!/bin/sh\nprintf "%s|" {name} "$@"\necho "$RAY_AUTH_MODE"\n')
        program.chmod(0o755)
    return tmp_path


REFUSED = {
    "head without a token": (("head",), {}, "RAY_AUTH_TOKEN: is not set"),
    "worker without a token": (("worker",), {"RAY_HEAD": "head:6379"}, "RAY_AUTH_TOKEN: is not set"),
    "job without a token": (("run",), {"RAY_API_SERVER_ADDRESS": "http://head:8265"}, "RAY_AUTH_TOKEN: is not set"),
    "short token": (("head",), {"RAY_AUTH_TOKEN": "secret"}, "shorter than 32"),
    "token file that is not there": (("head",), {"RAY_AUTH_TOKEN_PATH": "/nonexistent/token"}, "RAY_AUTH_TOKEN_PATH"),
    "empty token file": (("head",), {"RAY_AUTH_TOKEN_PATH": "/dev/null"}, "RAY_AUTH_TOKEN_PATH"),
    "worker without a head": (("worker",), {"RAY_AUTH_TOKEN": TOKEN}, "RAY_HEAD"),
    "head without a port": (("worker",), {"RAY_AUTH_TOKEN": TOKEN, "RAY_HEAD": "head"}, "RAY_HEAD"),
    "health of nothing": (("health", "moon"), {}, "unknown role 'moon'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_the_entry_script_refuses_in_one_line(case: str, echoes: Path) -> None:
    words, environment, told = REFUSED[case]
    done = entry(*words, path=echoes, **environment)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("popgen: error: ") and done.stderr.count("\n") == 1 and told in done.stderr


def test_the_entry_script_starts_a_head_on_the_loopback(echoes: Path) -> None:
    done = entry("head", "--num-cpus=3", path=echoes, RAY_AUTH_TOKEN=TOKEN)
    name, *words, mode = done.stdout.strip().split("|")
    assert (name, words[:2], words[-1], mode) == ("ray", ["start", "--head"], "--num-cpus=3", "token")
    assert {"--block", "--dashboard-host=127.0.0.1", "--port=6379"} <= set(words) and TOKEN not in done.stdout
    asked = entry("head", path=echoes, RAY_AUTH_TOKEN=TOKEN, DASHBOARD_HOST="0.0.0.0")
    assert "--dashboard-host=0.0.0.0" in asked.stdout


def test_the_entry_script_starts_the_other_roles(echoes: Path, tmp_path: Path) -> None:
    worker = entry("worker", path=echoes, RAY_AUTH_TOKEN=TOKEN, RAY_HEAD="head:6379")
    assert worker.stdout.startswith("ray|start|--address=head:6379|--block|")
    job = entry("run", "seed=2", path=echoes, RAY_AUTH_TOKEN=TOKEN, RAY_API_SERVER_ADDRESS="http://head:8265")
    assert job.stdout == "ray|job|submit|--|popgen|run|cluster=nodes|seed=2|token\n"
    assert entry("run", "seed=2", path=echoes).stdout == "popgen|run|seed=2|\n"
    assert entry("runs", "--json", path=echoes).stdout == "popgen|runs|--json|\n"
    assert entry(path=echoes).stdout == "popgen|--help|\n"
    server = entry("mlflow", path=echoes, MLFLOW_DATA=str(tmp_path / "data"))
    assert f"--backend-store-uri|sqlite:///{tmp_path}/data/mlflow.db|" in server.stdout
    assert (tmp_path / "data" / "artifacts").is_dir()


def test_the_entry_script_says_that_nothing_answers() -> None:
    free = dict.fromkeys(("DASHBOARD_PORT", "AGENT_PORT", "MLFLOW_PORT"), "9")  # the port of discard
    for role in ("head", "worker", "mlflow"):
        assert entry("health", role, **free).returncode == 1
