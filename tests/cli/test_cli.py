from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT

import popgen
from popgen.cli import population_commands
from popgen.cli.printing import print_json
from popgen.errors import UserError
from popgen.runs import preflight

Run = Callable[..., tuple[int, str, str]]
DRY = ("run", "--dry-run")
WALLED_DISH = "env.params.grid='XXPXXXX/O1 2XDX/X   XXX/XXXSXXX'"
HEAVY = ("ray", "mlflow")


@pytest.fixture
def no_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    """Importing Ray or MLflow fails, whether or not another test has imported it."""
    for name in HEAVY:
        monkeypatch.setitem(sys.modules, name, None)


def refused(result: tuple[int, str, str], *fragments: str) -> None:
    code, out, err = result
    assert code == 2 and out == ""
    assert err.startswith("popgen: error: ") and err.endswith("\n") and err.count("\n") == 1, err
    for fragment in fragments:
        assert fragment in err


BAD_OVERRIDES = {
    "unknown layout": (["env=overcooked/cramped_rom"], "did you mean env=overcooked/cramped_room?"),
    "unknown layout by name": (["env.name=overcooked/nowhere"], "env.name"),
    "unknown family": (["env.name=chess/board"], "env.name"),
    "layout without its family": (["env=cramped_room"], "did you mean env=overcooked/cramped_room?"),
    "layout file that is not there": (["env.name=overcooked/gone.layout"], "gone.layout"),
    "no grid": (["env=overcooked/custom"], "env.params.grid: is missing"),
    "no grid by name": (["env.name=overcooked/custom"], "env.params.grid: is missing"),
    "grid without a pot": (["env=overcooked/custom", "env.params.grid='XXXXX/O1 2O/X   X/XDXSX'"], "env.params.grid"),
    "unreachable dispenser": (["env=overcooked/custom", WALLED_DISH], "env.params.grid"),
    "ragged grid": (["env=overcooked/custom", "env.params.grid='XXPXX/O1 2O/X  X/XDXSX'"], "env.params.grid"),
    "grid with one player": (["env=overcooked/custom", "env.params.grid='XXPXX/O1  O/X   X/XDXSX'"], "env.params.grid"),
    "custom kitchen without a grid": (["env=overcooked/custom"], "env.name"),
    "unknown cooking mode": (["env.params.cooking=microwave"], "env.params.cooking"),
    "unknown parameter": (["env.params.coking=auto"], "env.params.coking"),
    "horizon 0": (["env.params.horizon=0"], "env.params.horizon"),
    "size 0": (["population.size=0"], "population.size"),
    "REINFORCE in two passes": (["agent.surrogate=reinforce"], "agent.surrogate"),
    "more minibatches than samples": (["agent.minibatches=9000"], "agent.minibatches"),
    "text for a number": (["population.size=three"], "population.size"),
    "quoted number": (["population.size='3'"], "population.size"),
    "truth for a number": (["population.size=true"], "population.size"),
    "half a member": (["population.size=2.5"], "population.size"),
    "unknown key": (["agent.lamda_xp=0.1"], "did you mean agent.lambda_xp?"),
    "unknown key with a plus": (["+agent.lamda_xp=0.1"], "did you mean agent.lambda_xp?"),
    "key in the wrong section": (["method.lambda_xp=0.1"], "did you mean agent.lambda_xp?"),
    "unknown section": (["optimizer.lr=0.1"], "optimizer.lr"),
    "Hydra's own key": (["hydra.run.dir=x"], "hydra.run.dir"),
    "Hydra's own key left out": (["~hydra/job_logging"], "hydra/job_logging"),
    "no equals sign": (["population.size"], "KEY=VALUE"),
    "unclosed brace": (["agent={"], "KEY=VALUE"),
    "several values": (["agent.lambda_xp=0.1,0.2"], "agent.lambda_xp=0.1,0.2"),
    "missing interpolation": (["agent.lambda_xp=${nothing}"], "agent.lambda_xp"),
    "section replaced by a number": (["agent=3"], "agent"),
    "group replaced by a number": (["env=5"], "overcooked/cramped_room"),
    "group replaced by a number beside a good one": (["env=5", "scale=smoke"], "env: there is no option '5'"),
    "group replaced by nothing": (["scale=null"], "choose one of demo, laptop, paper, smoke"),
    "no key": (["=5"], "KEY=VALUE"),
    "key without end": (["a" * 100_000 + "=1"], "aaa"),
    "reserved parameter": (["env.params.num_envs=1"], "env.params.num_envs"),
    "parameter of our own": (["env.params.self=1"], "env.params.self"),
    "seed of the environment alone": (["env.params.seed=1"], "set run.seed"),
    "more samplers than the machine bears": (["cluster.samplers=4000"], "cluster.samplers: 4000 processes on"),
    "more runners than it bears": (["method=lipo", "ppo.runners=4000", "ppo.envs=4000"], "ppo.runners: 4000 processes"),
    "fewer processors than actors ask for": (["cluster.num_cpus=1"], "the actors ask for 1.9"),
    "graphics cards that are not there": (["cluster.model_gpus=77"], "77 GPUs"),
    "resource of no local Ray": (["cluster.resources={tpu: 1}"], "cluster.resources.tpu"),
    "address with a space": (["tracking.uri='http://a b'"], "tracking.uri"),
    "mandatory value": (["agent.units=???"], "agent.units"),
    "unknown scale": (["scale=huge"], "choose one of demo, laptop, paper, smoke"),
    "unknown method": (["method=lipo2"], "method"),
    "unknown cluster": (["cluster=moon"], "cluster"),
    "unknown schedule": (["run.schedule=later"], "run.schedule"),
    "NaN learning rate": (["agent.actor_lr=nan"], "agent.actor_lr"),
    "negative learning rate": (["world_model.learning_rate=-1e-3"], "world_model.learning_rate"),
    "infinite learning rate": (["agent.critic_lr=inf"], "agent.critic_lr"),
    "negative lambda": (["agent.lambda_xp=-0.25"], "agent.lambda_xp"),
    "discount above 1": (["agent.discount=1.5"], "agent.discount"),
    "seed too large": (["seed=4294967296"], "run.seed"),
    "all groups joint": (["world_model.joint_groups=32"], "joint_groups"),
    "odd groups for two players": (["world_model.joint_groups=17"], "joint_groups"),
    "unknown view": (["world_model.view=smell"], "world_model.view"),
    "view that the environment lacks": (["env=rendezvous/mppmr", "world_model.view=lossless"], "world_model.view"),
    "windows longer than an episode": (["env.params.horizon=5"], "world_model.length"),
    "no room for open-loop steps": (["env.params.horizon=11"], "world_model.length"),
    "buffers smaller than a round": (["phase2.episodes_sp=6000"], "replay.capacity"),
    "buffers smaller than a segment": (["replay.capacity=100"], "replay.capacity"),
    "random play too short for a window": (["phase1.prefill_steps=1"], "phase1.prefill_steps"),
    "hardly any start states": (["phase2.cache=1"], "phase2.cache"),
    "even kernel": (["world_model.cnn_kernels=[4,3]"], "world_model.cnn_kernels"),
    "percentiles the wrong way round": (["agent.return_percentiles=[95,5]"], "agent.return_percentiles"),
    "probabilities of zero": (["agent.unimix=0"], "agent.unimix"),
    "an environment that rewards no event": (["env=rendezvous/mppmr"], "xpm_wm needs an environment with weighted"),
    "landmarks out of bounds": (["env=rendezvous/mppmr", "env.params.landmark_distance=9"], "env.params.landmark"),
    "run id that leaves the root": (["run.id=../elsewhere"], "run.id"),
    "run id that is a path": (["run.id=/tmp/x"], "run.id"),
    "empty run id": (["run.id=''"], "run.id"),
    "root below a file": (["run.root=file/runs"], "run.root"),
    "buffers larger than memory": (["replay.capacity=1e12"], "replay.capacity"),
    "tracking without a server": (["tracking=server"], "tracking.uri"),
    "tracking to nothing": (["tracking=server", "tracking.uri=http://127.0.0.1:9"], "tracking.uri"),
    "tracking to a folder": (["tracking.uri=mlruns"], "tracking.uri"),
    "start from nothing": (["population.init_from=nowhere"], "population.init_from"),
    "several at once": (["population.size=0", "scale=huge"], "scale"),
}


