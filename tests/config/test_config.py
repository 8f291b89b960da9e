from __future__ import annotations

import hashlib
import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from popgen.cli.compose import compose, group_options
from popgen.config.run_config import RunConfig, closest_field
from popgen.envs import env_names, make_env
from popgen.errors import UserError
from popgen.methods.xpm_wm.config import XpmWmRun

LAYOUTS = [name for name in env_names() if name.startswith("overcooked/")]


@cache
def parsed(*overrides: str) -> RunConfig:
    """A configuration, which nobody can change; Hydra takes its time, and the same ones are asked for often."""
    return RunConfig.parse(compose(list(overrides)))


def nested(name: str, value: Any) -> dict[str, Any]:
    for part in reversed(name.split(".")):
        value = {part: value}
    return value


def test_without_a_scale_a_run_is_the_laptops() -> None:
    assert parsed("scale=laptop") == parsed() and parsed().scale == "laptop"


@pytest.mark.parametrize("scale", group_options("scale"))
def test_every_scale_fits_every_environment(scale: str) -> None:
    # tests/methods/test_recipes.py composes the laptop's and the demo's recipe on every layout.
    for env in env_names() if scale not in ("laptop", "demo") else ["rendezvous/mppmr", LAYOUTS[-1]]:
        config = parsed(f"scale={scale}", f"env={env}")
        assert (config.scale, config.env.name) == (scale, env)


@pytest.mark.parametrize("group", ["cluster", "tracking", "method"])
def test_every_option_of_the_other_groups_is_valid(group: str) -> None:
    assert group_options(group)
    for option in group_options(group):
        given = ["tracking.uri=http://localhost:5000"] if option == "server" else []
        parsed(f"{group}={option}", *given)


def test_every_environment_of_the_registry_has_its_file_and_the_file_builds_it() -> None:
    for name in env_names():
        config = parsed(f"env={name}").env
        spec = make_env(config.name, 1, **config.params).spec
        assert spec.name == name and spec.fingerprint == make_env(name).spec.fingerprint


