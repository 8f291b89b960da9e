from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from popgen import durable_files
from popgen.envs import EnvSpec, make_env
from popgen.errors import UserError
from popgen.play.rollout import play
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.simple_policies import RandomPolicy
from popgen.population import Population, PopulationWriter, check_compatible, files, load_population

RUN = {"method": "xpm_wm", "config_digest": "d" * 64, "seed": 4}


@pytest.fixture(scope="module")
def spec() -> EnvSpec:
    return make_env("rendezvous/mppmr", 1, horizon=10).spec


def network(spec: EnvSpec, seed: int = 0) -> FeedForwardPolicy:
    return FeedForwardPolicy(spec.views["features"], spec.num_actions, units=8, layers=1, seed=seed)


def fill(writer: PopulationWriter, spec: EnvSpec, members: int) -> None:
    for member in range(len(writer) + 1, members + 1):
        training = {"critic": np.full((2, 3), member, np.float32)}
        writer.add_member(network(spec, member), seed=member, steps={"SP": 10 * member, "XP": 1}, training=training)


def trajectory(population: Population, members: tuple[int, int]) -> np.ndarray:
    steps: list[np.ndarray] = []
    matches = [population[members[0]], population[members[1]]]
    play(
        population.make_env(4),
        matches,
        np.tile([[0, 1]], (4, 1)),
        seed=2,
        record=lambda step: steps.append(step.actions),
    )
    return np.stack(steps)


def test_round_trip(tmp_path: Path, spec: EnvSpec) -> None:
    writer = PopulationWriter(tmp_path / "a" / "p", spec, **RUN)
    first, second = network(spec, 1), RandomPolicy(spec.num_actions, [0.1, 0.2, 0.3, 0.4, 0.0])
    writer.add_member(first, seed=7, steps={"SP": 5, "random": 2}, training={"v": np.float32(3)})
    extra = {"curve": [1.0, float("nan")], "best": np.float64(2.5), "at": (1, np.int64(2)), "grid": np.eye(2)}
    writer.add_member(second, seed=8, steps={}, extra=extra)
    population = load_population(tmp_path / "a" / "p")
    assert len(population) == 2 and len(list(population)) == 2
    assert population.spec == spec and population.env_info.name == "rendezvous/mppmr"
    assert population.env_info.params == spec.params and population.env_info.cooking is None
    assert (population.manifest.method, population.manifest.config_digest, population.manifest.seed) == (
        "xpm_wm",
        "d" * 64,
        4,
    )
    assert population[1].weights().keys() == first.weights().keys()
    for name, array in population[1].weights().items():
        np.testing.assert_array_equal(array, first.weights()[name])
        assert array.dtype == np.float32
    assert population[2].config() == second.config()
    assert population.info(1).steps == {"SP": 5, "random": 2} and population.info(1).total_steps == 7
    assert population.info(2).seed == 8 and population.info(2).extra == {
        "curve": [1.0, None], "best": 2.5, "at": [1, 2], "grid": [[1.0, 0.0], [0.0, 1.0]]
    }  # fmt: skip
    training = population.training(1)
    assert training is not None and training["v"] == 3 and population.training(2) is None
    assert sorted(path.name for path in population.path.iterdir()) == ["manifest.json", "member_001", "member_002"]


def test_every_lookup_gives_a_fresh_policy_that_plays_the_same(tmp_path: Path, spec: EnvSpec) -> None:
    fill(PopulationWriter(tmp_path, spec, **RUN), spec, 2)
    population = load_population(tmp_path)
    assert population[1] is not population[1]
    first = trajectory(population, (1, 2))
    np.testing.assert_array_equal(first, trajectory(load_population(tmp_path), (1, 2)))
    assert (first != trajectory(population, (2, 1))).any()


def test_members_count_from_one(tmp_path: Path, spec: EnvSpec) -> None:
    writer = PopulationWriter(tmp_path, spec, **RUN)
    with pytest.raises(IndexError, match="no members"):
        load_population(tmp_path)[1]
    fill(writer, spec, 2)
    population = load_population(tmp_path)
    for bad in (0, -1, 3):
        with pytest.raises(IndexError, match=f"no member {bad}: .* has members 1 to 2"):
            population[bad]
    with pytest.raises(TypeError):
        population["1"]  # type: ignore[index]
    with pytest.raises(IndexError):
        population.training(3)
    np.testing.assert_array_equal(population[np.int64(2)].weights()["0.bias"], population[2].weights()["0.bias"])


