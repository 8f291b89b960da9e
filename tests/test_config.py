from __future__ import annotations

import re
from typing import Any

import pytest

from popgen.cli import compose, group_options
from popgen.config import RunConfig, closest_field
from popgen.envs import env_names, make_env
from popgen.errors import UserError

LAYOUTS = [name for name in env_names() if name.startswith("overcooked/")]


def parsed(*overrides: str) -> RunConfig:
    return RunConfig.parse(compose(list(overrides)))


def nested(name: str, value: Any) -> dict[str, Any]:
    for part in reversed(name.split(".")):
        value = {part: value}
    return value


def test_defaults_are_the_laptop_preset() -> None:
    default = RunConfig().model_dump()
    default["env"] = parsed().env.model_dump()
    assert parsed().model_dump() == default
    assert parsed("scale=laptop") == parsed()


@pytest.mark.parametrize("scale", group_options("scale"))
def test_every_scale_fits_every_environment(scale: str) -> None:
    for env in env_names():
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


def test_overrides_win_over_the_papers_table() -> None:
    config = parsed("scale=paper", "agent.lambda_xp=0.5", "phase1.max_steps=1000")
    assert (config.agent.lambda_xp, config.phase1.max_steps) == (0.5, 1000)


def test_seed_is_short_for_run_seed() -> None:
    assert parsed("seed=7").run.seed == 7


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

    walk(RunConfig().model_dump(), "")
    return found


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "3", True, None, [1]])
def test_no_number_takes_anything_else(value: Any) -> None:
    assert len(numeric_fields()) > 50
    for name in numeric_fields():
        with pytest.raises(UserError) as caught:
            RunConfig.parse(nested(name, value))
        assert caught.value.field == name and "\n" not in str(caught.value)


def test_no_number_is_negative() -> None:
    for name in set(numeric_fields()) - {"phase1.target_score"}:
        with pytest.raises(UserError, match=re.escape(name)):
            RunConfig.parse(nested(name, -1))


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
    assert closest_field(mistake) == meant


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


def test_a_config_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="frozen"):
        parsed().run.seed = 3  # type: ignore[misc]