PAPER = {  # phase 1 steps, phase 2 steps per agent, lambda_XP, in the order of the paper's layouts
    "overcooked/cramped_room": (20_000_000, 2_000_000, 0.25),
    "overcooked/asymmetric_advantages": (60_000_000, 2_000_000, 0.25),
    "overcooked/coordination_ring": (60_000_000, 3_000_000, 0.25),
    "overcooked/forced_coordination": (50_000_000, 4_000_000, 0.25),
    "overcooked/counter_circuit_o_1order": (80_000_000, 4_000_000, 0.1),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_paper_preset_is_the_papers_table(layout: str) -> None:
    config = parsed("scale=paper", f"env={layout}")
    assert (config.phase1.max_steps, config.phase2.max_steps, config.agent.lambda_xp) == PAPER[layout]
    model, agent = config.world_model, config.agent
    assert (model.view, model.cnn_kernels) == ("lossless", (5, 3, 3))
    assert (model.encoder_layers, model.decoder_layers, model.head_layers) == (3, 3, 5)
    assert (model.prior_layers, model.posterior_layers) == (2, 2)
    assert (model.units, model.deter, agent.units) == (512, 512, 512)
    assert (model.groups, model.joint_groups, model.classes) == (32, 28, 32)
    assert (model.activation, agent.activation) == ("leaky_relu", "leaky_relu")
    assert (model.learning_rate, agent.actor_lr, agent.critic_lr, agent.entropy) == (2e-4, 4e-5, 1e-4, 0.03)
    assert (agent.layers, agent.horizon, config.replay.capacity) == (5, 15, 1_000_000)
    assert config.phase1.steps_per_iteration == 50
    assert config.env.params["cooking"] == "auto" and config.env.params["events"] == "dispenser"


def test_the_paper_preset_has_nothing_of_the_laptops_recipe() -> None:
    config = parsed("scale=paper")
    model, agent, first, later = config.world_model, config.agent, config.phase1, config.phase2
    assert (model.imagination, model.event_scale, model.continue_scale) == ("sample", 1.0, 1.0)
    assert model.kl_predecessors > 0 and model.predecessors == "partner"
    assert (agent.lambda_ramp, agent.partner, agent.partner_random) == (0, "max_window", 0.0)
    assert (agent.actor_input, agent.sp_from_xp, agent.xp_starts) == ("model", 0.5, "partner")
    assert config.replay.event_fraction == 0.0
    assert (first.prefill_interact, first.pretrain_updates, first.recent_fraction) == (0.0, 1, 0.0)
    assert (later.new_fraction, later.starts_new) == (1.0, 1.0)
    assert (later.starts_random, later.starts_event, later.model_lr) == (0.0, 0.0, 2e-4)
    intervals = config.env.params["horizon"] // first.steps_per_iteration
    assert first.model_updates == first.agent_updates
    assert later.first_updates == later.updates_per_round == later.model_updates == intervals * first.agent_updates


@pytest.mark.parametrize("name", ["entropy", "discount"])
def test_a_later_member_has_member_1s_settings_unless_it_has_its_own(name: str) -> None:
    null = [f"phase2.{other}=null" for other in ("entropy", "discount") if other != name]
    config = parsed(f"agent.{name}=0.05", f"phase2.{name}=0.01", *null)
    assert [getattr(config.agent_of(member), name) for member in (1, 2, 8)] == [0.05, 0.01, 0.01]
    assert config.agent_of(8).model_copy(update={name: 0.05}) == config.agent
    same = parsed(f"agent.{name}=0.05", f"phase2.{name}=null", *null)
    assert same.agent_of(2) == same.agent


def test_a_dictionary_of_events_takes_any_event_by_its_dotted_name() -> None:
    discovery = parsed("discovery.event_factors.takes_dish=0.5").discovery
    assert discovery.event_factors == {"takes_dish": 0.5}


def test_overrides_win_over_the_papers_table() -> None:
    config = parsed("scale=paper", "agent.lambda_xp=0.5", "phase1.max_steps=1000")
    assert (config.agent.lambda_xp, config.phase1.max_steps) == (0.5, 1000)


def test_seed_is_short_for_run_seed() -> None:
    assert parsed("seed=7").run.seed == 7


def test_what_was_composed_before_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["scale=smoke", "agent.lambda_xp=0.3", "env.params.cooking=auto", "seed=4"]
    before = compose(words)
    before["agent"]["units"] = before["env"]["params"]["cooking"] = "changed by the caller"
    again, other = compose(words), compose(words[:1])
    monkeypatch.setattr("popgen.cli.compose._COMPOSED", {})
    assert again == compose(words) and other == compose(words[:1])
    assert (again["run"]["seed"], again["agent"]["lambda_xp"], again["env"]["params"]["cooking"]) == (4, 0.3, "auto")


@pytest.mark.parametrize(
    "words",
    [
        ["method=lipo", "scale=demo", "env=rendezvous/mppmr", "tracking=off"],
        ["agent={units: 8}", "+env.params.extra=1", "run.id=${run.seed}", "~cluster"],
        ["agent.units=1,2"],
        ["+moon/sea=1"],
    ],
)
def test_an_empty_folder_of_groups_changes_nothing(words: list[str], tmp_path: Path) -> None:
    def outcome(folder: str | None) -> Any:
        try:
            return compose(words, folder)
        except UserError as error:
            return str(error)

    assert outcome(None) == outcome(str(tmp_path))


def test_dictionaries_take_new_keys_without_a_sign() -> None:
    config = parsed("env.params.grid='XXPXX/O1 2O/X   X/XDXSX'", "cluster.resources.gpu_node=1")
    assert config.env.params["grid"] == "XXPXX/O1 2O/X   X/XDXSX"
    assert config.cluster.resources == {"gpu_node": 1.0}


def numeric_fields() -> list[str]:
    found = []

    def walk(values: dict[str, Any], prefix: str) -> None:
        for name, value in values.items():
            if isinstance(value, dict):
                walk(value, f"{prefix}{name}.")
            elif isinstance(value, int | float) and not isinstance(value, bool):
                found.append(prefix + name)

    walk(XpmWmRun().model_dump(), "")
    return found


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "3", True, None, [1]])
def test_no_number_takes_anything_else(value: Any) -> None:
    assert len(numeric_fields()) > 50
    for name in numeric_fields():
        with pytest.raises(UserError) as caught:
            RunConfig.parse(nested(name, value))
        assert caught.value.field == name and "\n" not in str(caught.value)


def test_no_number_is_negative() -> None:
    for name in set(numeric_fields()) - {"phase1.target_score", "phase2.target_score"}:
        with pytest.raises(UserError, match=re.escape(name)):
            RunConfig.parse(nested(name, -1))


@pytest.mark.parametrize("name", sorted(numeric_fields()))
def test_every_number_has_an_upper_bound(name: str) -> None:
    with pytest.raises(UserError) as caught:
        RunConfig.parse(nested(name, 10**18))
    assert caught.value.field == name