@pytest.mark.usefixtures("no_ray")
@pytest.mark.parametrize("case", BAD_OVERRIDES)
def test_bad_runs_are_refused_in_one_line_before_ray(case: str, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    Path("file").write_text("")
    overrides, fragment = BAD_OVERRIDES[case]
    refused(run("run", *overrides), fragment)
    assert {path.name for path in Path().iterdir()} == {"file"}


BAD_ARGUMENTS = {
    "unknown command": ["cook"],
    "unknown option": ["run", "--fast"],
    "population missing": ["evaluate"],
    "no population there": ["evaluate", "nowhere"],
    "no population to show": ["show", "nowhere"],
    "a path without end": ["show", "x" * 5000],
    "more environments than memory": ["bench", "env", "--envs", "999999999", "--seconds", "0.01"],
    "a folder that is no population": ["show", "."],
    "no episodes": ["evaluate", ".", "--episodes", "0"],
    "episodes in words": ["evaluate", ".", "--episodes", "many"],
    "negative seed": ["evaluate", ".", "--seed", "-1"],
    "parameter without a value": ["evaluate", ".", "--param", "cooking"],
    "unreadable members": ["evaluate", ".", "--members", "1,x"],
    "bench without what": ["bench"],
    "bench of nothing": ["bench", "moon"],
    "bench of no environments": ["bench", "env", "--envs", "0"],
    "bench for no time": ["bench", "env", "--seconds", "nan"],
}


@pytest.mark.usefixtures("no_ray")
@pytest.mark.parametrize("case", BAD_ARGUMENTS)
def test_bad_arguments_are_refused_in_one_line(case: str, run: Run) -> None:
    refused(run(*BAD_ARGUMENTS[case]))


BAD_FOR_THE_POPULATION = {
    "another layout": (["--env", "overcooked/coordination_ring"], "overcooked/cramped_room"),
    "another cooking mode": (["--param", "cooking=interact"], "interact"),
    "another horizon": (["--param", "horizon=400"], "env.params.horizon: is 400, the population was trained with 20"),
    "unknown layout": (["--env", "overcooked/nowhere"], "nowhere"),
    "unknown member": (["--members", "1,3"], "member 3"),
    "reserved parameter": (["--param", "layout=x"], "env.params.layout"),
    "more episodes than memory": (["--episodes", "2000000000"], "memory"),
    "the same member twice": (["--members", "1,1"], "members"),
    "report below a file": (["--out", "file/report"], "--out"),
}


@pytest.mark.usefixtures("no_ray")
@pytest.mark.parametrize("case", BAD_FOR_THE_POPULATION)
def test_evaluate_refuses_what_does_not_fit_the_population(case: str, run: Run, random_population: Path) -> None:
    Path("file").write_text("")
    arguments, fragment = BAD_FOR_THE_POPULATION[case]
    out = [] if "--out" in arguments else ["--out", "report"]
    refused(run("evaluate", str(random_population), *out, *arguments), fragment)


@pytest.mark.usefixtures("no_ray")
@pytest.mark.parametrize("damage", ["manifest", "weights", "no json"])
def test_a_damaged_population_is_refused(damage: str, run: Run, random_population: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(random_population, copy)
    if damage == "manifest":
        (copy / "manifest.json").write_text((copy / "manifest.json").read_text().replace("cramped", "crumpled"))
    elif damage == "no json":
        (copy / "manifest.json").write_text("{")
    else:
        with open(copy / "member_002" / "policy.safetensors", "ab") as file:
            file.write(b"x")
    for command in ("show", "evaluate"):
        refused(run(command, str(copy)))


INIT = {
    "another layout": (["env=overcooked/coordination_ring"], "env.name"),
    "another cooking mode": (["env.params.cooking=interact"], "cooking"),
    "more members than there are": (["population.init_members=3", "population.size=4"], "population.init_members"),
    "nothing left to train": (["population.init_members=2", "population.size=2"], "population.size"),
    "no checkpoint": (["population.init_members=2"], "checkpoint"),
    "the name of its origin": (["run.id=old"], "run.id"),
    "another world model": (["world_model.units=24"], "world_model.units"),
    "another actor": (["agent.layers=2"], "agent.layers"),
}


@pytest.mark.usefixtures("no_ray")
@pytest.mark.parametrize("case", INIT)
def test_a_run_refuses_a_start_that_does_not_fit(case: str, run: Run, model_run: Path) -> None:
    overrides, fragment = INIT[case]
    refused(run("run", "scale=smoke", f"population.init_from={model_run}", *overrides), fragment)


@pytest.mark.usefixtures("no_ray")
def test_a_run_starts_from_another_run_and_from_nothing_else(
    run: Run, model_run: Path, random_population: Path, tmp_path: Path
) -> None:
    start = ("scale=smoke", "env.params.horizon=20")
    assert run(*DRY, "scale=smoke", f"population.init_from={model_run}")[0] == 0
    refused(run("run", "scale=smoke", f"population.init_from={model_run / 'population'}"), "run's folder")
    shutil.copytree(random_population, tmp_path / "old" / "population")
    refused(run("run", *start, "population.init_from=old"), "population.init_from", "random")


@pytest.mark.usefixtures("no_ray")
def test_a_start_is_compared_by_its_own_config_which_may_be_of_another_version(
    run: Run, model_run: Path, tmp_path: Path
) -> None:
    shutil.copytree(model_run, tmp_path / "other")
    path = tmp_path / "other" / "config.json"
    known = json.loads(path.read_text())
    start = ("scale=smoke", "population.init_from=other")
    known["agent"]["lambda_warmup"] = 5
    del known["phase2"]
    path.write_text(json.dumps(known))
    assert run(*DRY, *start)[0] == 0
    for name in ("decoder_layers", "prior_layers", "head_layers"):  # none of them in the members' own records
        refused(run("run", *start, f"world_model.{name}=7"), f"world_model.{name}", "is 7, but 1")
    del known["world_model"]["reward_head"]  # of a version without that choice
    path.write_text(json.dumps(known))
    assert run(*DRY, *start)[0] == 0
    refused(run("run", *start, "world_model.reward_head=scalar"), "world_model.reward_head", "but 'events'")
    refused(run("run", *start, "replay.capacity=19999"), "replay.capacity", "20,000")
    for content in ("", "[]", '{"world_model": 1}'):
        path.write_text(content)
        refused(run("run", *start), "population.init_from", "config.json")
    path.unlink()
    refused(run("run", *start), "population.init_from", "config.json")


@pytest.mark.usefixtures("no_ray")
def test_a_dry_run_leaves_nothing(run: Run, tmp_path: Path) -> None:
    assert run(*DRY, "scale=smoke", "run.root=new/runs")[0] == 0
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("no_ray")
def test_a_small_disk_is_refused(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(".")
    monkeypatch.setattr(preflight.shutil, "disk_usage", lambda _: usage._replace(free=10 * 2**20))
    refused(run("run"), "run.root", "free")


@pytest.mark.usefixtures("new_parser")
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_disk_that_fills_up_is_one_line(number: int, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: Any) -> int:
        raise OSError(number, os.strerror(number), "runs/r/ledger.jsonl")

    monkeypatch.setattr(population_commands, "show", full)
    refused(run("show", "."), "runs/r/ledger.jsonl", "disk")


@pytest.mark.usefixtures("new_parser")
def test_an_error_of_ours_keeps_its_traceback(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(_: Any) -> int:
        raise OSError(errno.EIO, "the driver's own trouble")

    monkeypatch.setattr(population_commands, "show", wrong)
    with pytest.raises(OSError, match="own trouble"):
        run("show", ".")


@pytest.mark.usefixtures("new_parser")
def test_interruption_gives_130(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(_: Any) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(population_commands, "show", stopped)
    assert run("show", ".") == (130, "", "popgen: interrupted\n")


# --- what works


def test_version_and_help(run: Run) -> None:
    assert run("--version") == (0, f"popgen {popgen.__version__}\n", "")
    code, out, err = run("--help")
    assert code == 0 and err == "" and all(name in out for name in ("run", "evaluate", "show", "bench"))
    assert run("run", "--help")[1].count("--json") >= 2  # the option, and its keys
    code, out, err = run()
    assert code == 2 and out == "" and "COMMAND" in err


@pytest.mark.usefixtures("no_ray")
def test_dry_run_prints_the_configuration(run: Run) -> None:
    code, out, err = run(*DRY, "--json", "scale=smoke", "seed=3", "population.size=4")
    values = json.loads(out)
    assert (code, err) == (0, "") and (values["run"]["seed"], values["population"]["size"]) == (3, 4)
    code, text, _ = run(*DRY, "scale=smoke", "--json", "seed=3", "population.size=4")  # options anywhere
    assert code == 0 and json.loads(text) == values
    code, out, _ = run(*DRY, "scale=smoke", "seed=3")
    assert code == 0 and "  seed: 3\n" in out


def test_run_hands_the_config_over_and_prints_the_result(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    import types

    seen = []
    figure = {"mean": 1.5, "standard_error": None}
    result = {
        "run_id": "r",
        "run_dir": "runs/r",
        "population": "runs/r/population",
        "members": 2,
        "ledger": {"1": {"SP": 1234, "total": 1234}, "total": {"SP": 1234, "total": 1234}},
        "matrix": {"mean": [[9.0, 0.25], [float("nan"), 8.0]], "standard_error": [[0.5, 0.1], [None, 0.1]]},
        "weak_members": [],
        "seconds": 90.0,
        "findings": [{"text": "bad for " + "reasons " * 20, "good": False}],
        "files": {"report": "runs/r/report/report.html", "png": "runs/r/report/crossplay.png"},
    }
    environment = {"name": "overcooked/cramped_room"}
    evaluation = {"environment": environment, "unit": "dishes", "members": [1, 2], "sp": figure, "xp": figure}
    evaluation["matrix"] = {"mean": [[9.0, 0.25], [None, 8.0]], "standard_error": [[0.5, 0.1], [None, 0.1]]}
    evaluation["beside"] = {who: dict.fromkeys(("both", "seat_0", "seat_1"), figure) for who in ("random", "idle")}
    evaluation["obstruction"] = {"random": True, "idle": False, "pairs": []}
    evaluation |= {"episodes": 20, "steps": {"evaluation": 4000}}
    own = {"mean": 9.0, "standard_error": 0.5}
    seats = [(one, other) for one in ("1", "2") for other in ("1", "2", "random", "idle")]
    evaluation["pairs"] = [
        {"seat_0": one, "seat_1": other, "score": own if one == other else figure} for one, other in seats
    ]
    result["evaluation"] = evaluation

    def fake(config: Any, *, reporter: Any) -> dict[str, Any]:
        seen.append(config)
        reporter.note("working")
        return result

    module = types.ModuleType("popgen.pipelines.population")
    module.run_population = fake  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "popgen.pipelines.population", module)
    code, out, err = run("run", "scale=smoke", "--json")
    assert code == 0 and err == "working\n" and out.count("\n") == 1
    assert json.loads(out)["matrix"]["mean"] == [[9.0, 0.25], [None, 8.0]]
    assert seen[0].scale == "smoke" and seen[0].run.root == "runs"
    code, out, _ = run("run", "scale=smoke", "--quiet")
    assert code == 0 and "9.00" in out and "±0.50" in out and "1,234" in out
    assert "obstruction: XP is below play beside random partners" in out
    assert out.splitlines()[-1] == "ledger, checkpoints and reports: runs/r" and max(map(len, out.splitlines())) <= 80
    assert all(part in out for part in ("  ! bad for", "  popgen play runs/r --watch 1 2", "crossplay.png"))
    result["weak_members"] = ["member 2 does not play"]
    code, out, _ = run("run", "scale=smoke", "--quiet")
    assert code == 3 and out.splitlines()[-1] == "member 2 does not play"


def test_show(run: Run, random_population: Path) -> None:
    code, out, err = run("show", str(random_population), "--json")
    shown = json.loads(out)
    assert (code, err) == (0, "")
    assert set(shown) == {"path", "manifest", "bytes", "steps", "total_steps", "members"}
    assert [member["total_steps"] for member in shown["members"]] == [110, 210] and shown["total_steps"] == 320
    assert shown["manifest"]["environment"]["cooking"] == "auto"
    code, out, _ = run("show", str(random_population))
    assert code == 0 and "overcooked/cramped_room" in out and "210" in out
    assert out.splitlines()[-1] == f"population: {random_population}"


def test_evaluate(run: Run, random_population: Path) -> None:
    arguments = ("evaluate", str(random_population), "--episodes", "2", "--seed", "1", "--out", "report")
    code, out, err = run(*arguments, "--json", "--param", "cooking=auto")
    result = json.loads(out)
    assert code == 0 and "evaluation" in err
    assert result["members"] == [1, 2] and result["episodes"] == 2 and result["seed"] == 1
    assert all(Path(path).is_file() for path in result["files"].values()) and "json" in result["files"]
    code, out, err = run(*arguments, "--quiet")
    assert code == 0 and err == "" and "SP mean" in out and "\nreport: report (" in out


def test_a_layout_of_ones_own_is_measured_without_a_reference(run: Run) -> None:
    Path("mine.layout").write_text('{\'grid\': """XXPXX\\nO1 2O\\nX   X\\nXDXSX"""}')
    code, out, _ = run(
        *("bench", "env", "--env", "overcooked/./mine.layout", "--envs", "2", "--seconds", "0.01", "--json")
    )
    told = json.loads(out)
    assert code == 0 and told["steps_per_second"] > 0 and told["ratio"] is None


def test_figures_that_are_not_finite_become_null(capsys: pytest.CaptureFixture[str]) -> None:
    import numpy as np

    print_json({"a": [float("nan"), np.float32("inf"), np.arange(2)], "b": Path("x"), 3: np.int64(4)})
    assert json.loads(capsys.readouterr().out) == {"a": [None, None, [0, 1]], "b": "x", "3": 4}


@pytest.mark.end_to_end
@pytest.mark.parametrize(
    ("argv", "code"),
    [
        (["--help"], 0),
        (["run", "--dry-run", "scale=smoke", "run.root=RUNS"], 0),
        (["run", "population.size=0"], 2),
        (["run", "env=overcooked/custom", "env.params.grid='XXXXX/O1 2O/X   X/XDXSX'"], 2),
        (["evaluate", "nowhere"], 2),
    ],
)
def test_in_a_process_of_its_own_without_ray(argv: list[str], code: int, tmp_path: Path) -> None:
    program = (
        "import sys; from popgen.cli import main; code = main(sys.argv[1:]);"
        "loaded = sorted({'ray', 'mlflow'} & set(sys.modules)); assert not loaded, loaded; sys.exit(code)"
    )
    words = [word.replace("RUNS", str(tmp_path)) for word in argv]
    done = subprocess.run([sys.executable, "-c", program, *words], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == code, done.stderr
    assert done.stderr.count("\n") == (1 if code else 0)


@pytest.mark.end_to_end
def test_as_a_module() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "popgen", "run", "scale=huge"], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2 and done.stderr.startswith("popgen: error: scale: ") and done.stdout == ""


def test_user_errors_are_one_line() -> None:
    assert str(UserError("a", "b\n  c", "d")) == "a: b c; d"


@pytest.mark.usefixtures("no_ray")
@pytest.mark.parametrize("env", ["overcooked/cramped_room", "rendezvous/mppmr"])
def test_bench_env(env: str, run: Run) -> None:
    code, out, err = run("bench", "env", "--json", "--env", env, "--envs", "16", "--seconds", "0.05")
    result = json.loads(out)
    assert (code, err, result["env"]) == (0, "", env) and result["steps_per_second"] > 0
    reference = result["reference_steps_per_second"]
    if env.startswith("overcooked/"):
        assert reference > 0 and result["ratio"] == pytest.approx(result["steps_per_second"] / reference, rel=0.01)
    else:
        assert reference is None and result["ratio"] is None
    assert run("bench", "env", "--env", env, "--envs", "16", "--seconds", "0.05")[1].startswith(f"{env}: ")


def test_evaluate_egos_beside_hold_outs(run: Run, random_population: Path, tmp_path: Path) -> None:
    """A population on the left, another one and an agent of the user's on the right."""
    other = tmp_path / "other"
    shutil.copytree(random_population, other)
    manifest = json.loads((other / "manifest.json").read_text())
    (other / "manifest.json").write_text(json.dumps(manifest | {"seed": 5}))
    words = ("--with", f"held={other}", "popgen.policies.simple_policies:RandomPolicy", "--episodes", "1")
    code, out, err = run("evaluate", f"ego={random_population}", *words, "--out", "report", "--quiet")
    # RandomPolicy wants a number of actions, not a spec: an error of the agent's own is told in one line.
    refused((code, out, err), "cannot be made")
    (tmp_path / "broken_agents_of_a_user.py").write_text("class North(:\n    pass\n")
    broken = run("evaluate", "ego=broken_agents_of_a_user:North", "--with", str(other), "--quiet")
    refused(broken, "the module broken_agents_of_a_user fails when it is imported (SyntaxError: ")
    (tmp_path / "agents_of_a_user.py").write_text(
        "import numpy as np\nclass North:\n    view = 'features'\n    def reset(self, batch, seed): pass\n"
        "    def act(self, obs, previous, first): return np.zeros(obs.shape[:2], np.uint8)\n"
    )
    words = ("--with", f"held={other}", "agents_of_a_user:North", "--episodes", "1", "--out", "report")
    code, out, err = run("evaluate", f"ego={random_population}", *words, "--quiet")
    assert (code, err) == (0, "") and "all hold-outs" in out and "North" in out
    assert all(len(line) <= 80 for line in out.splitlines()[:-1])
    names = {f"holdout.{suffix}" for suffix in ("json", "csv", "md", "png", "svg")}
    assert {path.name for path in Path("report").iterdir()} == names
    refused(run("evaluate", str(random_population), "--with", str(random_population)), "which the ego")
    refused(run("evaluate", str(random_population), str(other)), "give one population")
    refused(run("evaluate", str(random_population), "--control", "x"), "evaluation with --with")
    refused(run("evaluate", str(random_population), "--with", str(other), "--members", "1"), "without --with")
