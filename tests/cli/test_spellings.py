"""Settings as users write them: home folders, several values, files of layouts by any path."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from popgen.cli.arguments import expand_home, label_and_path, named_path
from popgen.cli.compose import compose
from popgen.cli.parser import parse
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.population import load_population
from popgen.runs.directory import run_folder
from popgen.runs.recorder import RunRecorder

Run = Callable[..., tuple[int, str, str]]
ORDERS = '"start_all_orders": [{"ingredients": ["onion", "onion", "onion"]}]'
ROWS = "XXPXX\\nO1 2O\\nX   X\\nXDXSX"
LAYOUT = f'{{"grid": """{ROWS}""", {ORDERS}}}'
MIRRORED = LAYOUT.replace("XDXSX", "XSXDX")


@pytest.fixture
def home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    monkeypatch.setenv("HOME", str(tmp_path / "the home"))
    return str(tmp_path / "the home")


@pytest.mark.parametrize("value", ["~/runs", "'~/runs'", '"~/runs"'])
def test_a_home_folder_is_meant_by_its_sign(value: str, home: str) -> None:
    assert RunConfig.parse(compose([f"run.root={value}"])).run.root == f"{home}/runs"
    assert RunConfig.parse(compose([f"population.init_from={value}"])).population.init_from == f"{home}/runs"
    assert RunConfig.parse({"run": {"root": "~/runs"}, "population": {"init_from": "~/r"}}).run.root == f"{home}/runs"


def test_homes_within_addresses_and_names(home: str, run: Run) -> None:
    assert compose(["tracking.uri=sqlite:///~/x.db"])["tracking"]["uri"] == f"sqlite:///{home}/x.db"
    Path(home, "k").mkdir(parents=True)
    Path(home, "k", "mine.layout").write_text(LAYOUT)
    assert run("run", "--dry-run", "scale=smoke", "env.name=overcooked/~/k/mine.layout")[0] == 0
    assert make_env("overcooked/~/k/mine.layout").spec.name == "overcooked/mine"
    assert named_path("a=~/x") == ("a", f"{home}/x") and named_path("~/x") == (None, f"{home}/x")
    assert label_and_path("a=~") == ("a", home)
    assert [expand_home(text) for text in ("a~b", "a/b~", "x~/y", "")] == ["a~b", "a/b~", "x~/y", ""]
    with pytest.raises(UserError, match="no home folder"):
        expand_home("~nobody_of_this_name/x")


def test_options_and_paths_of_every_command(home: str, run: Run, random_population: Path) -> None:
    Path(home).mkdir()
    Path(home, "p").symlink_to(random_population)
    assert run("show", "~/p")[0] == 0
    assert run("evaluate", "~/p", "--episodes", "1", "--quiet", "--out=~/report")[0] == 0
    assert Path(home, "report", "crossplay.json").is_file()
    assert len(load_population("~/p")) == 2


@pytest.mark.parametrize(
    "word",
    [
        "seed=range(1,3)",
        "seed=1,2",
        "seed=choice(1,2)",
        "agent.lambda_xp=interval(0,1)",
        "env=glob(*)",
        "scale=a,b",
    ],
)
def test_several_values_are_told_as_such(word: str, run: Run) -> None:
    code, out, err = run("run", "--dry-run", word)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "several values" in err and "popgen sweep makes several runs" in err and "multirun" not in err


@pytest.mark.parametrize(("words", "cooking"), [(["env=overcooked/cramped_room"], "auto"), ([], None)])
def test_a_layouts_file_alone_is_not_asked_for_the_default_layouts_cooking(words: list[str], cooking: str) -> None:
    name = "env.name='overcooked/./mine.layout'"
    assert compose([*words, name])["env"]["params"]["cooking"] == cooking
    assert compose([*words, name, "env.params.cooking=interact"])["env"]["params"]["cooking"] == "interact"


@pytest.mark.parametrize("flag", ["--multirun", "-m"])
def test_hydras_way_to_several_runs_names_ours(flag: str, run: Run) -> None:
    code, _, err = run("run", flag, "seed=1,2")
    assert code == 2 and "popgen sweep makes several runs" in err


# --- a run is known by what its paths mean


def keep_run(folder: Path, spelled: str, content: str = LAYOUT, **more: object) -> RunRecorder:
    values = {"method": "mappo", "env": {"name": f"overcooked/{spelled}"}, "run": {"id": "a", "root": str(folder)}}
    config = RunConfig.parse(values | more)
    return RunRecorder(config, make_env(config.env.name, 1, **config.env.params).spec)


@pytest.mark.parametrize("spelled", ["k/a.layout", "./k/../k/a.layout", "ABSOLUTE/k/a.layout", "elsewhere/b.layout"])
def test_a_layout_is_known_by_its_rules(spelled: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for path in ("k/a.layout", "elsewhere/b.layout"):
        Path(path).parent.mkdir()
        Path(path).write_text(LAYOUT)
    keep_run(tmp_path, "k/a.layout").close("KILLED")
    keep_run(tmp_path, spelled.replace("ABSOLUTE", str(tmp_path))).close("KILLED")


def test_another_layout_in_the_same_place_is_another_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.layout").write_text(LAYOUT)
    first = keep_run(tmp_path, "./a.layout")
    first.close("KILLED")
    before = (run_folder(first.config) / "config.json").read_bytes()
    Path("b.layout").write_text(MIRRORED)
    for name in ("./b.layout", "cramped_room"):
        with pytest.raises(UserError, match="another (environment|config)"):
            keep_run(tmp_path, name)
        assert (run_folder(first.config) / "config.json").read_bytes() == before


def test_an_origin_is_known_by_its_id() -> None:
    def digest(path: str) -> str:
        return RunConfig.parse({"method": "xpm_wm", "population": {"init_from": path}}).digest()

    assert digest("runs/first") == digest("../x/runs/first/") == digest("/shared/runs/first")
    assert digest("runs/first") != digest("runs/second")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("rnu", "there is no command 'popgen rnu'; did you mean popgen run?"),
        ("ego trian", "there is no command 'popgen ego trian'; did you mean popgen ego train?"),
        ("experiment sabotage", "did you mean popgen experiment self-sabotage?"),
        ("zzz", "there is no command 'popgen zzz'; see popgen --help"),
        ("run --dryrun", "unknown argument --dryrun; did you mean --dry-run?"),
        ("play x --wach 1 2", "unknown argument --wach; did you mean --watch?"),
        ("report x --zzzzz", "unknown argument --zzzzz; see popgen report --help"),
    ],
)
def test_a_misspelt_command_or_option_names_the_one_that_was_meant(words: str, told: str) -> None:
    with pytest.raises(UserError, match=re.escape(told)):
        parse(words.split())