def test_nothing_is_overwritten(tmp_path: Path, spec: EnvSpec) -> None:
    fill(PopulationWriter(tmp_path, spec, **RUN), spec, 1)
    before = (tmp_path / "manifest.json").read_bytes()
    with pytest.raises(UserError, match="holds a population already"):
        PopulationWriter(tmp_path, spec, **RUN)
    for change in ({"method": "lipo"}, {"config_digest": "e"}, {"seed": 5}):
        with pytest.raises(UserError, match=f"another {next(iter(change))}"):
            PopulationWriter(tmp_path, spec, **{**RUN, **change}, resume=True)
    with pytest.raises(UserError, match="another environment"):
        PopulationWriter(tmp_path, make_env("rendezvous/mppmr", 1, horizon=11).spec, **RUN, resume=True)
    assert (tmp_path / "manifest.json").read_bytes() == before
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.txt").write_text("mine")
    with pytest.raises(UserError, match="is not empty"):
        PopulationWriter(other, spec, **RUN)
    with pytest.raises(UserError, match="cannot be written"):
        PopulationWriter(other / "thesis.txt", spec, **RUN)
    assert (other / "thesis.txt").read_text() == "mine"


def test_resuming_goes_on_with_the_next_member(tmp_path: Path, spec: EnvSpec) -> None:
    PopulationWriter(tmp_path / "new", spec, **RUN, resume=True)
    assert len(load_population(tmp_path / "new")) == 0
    fill(PopulationWriter(tmp_path / "whole", spec, **RUN), spec, 3)
    fill(PopulationWriter(tmp_path / "cut", spec, **RUN), spec, 1)
    fill(PopulationWriter(tmp_path / "cut", spec, **RUN, resume=True), spec, 3)
    for path in (tmp_path / "whole").rglob("*.*"):
        assert path.read_bytes() == (tmp_path / "cut" / path.relative_to(tmp_path / "whole")).read_bytes()


def test_a_second_writer_is_noticed(tmp_path: Path, spec: EnvSpec) -> None:
    one = PopulationWriter(tmp_path, spec, **RUN)
    two = PopulationWriter(tmp_path, spec, **RUN, resume=True)
    fill(one, spec, 1)
    with pytest.raises(UserError, match="changed by another run"):
        fill(two, spec, 1)
    assert len(load_population(tmp_path)) == 1


def test_a_foreign_folder_in_the_way_is_left_alone(tmp_path: Path, spec: EnvSpec) -> None:
    writer = PopulationWriter(tmp_path, spec, **RUN)
    (tmp_path / "member_001").mkdir()
    (tmp_path / "member_001" / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="is in the way"):
        fill(writer, spec, 1)
    assert (tmp_path / "member_001" / "notes.txt").read_text() == "mine" and len(load_population(tmp_path)) == 0


def test_bad_members_are_refused_before_anything_is_written(tmp_path: Path, spec: EnvSpec) -> None:
    writer = PopulationWriter(tmp_path, spec, **RUN)
    broken = network(spec)
    broken.net[0].bias.data[2] = np.nan
    with pytest.raises(UserError, match=r"member_001/policy\.safetensors: tensor '0\.bias' holds numbers"):
        writer.add_member(broken, seed=0, steps={})
    with pytest.raises(UserError, match=r"training\.safetensors: tensor 'v'"):
        writer.add_member(network(spec), seed=0, steps={}, training={"v": np.array([np.inf])})
    with pytest.raises(ValueError, match="steps of unknown kind naps"):
        writer.add_member(network(spec), seed=0, steps={"naps": 3})
    with pytest.raises(ValueError, match="expected no tensors"):
        odd = RandomPolicy(spec.num_actions)
        odd.weights = lambda: {"w": np.zeros(1)}  # type: ignore[method-assign]
        writer.add_member(odd, seed=0, steps={})
    assert [path.name for path in tmp_path.iterdir()] == ["manifest.json"] and len(writer) == 0


class Killed(BaseException):
    """The process ends here."""


