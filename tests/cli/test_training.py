"""What is settled before Ray is imported."""

from __future__ import annotations

import os
import sys

import pytest

from popgen.cli.training import before_ray

AUTH = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN")


@pytest.fixture(autouse=True)
def without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    """An environment and a process that know nothing of Ray; both are put back."""
    for name in (*AUTH, "OMP_NUM_THREADS", "OMP_WAIT_POLICY", "RAY_USAGE_STATS_ENABLED"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setattr(sys, "modules", {k: v for k, v in sys.modules.items() if k != "ray"})


def settled(local: bool) -> list[str | None]:
    before_ray(3, local)
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0" and os.environ["OMP_NUM_THREADS"] == "3"
    assert os.environ["OMP_WAIT_POLICY"] == "passive"
    return [os.environ.get(name) for name in AUTH]


def test_a_local_ray_gets_a_token_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    mode, token = settled(local=True)
    assert mode == "token" and token is not None and len(bytes.fromhex(token)) == 32
    for name in AUTH:
        monkeypatch.delenv(name)
    assert settled(local=True)[1] != token


def test_with_a_cluster_the_environment_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    assert settled(local=False) == [None, None]
    for mode, token in (("token", "mine"), ("disabled", "")):
        monkeypatch.setenv("RAY_AUTH_MODE", mode)
        monkeypatch.setenv("RAY_AUTH_TOKEN", token)
        assert settled(local=False) == settled(local=True) == [mode, token]


def test_a_ray_that_is_there_already_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has read its mode; a token that comes later would lock this process out."""
    monkeypatch.setattr(sys, "modules", sys.modules | {"ray": sys})
    assert settled(local=True) == [None, None]
