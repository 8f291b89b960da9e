"""Every way in which an artefact can be bad gives one line that names the file, and nothing is executed."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save, save_file

from popgen.envs import make_env
from popgen.errors import UserError
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.simple_policies import IdlePolicy
from popgen.population import PopulationWriter, load_population
from popgen.population.files import digest, read_tensors

POLICY, TRAINING, MEMBER = "policy.safetensors", "training.safetensors", "member.json"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("good") / "population"
    spec = make_env("rendezvous/mppmr", 1).spec
    writer = PopulationWriter(path, spec, method="xpm_wm", config_digest="d", seed=0)
    policy = FeedForwardPolicy(spec.views["features"], spec.num_actions, units=8)
    writer.add_member(policy, seed=1, steps={"SP": 3}, training={"critic": np.ones(3, np.float32)})
    writer.add_member(IdlePolicy(spec.action_names), seed=2, steps={})
    return path


def edit(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def in_manifest(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    return lambda root: edit(root / "manifest.json", change)


def in_member(change: Callable[[dict[str, Any]], None], policy: bytes | None = None) -> Callable[[Path], None]:
    """Change member 1 as an attacker would: with all sums made right again."""

    def mutate(root: Path) -> None:
        folder = root / "member_001"
        if policy is not None:
            (folder / POLICY).write_bytes(policy)
        digest = hashlib.sha256((folder / POLICY).read_bytes()).hexdigest()
        edit(folder / MEMBER, lambda value: (value.update(policy_sha256=digest), change(value)))
        signed = hashlib.sha256((folder / MEMBER).read_bytes()).hexdigest()
        edit(root / "manifest.json", lambda value: value["members"][0].update(sha256=signed))

    return mutate


def flip(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


def in_weights(change: Callable[[dict[str, np.ndarray]], None]) -> Callable[[Path], None]:
    def mutate(root: Path) -> None:
        tensors = load_file(root / "member_001" / POLICY)
        change(tensors)
        in_member(lambda value: None, save(tensors))(root)

    return mutate


class Bomb:
    """Creates a file when it is unpickled."""

    def __reduce__(self) -> tuple:
        return os.mkdir, ("exploded",)


def torch_archive(root: Path) -> None:
    torch.save({"0.bias": Bomb()}, root / "member_001" / POLICY)


def folder_for_weights(root: Path) -> None:
    (root / "member_001" / POLICY).unlink()
    (root / "member_001" / POLICY).mkdir()


CASES: dict[str, tuple[Callable[[Path], object], str, str]] = {
    # name: (what is done to the folder, the file that the line must name, what it must say)
    "no folder": (shutil.rmtree, "population", "is not a population"),
    "no manifest": (lambda root: (root / "manifest.json").unlink(), "population", "has no manifest.json"),
    "manifest is a folder": (
        lambda root: ((root / "manifest.json").unlink(), (root / "manifest.json").mkdir()),
        "manifest.json",
        "is not a regular file",
    ),
    "manifest cut": (
        lambda root: (root / "manifest.json").write_bytes((root / "manifest.json").read_bytes()[:-20]),
        "manifest.json",
        "is not valid JSON",
    ),
    "manifest not text": (lambda root: (root / "manifest.json").write_bytes(b"\xff\xfe\x00"), "manifest.json", "JSON"),
    "manifest nested": (lambda root: (root / "manifest.json").write_text("[" * 100_000), "manifest.json", "JSON"),
    "manifest with a key twice": (
        lambda root: (root / "manifest.json").write_text(
            (root / "manifest.json").read_text().replace("{", '{"seed": 1, ', 1)
        ),
        "manifest.json", "key 'seed' stands twice",
    ),
    "manifest a device": (
        lambda root: ((root / "manifest.json").unlink(), (root / "manifest.json").symlink_to("/dev/zero")),
        "manifest.json", "is not a regular file",
    ),
    "manifest of something else": (
        lambda root: (root / "manifest.json").write_text("[]"), "manifest.json", "not the manifest"
    ),
    "foreign format": (in_manifest(lambda v: v.update(format="zoo")), "manifest.json", "not the manifest"),
    "newer version": (in_manifest(lambda v: v.update(format_version=2)), "manifest.json", "has format version 2"),
    "no version": (in_manifest(lambda v: v.pop("format_version")), "manifest.json", "has format version None"),
    "unknown key": (in_manifest(lambda v: v.update(colour=1)), "manifest.json", "colour"),
    "missing key": (in_manifest(lambda v: v.pop("method")), "manifest.json", "method"),
    "text for a number": (in_manifest(lambda v: v.update(seed="0")), "manifest.json", "seed"),
    "path traversal": (in_manifest(lambda v: v["members"][0].update(folder="../secret")), "manifest.json", "folder"),
    "absolute path": (in_manifest(lambda v: v["members"][0].update(folder="/etc")), "manifest.json", "folder"),
    "newline in a folder": (
        in_manifest(lambda v: v["members"][0].update(folder="member_001\n")), "manifest.json", "folder"
    ),
    "folder of another": (
        in_manifest(lambda v: v["members"][0].update(folder="member_002")), "manifest.json", "must lie in member_001"
    ),
    "order": (in_manifest(lambda v: v["members"].reverse()), "manifest.json", "numbered 1, 2"),
    "unknown environment": (
        in_manifest(lambda v: v["environment"].update(name="chess/blitz")), "manifest.json", "chess/blitz"
    ),
    "unknown parameter": (
        in_manifest(lambda v: v["environment"]["params"].update(gravity=9.8)), "manifest.json", "gravity"
    ),
    "changed rules": (
        in_manifest(lambda v: v["environment"]["params"].update(damping=0.5)), "manifest.json", "has rules"
    ),
    "changed fingerprint": (
        in_manifest(lambda v: v["environment"].update(fingerprint="0" * 64)), "manifest.json", "000000000000"
    ),
    "no member folder": (lambda root: shutil.rmtree(root / "member_002"), "member_002/member.json", "is missing"),
    "member edited": (
        lambda root: edit(root / "member_001" / MEMBER, lambda v: v.update(seed=9)), "member_001/member.json", "edited"
    ),
    "member of another": (in_member(lambda v: v.update(id=2)), "member_001/member.json", "is of member 2, not 1"),
    "member with unknown steps": (
        in_member(lambda v: v.update(steps={"naps": 1})), "member_001/member.json", "unknown kind naps"
    ),
    "member with negative steps": (
        in_member(lambda v: v.update(steps={"SP": -1})), "member_001/member.json", "steps.SP"
    ),
    "unknown policy kind": (
        in_member(lambda v: v.update(kind="os:system")), "member_001/policy.safetensors", "unknown policy kind"
    ),
    "config that fits no policy": (
        in_member(lambda v: v.update(config={"units": "x"})), "member_001/policy.safetensors", "invalid literal"
    ),
    "config of other sizes": (
        in_member(lambda v: v["config"].update(units=9)), "member_001/policy.safetensors", "shape"
    ),
    "no weights": (lambda root: (root / "member_001" / POLICY).unlink(), "member_001/policy.safetensors", "is missing"),
    "weights are a folder": (folder_for_weights, "member_001/policy.safetensors", "is not a regular file"),
    "weights cut": (
        lambda root: os.truncate(root / "member_001" / POLICY, 100), "member_001/policy.safetensors", "truncated"
    ),
    "weights of a hundred gigabytes": (
        lambda root: os.truncate(root / "member_001" / POLICY, 100 * 2**30),
        "member_001/policy.safetensors", "is larger than 2 GiB",
    ),
    "weights a link to themselves": (
        lambda root: ((root / "member_001" / POLICY).unlink(), (root / "member_001" / POLICY).symlink_to(POLICY)),
        "member_001/policy.safetensors", "cannot be read",
    ),
    "weights a link to nowhere": (
        lambda root: ((root / "member_001" / POLICY).unlink(), (root / "member_001" / POLICY).symlink_to("gone")),
        "member_001/policy.safetensors", "is missing",
    ),
    "weights empty": (
        lambda root: os.truncate(root / "member_001" / POLICY, 0), "member_001/policy.safetensors", "truncated"
    ),
    "a bit flipped": (
        lambda root: flip(root / "member_001" / POLICY, -5), "member_001/policy.safetensors", "damaged"
    ),
    "a bit flipped in training": (
        lambda root: flip(root / "member_001" / TRAINING, -1), "member_001/training.safetensors", "damaged"
    ),
    "pickle": (
        lambda root: (root / "member_001" / POLICY).write_bytes(pickle.dumps(Bomb())),
        "member_001/policy.safetensors", "is a pickle",
    ),
    "pickle with the right sum": (
        in_member(lambda v: None, pickle.dumps(Bomb(), protocol=2)), "member_001/policy.safetensors", "is a pickle"
    ),
    "torch archive": (torch_archive, "member_001/policy.safetensors", "is a pickle"),
    "not safetensors": (
        in_member(lambda v: None, b"GIF89a" * 9), "member_001/policy.safetensors", "is not a safetensors file"
    ),
    "tensor missing": (
        in_weights(lambda t: t.pop("0.bias")), "member_001/policy.safetensors", "tensor '0.bias' is missing"
    ),
    "tensor unknown": (
        in_weights(lambda t: t.update(x=np.zeros(1))), "member_001/policy.safetensors", "tensor 'x'"
    ),
    "tensor of another shape": (
        in_weights(lambda t: t.update({"0.bias": np.zeros(3, np.float32)})),
        "member_001/policy.safetensors", "shape (3,)",
    ),
    "tensor of another type": (
        in_weights(lambda t: t.update({"0.bias": np.zeros(8)})), "member_001/policy.safetensors", "float64"
    ),
    "not a number": (
        in_weights(lambda t: t.update({"0.bias": np.full(8, np.nan, np.float32)})),
        "member_001/policy.safetensors", "not finite",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_one_line_names_the_file(good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "population"
    shutil.copytree(good, root)
    assert len(load_population(root)) == 2
    mutate, file, told = CASES[name]
    mutate(root)
    with pytest.raises(UserError) as caught:
        load_population(root)
    line = str(caught.value)
    assert "\n" not in line and told in line and caught.value.fix, line
    assert caught.value.field == str(root if file == "population" else root / file)
    assert not (tmp_path / "exploded").exists()


def test_the_bomb_would_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    pickle.loads(pickle.dumps(Bomb()))
    assert (tmp_path / "exploded").exists()


def test_a_header_whose_length_looks_like_a_pickle_is_read(tmp_path: Path) -> None:
    """The first bytes of a safetensors file are the header's length; 0x0280 is how a pickle of protocol 2 begins."""
    saved = (save({"x" * length: np.zeros(1, np.float32)}) for length in range(1, 0x280))
    data = next(data for data in saved if data[:2] == b"\x80\x02")
    (tmp_path / "odd.safetensors").write_bytes(data)
    assert len(read_tensors(tmp_path / "odd.safetensors", digest(data))) == 1


def test_unfinished_folders_and_strangers_are_not_looked_at(good: Path, tmp_path: Path) -> None:
    root = tmp_path / "population"
    shutil.copytree(good, root)
    (root / ".writing-member_003-x").mkdir()
    (root / "member_003").mkdir()
    save_file({"x": np.zeros(1)}, root / "member_003" / POLICY)
    assert len(load_population(root)) == 2