@pytest.fixture
def fail_at(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int, BaseException], None]]:
    """Makes the n-th step of writing fail; a Killed process does not clean up either."""

    def arm(number: int, error: BaseException) -> None:
        left = [number]

        def faulty(real: Callable) -> Callable:
            def call(*args: object, **kwargs: object) -> object:
                left[0] -= 1
                if left[0] == 0:
                    raise error
                return real(*args, **kwargs)

            return call

        monkeypatch.setattr(durable_files, "write_file", faulty(durable_files.write_file))
        for name in ("fsync", "rename", "replace"):
            monkeypatch.setattr(os, name, faulty(getattr(os, name)))
        if isinstance(error, Killed):
            monkeypatch.setattr(shutil, "rmtree", lambda *args, **kwargs: None)
            monkeypatch.setattr(Path, "unlink", lambda *args, **kwargs: None)

    yield arm


STEPS_OF_A_MEMBER = 3 * 2 + 1 + 1 + 1 + 2 + 2  # three files, their folder, rename, its parent; the manifest likewise


@pytest.mark.parametrize("number", range(1, STEPS_OF_A_MEMBER + 1))
@pytest.mark.parametrize("error", [Killed(), OSError(errno.ENOSPC, "No space left on device")])
def test_an_interruption_anywhere_leaves_a_population(
    tmp_path: Path,
    spec: EnvSpec,
    fail_at: Callable[[int, BaseException], None],
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    error: BaseException,
) -> None:
    writer = PopulationWriter(tmp_path, spec, **RUN)
    fill(writer, spec, 1)
    fail_at(number, error)
    expected = Killed if isinstance(error, Killed) else UserError
    with pytest.raises(expected) as caught:
        fill(writer, spec, 2)
    monkeypatch.undo()
    if expected is UserError:
        assert "the disk is full" in str(caught.value) and "\n" not in str(caught.value)
        assert not list(tmp_path.rglob(f"{files.TEMPORARY}*"))
    population = load_population(tmp_path)
    # The last step only makes the name of the new manifest durable.
    assert len(population) == (2 if number == STEPS_OF_A_MEMBER else 1)
    again = PopulationWriter(tmp_path, spec, **RUN, resume=True)
    fill(again, spec, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["manifest.json", *(f"member_00{n}" for n in (1, 2, 3))]
    assert [info.seed for info in load_population(tmp_path).members] == [1, 2, 3]


def test_the_number_of_steps_above_is_right(
    tmp_path: Path, spec: EnvSpec, fail_at: Callable[[int, BaseException], None]
) -> None:
    fail_at(3 + 1 + STEPS_OF_A_MEMBER + 1, Killed())  # writing the empty manifest takes four steps
    fill(PopulationWriter(tmp_path, spec, **RUN), spec, 1)


def test_a_writer_goes_on_after_a_full_disk(
    tmp_path: Path, spec: EnvSpec, fail_at: Callable[[int, BaseException], None]
) -> None:
    writer = PopulationWriter(tmp_path, spec, **RUN)
    fail_at(STEPS_OF_A_MEMBER - 2, OSError(errno.ENOSPC, "No space left on device"))  # the folder is there already
    with pytest.raises(UserError, match="the disk is full; free some space"):
        fill(writer, spec, 1)
    assert len(writer) == 0 and (tmp_path / "member_001").is_dir()
    fill(writer, spec, 1)
    assert len(load_population(tmp_path)) == 1


def test_compatibility_names_both_values(tmp_path: Path) -> None:
    made = {mode: make_env("overcooked/cramped_room", 1, cooking=mode).spec for mode in ("auto", "interact")}
    writer = PopulationWriter(tmp_path, made["auto"], **RUN)
    writer.add_member(RandomPolicy(6), seed=0, steps={})
    population = load_population(tmp_path)
    assert population.env_info.cooking == "auto"
    check_compatible(population, made["auto"])
    with pytest.raises(UserError, match="cooking: is interact, the population was trained with auto"):
        check_compatible(population, made["interact"])
    ring = make_env("overcooked/coordination_ring", 1, cooking="auto").spec
    with pytest.raises(UserError) as caught:
        check_compatible(population, ring)
    for part in ("coordination_ring", "cramped_room", ring.fingerprint[:12], made["auto"].fingerprint[:12]):
        assert part in str(caught.value)


def test_a_grid_given_as_text_is_rebuilt(tmp_path: Path) -> None:
    spec = make_env("overcooked/mine", 1, grid="XXPXX/O1 2O/X   X/XDXSX", horizon=12).spec
    PopulationWriter(tmp_path, spec, **RUN).add_member(RandomPolicy(6), seed=0, steps={})
    population = load_population(tmp_path)
    assert population.spec == spec and population.make_env(3).num_envs == 3
    assert "grid" in json.loads((tmp_path / "manifest.json").read_text())["environment"]["params"]
