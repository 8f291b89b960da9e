"""Every shell command of the README and the pages: the newcomer's path is run from top to bottom at smoke scale, and
what takes hours or another machine is read, composed and checked as it is printed."""

from __future__ import annotations

import argparse
import glob
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT
from support.documented import LANGUAGES, PAGES, list_blocks, list_inline_commands, split_words

from popgen import cli
from popgen.cli.compose import compose
from popgen.cli.parser import _parser, parse
from popgen.config.run_config import RunConfig

NOT_RUN = {
    "make": "installs, or is a suite of tests of its own; the target is looked up (`make demo` is run as its recipe)",
    "pytest": "this is a test; its files are looked up",
    "python": "benchmarks and recordings of developers; the file or module is looked up",
    "mlflow": "a server without end; its own parser reads the line",
    "export": "a variable of the reader's shell",
    "ray": "a cluster: tests/test_service.py; the words of `popgen` are composed",
    "docker": "an engine: tests/docker",
    "sbatch": "Slurm: tests/docker/test_slurm.py; the words of `popgen run` are composed",
    "apptainer": "a tool that is seldom there: tests/docker/test_slurm.py",
    'POPGEN="apptainer': "the same",
}
"""First words of commands that are not executed, and why."""

ONLY_CHECKED = {
    "reproduce": "hours: piece by piece in tests/pipelines",
    "experiment": "hours: planned and checked here, run at smoke scale in tests/pipelines",
    "humans fit": "half a minute for each population: tests/humans",
    "bench ego": "processes of its own: tests/pipelines",
    "bench scale": "Ray: tests/pipelines",
    "bench mappo": "Ray: tests/pipelines",
}
"""Commands of popgen that are only parsed or planned, and why. So are `run` without a name for its folder (nothing
later reads it) and `sweep` over methods that need Ray."""

SMOKE = {
    "scale": "smoke",
    "env.params.horizon": "40",
    "population.size": "2",
    "evaluation.episodes": "1",
    "run.transport": "inline",
    "tracking": "off",
}
SMALL = {
    "evaluate": ["--episodes", "1"],
    "compare": ["--episodes", "1", "--no-tracking"],
    "bench env": ["--seconds", "0.02", "--envs", "16"],
    "conventions": ["--episodes", "1"],
}
ELSEWHERE = {
    "s3://bucket": "file://{folder}/bucket",
    "/shared/": "{folder}/",
    "humans/cramped_room_A": "runs/again",  # not fitted here
    ":1,2,3": ":1,2",
    "seed=1,2,3": "seed=1,2",
}
IN_PYTHON = {
    "runs/partners:3": "runs/partners:2",
    "humans/cramped_room_B": "runs/demo",
    '"best_response"})': '"best_response", "run.transport": "inline", "tracking.enabled": False}, scale="smoke")',
    "1_000_000": "8",
    "n_envs=8": "n_envs=1",
    "ent_coef=0.01": "n_steps=8, batch_size=8",
}
NEED_RAY = re.compile(r"\b(lipo|comedi|mappo|mep|trajedi)\b|method=fcp env")
"""RLlib's methods; a run of one is composed as printed, and trained as XPM-Sim."""

FOUND = [(line, block) for block in list_blocks() if block.language == "sh" for line in block.list_commands()]
COMMANDS = list(dict.fromkeys(line for line, _ in FOUND))
"""Each once, in the order of the pages."""

PLACES = {line: f"{block.page}:{block.line}" for line, block in reversed(FOUND)}
WITH_PLACE = [pytest.param(line, id=f"{PLACES[line]} {line}") for line in COMMANDS]


class Planned(Exception):
    """Everything before the first run was checked."""


def raise_planned(*args: Any, **kwargs: Any) -> Any:
    """In place of what would train."""
    raise Planned


def test_every_block_says_what_it_is() -> None:
    wrong = [f"{block.page}:{block.line}" for block in list_blocks() if block.language not in LANGUAGES]
    assert not wrong and len(COMMANDS) >= 40, wrong
    strange = {line.split()[0] for line in COMMANDS} - NOT_RUN.keys() - {"popgen", "jq"}
    assert not strange, strange


