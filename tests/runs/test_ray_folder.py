from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import pytest

from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.runs import interruption
from popgen.runs.directory import named
from popgen.runs.interruption import end_on_sigterm
from popgen.runs.ray_folder import check_ray_folder, default_folder, holds_sockets, make_ray_folder

LONG = "scratch_of_a_batch_system_for_job_1355700/tmp.t0016_of_the_user_with_a_long_name"


def test_the_limit_is_that_of_the_system() -> None:
    assert holds_sockets(Path("/" + "x" * 38, "ray")) is True  # 39 + 68 bytes
    assert holds_sockets(Path("/" + "x" * 39, "ray")) is False
    assert holds_sockets(Path("/" + "ü" * 19, "ray")) and not holds_sockets(Path("/" + "ü" * 20, "ray"))


@pytest.mark.parametrize("name", ["TMPDIR", "RAY_TMPDIR"])
def test_a_long_folder_gets_a_short_name(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_TMPDIR", raising=False)
    monkeypatch.setenv(name, str(tmp_path / LONG))
    assert default_folder() == tmp_path / LONG / "ray"
    check_ray_folder()
    short = make_ray_folder()
    assert short is not None and holds_sockets(Path(short))
    Path(short, "session").mkdir()
    assert (tmp_path / LONG / "ray" / "session").is_dir()


def test_a_short_folder_is_used_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_TMPDIR", "/tmp")
    check_ray_folder()
    assert make_ray_folder() is None


def test_what_cannot_work_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path / LONG))
    with pytest.raises(UserError, match=r"^RAY_TMPDIR: .* is too long for Ray's sockets"):
        check_ray_folder(places=[str(tmp_path / "gone")])
    monkeypatch.delenv("RAY_TMPDIR")
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("TMPDIR", str(tmp_path / "file"))
    with pytest.raises(UserError, match=r"^TMPDIR: cannot write to"):
        check_ray_folder()


def test_sigterm_ends_in_an_orderly_way_and_only_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interruption, "_received", threading.Event())
    before = signal.getsignal(signal.SIGTERM)
    try:
        end_on_sigterm()
        with pytest.raises(SystemExit) as stop:
            os.kill(os.getpid(), signal.SIGTERM)
            signal.pause()
        assert stop.value.code == signal.SIGTERM
        os.kill(os.getpid(), signal.SIGTERM)  # while the books are being closed
    finally:
        signal.signal(signal.SIGTERM, before)


def test_an_exit_that_ray_numbers_anew_is_still_by_sigterm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interruption, "_received", threading.Event())
    before = signal.getsignal(signal.SIGTERM)
    assert interruption.describe_interruption(SystemExit(1)) is None
    try:
        end_on_sigterm()
        with pytest.raises(SystemExit):
            os.kill(os.getpid(), signal.SIGTERM)
            signal.pause()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert interruption.describe_interruption(SystemExit(1)) == "interrupted by SIGTERM"
    assert interruption.describe_interruption(RuntimeError("1")) is None


def test_runs_of_one_second_have_ids_of_their_own() -> None:
    config = RunConfig.parse({"method": "mappo", "env": {"name": "overcooked/kitchens/a [v2]?.layout"}})
    names = {str(named(config).run.id) for _ in range(50)}
    assert len(names) == 50 and all(name.startswith("mappo-a-v2--s0-") for name in names)
    from popgen.runs.preflight import check_run_id

    for name in names:
        check_run_id(name)
