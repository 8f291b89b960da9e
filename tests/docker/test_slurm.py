"""The scripts for Slurm, with programs that stand for Slurm's, and the recipe for Apptainer."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest
from conftest import ROOT

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.runs.resources import check_room, demands

SLURM = ROOT / "docker" / "slurm"
POPGEN = """#!/bin/bash
printf '%s\\n' "$@" > words
trap 'echo closed > books; exit 15' TERM
touch started
for _ in $(seq 600); do [[ -e go_on ]] && exit "$(cat go_on)"; sleep 0.05; done
"""


@pytest.fixture
def programs(tmp_path: Path) -> Path:
    folder = tmp_path / "bin"
    folder.mkdir()
    for name, text in {
        "popgen": POPGEN,
        "scontrol": '#!/bin/bash\nif [[ $1 == show ]]; then printf "n1\\nn2\\n"; else echo "$@" > scontrol; fi\n',
        "srun": '#!/bin/bash\nprintf "%s\\n" "$@" > srun\n',
    }.items():
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    return tmp_path


def start(script: str, folder: Path, *words: str) -> subprocess.Popen[str]:
    environment = {"PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "HOME": "/home/me", "SLURM_JOB_ID": "71"}
    environment |= {"SLURM_CPUS_PER_TASK": "4", "SLURM_NNODES": "2", "SLURM_JOB_NODELIST": "n[1-2]"}
    return subprocess.Popen(
        ["bash", SLURM / script, *words], cwd=folder, env=environment, stderr=subprocess.PIPE, text=True
    )


def wait_for(path: Path) -> None:
    for _ in range(600):
        if path.exists():
            return
        time.sleep(0.02)
    raise AssertionError(f"no {path.name}")


@pytest.mark.parametrize("code", [0, 2])
def test_a_job_ends_as_its_run_does(code: int, programs: Path) -> None:
    (programs / "go_on").write_text(str(code))
    job = start("one_node.sbatch", programs, "run.id=first", "seed=1")
    assert job.wait(60) == code and not (programs / "scontrol").exists()
    words = (programs / "words").read_text().split()
    assert words == ["run", "run.root=/home/me/popgen/runs", "cluster.num_cpus=4", "run.id=first", "seed=1"]


def test_before_its_time_limit_a_job_closes_its_books_and_is_queued_again(programs: Path) -> None:
    job = start("one_node.sbatch", programs, "run.id=first")
    wait_for(programs / "started")
    job.send_signal(signal.SIGTERM)  # to the script alone, as --signal=B:TERM does
    assert job.wait(60) == 15
    assert (programs / "books").read_text() == "closed\n" and (programs / "scontrol").read_text() == "requeue 71\n"


@pytest.mark.parametrize("script", ["one_node.sbatch", "nodes.sbatch"])
def test_a_job_without_an_id_could_not_go_on(script: str, programs: Path) -> None:
    job = start(script, programs, "seed=1")
    assert job.communicate()[1].startswith("popgen: error: run.id") and job.returncode == 2


def test_several_nodes_run_what_a_cluster_of_them_can_hold(programs: Path) -> None:
    assert start("nodes.sbatch", programs, "run.id=first", "seed=1").wait(60) == 0
    words = (programs / "srun").read_text().splitlines()
    separator = words.index("--")
    assert words[1:3] == ["ray", "symmetric-run"] and words[words.index("--address") + 1] == "n1:20071"
    program, command, *overrides = words[separator + 1 :]
    config = RunConfig.parse(compose(overrides))
    assert (program, command, config.cluster.address, config.run.id) == ("popgen", "run", "auto", "first")
    check_room(demands(config), [{"CPU": 4.0}] * 2)
    check_room(demands(config), [{"CPU": 1.0}] * 3)  # the preset is for small machines


@pytest.mark.parametrize("script", ["one_node.sbatch", "nodes.sbatch"])
def test_what_sbatch_reads_stands_before_the_first_command(script: str) -> None:
    lines = (SLURM / script).read_text().splitlines()
    first = next(number for number, line in enumerate(lines) if line and not line.startswith("#"))
    asked = [line for line in lines if line.startswith("#SBATCH ")]
    assert all(lines.index(line) < first for line in asked)
    assert all(re.fullmatch(r"#SBATCH --[a-z-]+(=\S+)?", line) for line in asked)


def test_the_recipe_of_apptainer_is_that_of_the_dockerfile() -> None:
    text = (ROOT / "docker" / "apptainer.def").read_text()
    dockerfile = (ROOT / "docker" / "Dockerfile").read_text()
    header, *sections = re.split(r"^%(\w+)$", text, flags=re.MULTILINE)
    parts = dict(zip(sections[::2], sections[1::2], strict=True))
    assert parts.keys() == {"help", "files", "post", "environment", "runscript"}
    base = re.search(r"^From: (\S+)$", header, re.MULTILINE)
    assert base and f"FROM {base[1]} AS base" in dockerfile
    version = re.search(r"torch==([\d.]+)", parts["post"])
    assert version and f"ARG TORCH_VERSION={version[1]}\n" in dockerfile
    copied = {line.split()[0] for line in parts["files"].strip().splitlines()}
    wheel = re.search(r"AS wheel\n(.*?)\nRUN", dockerfile, re.DOTALL)
    assert wheel and copied == {word for line in wheel[1].splitlines()[1:] for word in line.split()[1:-1]}
    assert all((ROOT / name).exists() for name in copied)
    assert '    exec popgen "$@"\n' in parts["runscript"]
