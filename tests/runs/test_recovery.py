"""Deaths of actors and nodes: the run goes on by itself, and ends as if nothing had happened."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from ray import exceptions

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.pipelines import population as main_job
from popgen.runs import recovery
from popgen.runs.recovery import RetryBudget, actor_failure, user_facing_error, wait_for_room


def wrapped(cause: Exception) -> exceptions.RayTaskError:
    """As an actor's error reaches the driver."""
    return exceptions.RayTaskError("train", "traceback", cause).as_instanceof_cause()


def actor_died() -> exceptions.ActorDiedError:
    return exceptions.ActorDiedError()


@pytest.mark.parametrize(
    "error",
    [
        actor_died(),
        exceptions.ActorUnavailableError("gone", None),
        exceptions.NodeDiedError("gone"),
        exceptions.OwnerDiedError("0" * 56, "nobody", ""),
        exceptions.ObjectLostError("0" * 56, "nobody", ""),
        exceptions.OutOfMemoryError("too much"),
        wrapped(actor_died()),
        wrapped(wrapped(exceptions.WorkerCrashedError())),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_death_is_known_however_it_is_wrapped(error: Exception) -> None:
    cause = actor_failure(error)
    assert isinstance(cause, recovery.ACTOR_FAILURES) and not isinstance(cause, exceptions.RayTaskError)


def test_the_dead_are_named() -> None:
    text = "The actor died unexpectedly.\n\tclass_name: ModelActor\n\tactor_id: 1"
    assert recovery.first_line(exceptions.WorkerCrashedError()).startswith("WorkerCrashedError: ")
    said = recovery.first_line(wrapped(exceptions.NodeDiedError(text)).cause)
    assert said == "NodeDiedError (ModelActor): The actor died unexpectedly."


@pytest.mark.parametrize(
    "error", [ValueError("x"), wrapped(FloatingPointError("nan")), UserError("a", "b"), wrapped(OSError(28, "full"))]
)
def test_errors_of_the_work_itself_are_no_deaths(error: Exception) -> None:
    assert actor_failure(error) is None


def test_an_actor_that_could_not_be_made_is_not_made_again() -> None:
    error = actor_died()
    error._actor_init_failed = True
    assert actor_failure(error) is None


def test_users_errors_and_limits_come_out_of_an_actor_as_one_line() -> None:
    inner = UserError("tracking.uri", "cannot open it", "choose another")
    assert user_facing_error(wrapped(inner)) is inner
    full = user_facing_error(wrapped(exceptions.ObjectStoreFullError("full")))
    assert isinstance(full, UserError) and full.field == "cluster.object_store_bytes"
    other = ValueError("x")
    assert user_facing_error(other) is other


def test_patience_ends_with_deaths_in_a_row_at_the_same_place() -> None:
    retries = RetryBudget(2)
    for progress in ((0, 3), (0, 3), (0, 4), (0, 4), (1, 1), (1, 1)):
        retries.spend(progress, actor_died())
    with pytest.raises(UserError, match="3 deaths in a row without progress, the last: ActorDiedError") as caught:
        retries.spend((0, 9), actor_died())
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="1 deaths"):
        RetryBudget(0).spend((5, 5), actor_died())


def test_nodes_are_waited_for_and_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    config = RunConfig.parse(compose(["scale=smoke", "cluster.wait_seconds=60"]))
    have, said, now = [{"CPU": 1.0}, {"CPU": 1.0}, {"CPU": 8.0}], [], [0.0]
    dead = {"Alive": False, "Resources": {"CPU": 8.0}}

    def nodes() -> list[dict[str, Any]]:
        return [dead, {"Alive": True, "Resources": have.pop(0) if len(have) > 1 else have[0]}]

    monkeypatch.setattr("ray.nodes", nodes)
    monkeypatch.setattr(recovery.time, "sleep", lambda seconds: now.append(now[-1] + seconds))
    wait_for_room(config, said.append, clock=lambda: now[-1])
    (line,) = said
    assert (
        line.startswith("waiting 60 s at most for nodes: the actors ask for 1.9 CPU, the cluster has 1")
        and len(now) == 3
    )
    have[:] = [{"CPU": 1.0}]
    with pytest.raises(UserError, match="the actors ask for 1.9 CPU"):
        wait_for_room(config, said.append, clock=lambda: now[-1])
    assert now[-1] >= 60


def test_a_long_wait_is_told_every_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    overrides = ("cluster.wait_seconds=200", "cluster.model_gpus=1", "cluster.samplers=2", "cluster.sampler_cpus=4")
    config, said, now = RunConfig.parse(compose(["scale=smoke", *overrides])), [], [0.0]
    monkeypatch.setattr("ray.nodes", lambda: [{"Alive": True, "Resources": {"CPU": 2.0}}])
    monkeypatch.setattr(recovery.time, "sleep", lambda seconds: now.append(now[-1] + seconds))
    with pytest.raises(UserError) as caught:
        wait_for_room(config, said.append, clock=lambda: now[-1])
    for missing in ("9.8 CPU, the cluster has 2", "1 GPU, the cluster has 0", "cluster=cpu_nodes"):
        assert missing in said[0] and missing in str(caught.value)
    assert [line.split()[1] for line in said][0] == "200" and len(said) == 4


def run_with(monkeypatch: pytest.MonkeyPatch, root: Path, attempts: list[Callable[[Any], None]], **cluster: Any) -> Any:
    """The main job with a driver that does, attempt by attempt, what it is given."""
    from popgen.pipelines.population import run_population
    from popgen.progress import NullReporter

    def train(job: Any, recorder: Any, reporter: Any) -> None:
        attempts.pop(0)(recorder)

    monkeypatch.setattr(main_job.PopulationJob, "train_members", train)
    monkeypatch.setattr(main_job, "start_ray", lambda config: False)
    monkeypatch.setattr(main_job, "wait_for_room", lambda config, tell: None)
    monkeypatch.setattr(main_job, "finish", lambda config, spec, recorder, reporter: {"run_dir": str(recorder.dir)})
    overrides = ["scale=smoke", "tracking=off", f"run.root={root}", "run.id=r"]
    config = RunConfig.parse(compose([*overrides, *(f"cluster.{name}={value}" for name, value in cluster.items())]))
    return run_population(config, reporter=NullReporter())


def dies(recorder: Any) -> None:
    raise wrapped(actor_died())


def test_every_attempt_has_books_of_its_own_on_the_same_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[Any] = []

    def attempt(recorder: Any) -> None:
        seen.append(recorder)
        if len(seen) < 3:
            dies(recorder)

    run_with(monkeypatch, tmp_path, [attempt] * 3)
    assert [recorder.attempt for recorder in seen] == [1, 2, 3] and len({id(recorder) for recorder in seen}) == 3
    assert len({id(recorder.tracker) for recorder in seen}) == 1
    events = [line for line in (tmp_path / "r" / "run.log").read_text().splitlines() if '"event": "lost"' in line]
    assert len(events) == 2 and all("ActorDiedError" in line for line in events)


def test_the_run_gives_up_in_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    attempts: list[Callable[[Any], None]] = [dies] * 9
    with pytest.raises(UserError, match="cluster: 4 deaths in a row") as caught:
        run_with(monkeypatch, tmp_path, attempts, retries=3)
    assert "\n" not in str(caught.value) and len(attempts) == 5


def test_errors_of_the_work_end_the_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def diverges(recorder: Any) -> None:
        raise wrapped(FloatingPointError("loss not finite"))

    attempts: list[Callable[[Any], None]] = [dies, diverges, dies]
    with pytest.raises(UserError, match="training: loss not finite"):
        run_with(monkeypatch, tmp_path, attempts)
    assert len(attempts) == 1