BOUNDS = {  # accepted, refused
    "world_model.classes": ([2, 256], [1, 257, 300]),
    "world_model.groups": ([18, 1024], [0, 1025, 10**9]),
    "world_model.units": ([1, 16_384], [10**8]),
    "world_model.deter": ([16_384], [16_385]),
    "world_model.encoder_layers": ([64], [0, 65]),
    "world_model.unimix": ([1e-6, 0.01], [0, 0.0]),
    "agent.unimix": ([1e-6], [0.0]),
    "world_model.length": ([2], [1, 2000]),
    "world_model.cnn_kernels": ([[1], [7, 5], [5, 3, 3]], [[], [4], [3, 2], [1000], [33], [3] * 17, [3, None]]),
    "agent.return_percentiles": ([[0, 100], [5.0, 95.0]], [[-5, 105], [95, 5], [5, 5], [0, 100.5], [5], [1, 2, 3]]),
    "agent.starts_sp": ([100_000], [10**6]),
    "phase1.envs": ([1, 1024], [10**8]),
    "phase2.episodes_xp": ([1], [0, -1, 10**9]),
    "phase2.cache": ([32], [1, 31]),
    "phase2.starts_random": ([0.0, 0.8], [0.81, 1.0]),
    "phase1.prefill_steps": ([12 * 64], [1, 12 * 64 - 1]),
    "phase1.steps_per_iteration": ([12], [1, 11]),
    "replay.capacity": ([64 * 400], [1, 100, 64 * 400 - 1]),
    "evaluation.episodes": ([1], [2 * 10**9]),
}


@pytest.mark.parametrize("name", BOUNDS)
def test_bounds(name: str) -> None:
    base = {"phase2": {"starts_event": 0.2}, "world_model": {"length": 8, "joint_groups": 16}}
    base |= {"phase1": {"envs": 64, "prefill_steps": 256_000, "steps_per_iteration": 100}}
    section, _, last = name.partition(".")
    accepted, refused = BOUNDS[name]
    for value in accepted:
        config = RunConfig.parse({**base, section: {**base.get(section, {}), last: value}})
        assert config.model_dump(mode="json")[section][last] == value
    for value in refused:
        with pytest.raises(UserError) as caught:
            RunConfig.parse({**base, section: {**base.get(section, {}), last: value}})
        assert re.sub(r"\.\d+$", "", caught.value.field) == name and "\n" not in str(caught.value), value


def test_the_replays_must_hold_what_is_added_at_once() -> None:
    """400 steps of random play or a longer iteration, in all environments."""
    for phase1, steps in (({"envs": 10, "prefill_steps": 500}, 1000), ({"envs": 3, "steps_per_iteration": 700}, 2100)):
        assert RunConfig.parse({"phase1": phase1, "replay": {"capacity": steps}}).replay.capacity == steps
        with pytest.raises(UserError, match=rf"replay\.capacity: cannot hold the {steps:,} steps"):
            RunConfig.parse({"phase1": phase1, "replay": {"capacity": steps - 1}})


@pytest.mark.parametrize(
    ("mistake", "meant"),
    [
        ("agent.lamda_xp", "agent.lambda_xp"),
        ("method.lambda_xp", "agent.lambda_xp"),
        ("lambda_xp", "agent.lambda_xp"),
        ("populaton.size", "population.size"),
        ("phase1.max_stps", "phase1.max_steps"),
        ("phase2.roundz", "phase2.rounds"),
        ("zzz", None),
    ],
)
def test_a_mistaken_key_finds_the_one_meant(mistake: str, meant: str | None) -> None:
    assert closest_field(mistake, XpmWmRun) == meant


def test_parse_names_the_unknown_field_and_the_one_meant() -> None:
    with pytest.raises(UserError, match=r"agent\.lamda_xp: there is no such field; did you mean agent\.lambda_xp\?"):
        RunConfig.parse({"agent": {"lamda_xp": 0.1}})


def test_the_digest_is_of_what_decides_the_result() -> None:
    base = parsed()
    same = parsed("cluster=gpu_node", "tracking=off", "run.id=x", "run.root=elsewhere")
    assert base.digest() == same.digest()
    others = [
        parsed("seed=1"),
        parsed("run.schedule=async"),
        parsed("agent.lambda_xp=0.1"),
        parsed("population.size=4"),
    ]
    assert len({base.digest(), *(other.digest() for other in others)}) == 5


def test_an_option_that_came_later_changes_only_the_digests_of_runs_that_use_it() -> None:
    base, with_floor = parsed("method=lipo"), parsed("method=lipo", "diversity.xp_floor=-1.0")
    written = base.as_dict()
    decides = {name: value for name, value in written.items() if name not in ("cluster", "tracking", "run")}
    decides |= {"seed": base.run.seed, "schedule": base.run.schedule}
    del decides["diversity"]["xp_floor"]  # as an earlier version would have it
    assert base.digest() == hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()
    assert base.unused_fields() == ["diversity.xp_floor"] and not with_floor.unused_fields()
    assert base.digest() != with_floor.digest()
    assert RunConfig.parse(written).digest() == base.digest()  # written without it, read with its default


def test_a_config_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="frozen"):
        parsed().run.seed = 3  # type: ignore[misc]