@pytest.mark.parametrize("line", [line for line in WITH_PLACE if line.values[0].split()[0] in NOT_RUN])
def test_what_is_not_run_names_what_is_there(line: str) -> None:
    first, *words = split_words(line)
    if first == "make":
        assert re.search(rf"^{words[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif first == "mlflow":
        import click
        from mlflow.cli import cli as commands

        command = commands.get_command(click.Context(commands), words[0])
        assert command is not None
        command.make_context(words[0], words[1:])
    elif first in ("pytest", "python", "sbatch"):
        files = [word for word in words if re.fullmatch(r"[\w./]+\.(py|sbatch)", word)]
        modules = [f"{word.replace('.', '/')}.py" for word in words if word.startswith("popgen.envs")]
        assert files + modules and all((ROOT / name).exists() for name in files + modules)
    told = re.search(r"(?:popgen run|\.sbatch)\s+(.*)", line)
    if told and first != "docker":
        check_run(split_words(told[1]))


def check_run(words: list[str]) -> None:
    """Settings of a run, as they are printed."""
    RunConfig.parse(compose([word for word in words if "=" in word and not word.startswith("-")]))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_usage_and_commands_in_running_text_name_options_that_exist(page: Path) -> None:
    blocks = [block for block in list_blocks() if block.page == page.relative_to(ROOT).as_posix()]
    texts = "\n".join(block.text for block in blocks if block.language == "text")
    usage = [text for text in re.split(r"^(?=popgen )|\n\n", texts, flags=re.M) if text and text.startswith("popgen ")]
    for text in [*list_inline_commands(page), *usage]:
        words = text.split()[1:]
        if words[0] == "COMMAND" or words[0].endswith(":") or re.match(r"[\w-]+(\||,)", words[0]):
            continue
        options = list_options(words)
        named = set(re.findall(r"(?<![\w-])--[a-z][\w-]*", text))
        assert named <= options, (text, named - options)


def list_options(words: list[str]) -> set[str]:
    """Of the command that the first words name."""
    parser: argparse.ArgumentParser = _parser()
    for word in words:
        kinds = next((action for action in parser._actions if isinstance(action, argparse._SubParsersAction)), None)
        if kinds is None:
            break
        if word not in kinds.choices:
            assert len(kinds.choices) < 8 and word is not words[0], f"there is no command {word}"
            break
        parser = kinds.choices[word]
    return {option for action in parser._actions for option in action.option_strings}


@pytest.fixture(scope="module")
def newcomer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder in which all commands are given, with the files that the pages tell the reader to write."""
    folder = tmp_path_factory.mktemp("newcomer")
    for block in list_blocks():
        if block.file:
            path = folder / block.file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text)
    yield folder


@pytest.fixture
def give(newcomer: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], None]:
    """`give(words)`: a command of popgen that must end well."""
    from popgen.pages import game_server
    from popgen.pipelines import experiments, population, shared_encoder_experiment, sweep

    def train_here(runs: Any, out: Path, concurrent: int, config_dir: str | None, reporter: Any, done: int) -> None:
        for run in runs:  # Ray Tune and processes: tests/pipelines/test_sweep.py
            assert cli.main([*run.command(config_dir)[3:], "--quiet"]) == 0

    monkeypatch.chdir(newcomer)
    monkeypatch.setattr(sweep, "run_on_tune", train_here)
    monkeypatch.setattr(game_server, "serve_games", lambda server, host, port, tell: tell("http://127.0.0.1:0"))
    monkeypatch.setattr(experiments, "self_sabotage", raise_planned)
    monkeypatch.setattr(shared_encoder_experiment, "shared_encoder", raise_planned)

    def call(words: list[str]) -> None:
        with monkeypatch.context() as patched, suppress(Planned):
            if words[0] == "sweep" and NEED_RAY.search(" ".join(words)):
                patched.setattr(sweep, "run_sweep", raise_planned)
            if "run.id=demo" not in words:  # the page of one run is enough: `popgen report` draws it again
                patched.setattr(population, "write_run_report", lambda source, seed: {"report": source.run.path})
            assert cli.main([*words, "--quiet"]) == 0

    return call


def test_every_command_is_one_that_popgen_reads() -> None:
    for line in COMMANDS:
        if line.startswith("popgen "):
            parse(split_words(line)[1:])


@pytest.mark.end_to_end
@pytest.mark.parametrize("line", [line for line in WITH_PLACE if re.match(r"popgen|make demo|jq", line.values[0])])
def test_the_newcomers_path(line: str, newcomer: Path, give: Callable[[list[str]], None]) -> None:
    if line == "make demo":
        line = re.search(r"^demo:.*\n\t\S*/(popgen .*)", (ROOT / "Makefile").read_text(), re.MULTILINE)[1]  # type: ignore[index]
    if line.startswith("jq "):
        if shutil.which("jq"):
            subprocess.run(line, shell=True, check=True, cwd=newcomer, capture_output=True)
        return
    words = split_words(line)[1:]
    parse(words)
    for there, here in ELSEWHERE.items():
        words = [word.replace(there, here.format(folder=newcomer)) for word in words]
    words = [path for word in words for path in (sorted(glob.glob(word)) if "*" in word else [word])]
    name = " ".join(words[:2]) if words[0] in ("bench", "ego", "humans") else words[0]
    if name in ("run", "ego train", "sweep"):
        train_small(name, words, give)
    elif name not in ONLY_CHECKED or name == "experiment":
        give([*words, *SMALL.get(name, [])])


def train_small(name: str, words: list[str], give: Callable[[list[str]], None]) -> None:
    """Settings as they are printed are checked; where the folder has a name, a small run is trained in it."""
    keys = {word.partition("=")[0] for word in words}
    needs_ray = NEED_RAY.search(" ".join(words)) is not None
    if name == "run":
        give([*(word for word in words if word != "--dry-run"), "--dry-run"])
    if name == "sweep" and needs_ray:
        give(words)
    if "--dry-run" in words or not {"run.id", "--out"} & keys and name != "ego train":
        return
    small = {} if "--from" in words else dict(SMOKE)  # a record is small
    if needs_ray or ("method" not in keys and "run.id=demo" not in words):  # the quickest
        small |= {} if name == "ego train" or "--from" in words else {"method": "xpm_sim"}
    small |= {"population.size": "1"} if name != "run" else {}
    give([*(word for word in words if word.partition("=")[0] not in small), *(f"{k}={v}" for k, v in small.items())])


@pytest.mark.end_to_end
@pytest.mark.parametrize("page", sorted({block.page for block in list_blocks() if block.language == "python"}))
def test_python_of_a_page_runs_from_top_to_bottom(page: str, newcomer: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import popgen

    monkeypatch.chdir(newcomer)
    names: dict[str, Any] = {"popgen": popgen, "population": popgen.load_population("runs/demo")}
    for block in [block for block in list_blocks() if block.page == page and block.language == "python"]:
        text = block.text
        for there, here in IN_PYTHON.items():
            text = text.replace(there, here)
        exec(compile(text, f"{page}:{block.line}", "exec"), names)
