"""Write a population member by member, and load one without executing anything it brings."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from popgen.envs import BatchedEnv, EnvSpec, make_env
from popgen.errors import UserError
from popgen.jsonable import jsonable
from popgen.play.episodes import Episodes
from popgen.play.policy import Policy
from popgen.play.rollout import play_teams
from popgen.policies.policy_registry import build_policy
from popgen.population import files
from popgen.population.manifest import (
    FORMAT,
    FORMAT_VERSION,
    EnvironmentInfo,
    Manifest,
    MemberEntry,
    MemberInfo,
    Versions,
    cooking_of,
    folder_name,
)

SIMPLE = ("random", "idle")
"""Players of every environment that are no members."""

MANIFEST, MEMBER, POLICY, TRAINING = "manifest.json", "member.json", "policy.safetensors", "training.safetensors"


class PopulationWriter:
    """Adds finished members to a population folder.

    A member appears all at once: its folder is written under a temporary name and renamed, then the manifest
    is replaced. Whatever interrupts this, the folder stays a loadable population.

    Args:
        path: the population's folder, made if missing.
        spec: the environment the members are trained in; the registry must rebuild it from name and params.
        method, config_digest, seed: of the run, see `Manifest`.
        resume: continue the population that is there, if any, instead of refusing.

    Raises:
        UserError: there is a population already and `resume` is False, the one there is of another run or
            environment, the folder holds something else, or it cannot be written.
    """

    def __init__(
        self, path: str | Path, spec: EnvSpec, *, method: str, config_digest: str, seed: int, resume: bool = False
    ) -> None:
        self.path, self._spec = Path(path), spec
        wanted = Manifest(
            environment=EnvironmentInfo.of(spec),
            method=method,
            config_digest=config_digest,
            seed=seed,
            versions=Versions.current(),
        )
        with files.told(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            present = (self.path / MANIFEST).exists()
        if present and not resume:
            raise UserError(str(self.path), "holds a population already", "choose another folder or resume its run")
        if present:
            self.manifest = _read_manifest(self.path)
            self._check_same_run(wanted)
        with files.told(self.path):
            files.remove_unfinished(self.path)
            if not present:
                if any(self.path.iterdir()):
                    raise UserError(str(self.path), "is not empty and holds no population", "choose another folder")
                self.manifest = wanted
                files.replace_file(self.path / MANIFEST, files.to_json(wanted))

    def __len__(self) -> int:
        return len(self.manifest.members)

    def add_member(
        self,
        policy: Policy,
        *,
        seed: int,
        steps: Mapping[str, int],
        training: Mapping[str, np.ndarray] | None = None,
        extra: Mapping[str, Any] | None = None,
    ) -> MemberInfo:
        """Save the next member and list it in the manifest.

        Args:
            policy: of a registered kind; `weights()` must be finite and rebuild it.
            seed: the member's own.
            steps: environment steps by ledger kind.
            training: named arrays that are not needed to act (critics, decoder).
            extra: JSON-able figures; numbers that are not finite become null.

        Raises:
            UserError: weights not finite, the member exists, another writer is at work, or the disk is full.
            ValueError: the policy's parts do not rebuild it.
        """
        member = len(self.manifest.members) + 1
        folder = self.path / folder_name(member)
        contents = {POLICY: files.to_tensors(folder / POLICY, policy.weights())}
        if training is not None:
            contents[TRAINING] = files.to_tensors(folder / TRAINING, training)
        info = MemberInfo(
            id=member,
            kind=policy.kind,
            config=json.loads(json.dumps(policy.config(), allow_nan=False)),
            seed=int(seed),
            steps={str(kind): int(count) for kind, count in steps.items()},
            policy_sha256=files.digest(contents[POLICY]),
            training_sha256=files.digest(contents[TRAINING]) if training is not None else None,
            versions=Versions.current(),
            extra=jsonable(dict(extra or {})),
        )
        build_policy(info.kind, info.config, policy.weights(), self._spec)
        contents[MEMBER] = files.to_json(info)
        self._publish(folder, contents, member)
        return info

    def _publish(self, folder: Path, contents: Mapping[str, bytes], member: int) -> None:
        if _read_manifest(self.path) != self.manifest:
            raise UserError(str(self.path / MANIFEST), "was changed by another run", "choose another folder")
        entry = MemberEntry(id=member, folder=folder.name, sha256=files.digest(contents[MEMBER]))
        manifest = self.manifest.model_copy(update={"members": (*self.manifest.members, entry)})
        with files.told(folder):
            if folder.exists():
                _remove_unlisted(folder)
            files.publish_folder(folder, contents)
            files.replace_file(self.path / MANIFEST, files.to_json(manifest))
        self.manifest = manifest

    def _check_same_run(self, wanted: Manifest) -> None:
        for name in ("environment", "method", "config_digest", "seed"):
            have, want = getattr(self.manifest, name), getattr(wanted, name)
            if name == "environment":  # its name may be that of a file, which is elsewhere now
                same, shown = have.fingerprint == want.fingerprint, ""
            else:
                same, shown = have == want, f" ({have!r} there, {want!r} here)"
            if not same:
                raise UserError(
                    str(self.path / MANIFEST), f"is of a run with another {name}{shown}", "choose another folder"
                )


def _remove_unlisted(folder: Path) -> None:
    """Remove a member folder that an interruption left before the manifest listed it, and nothing else."""
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else {""}
    if not names <= {POLICY, TRAINING, MEMBER}:
        raise UserError(str(folder), "is in the way and no unfinished member", "move it away")
    shutil.rmtree(folder)


class Population:
    """A loaded, fully checked population.

    `population[m]` (m from 1) is a fresh policy each time, ready for `reset` and `act` in any environment with
    the same views; iterating gives members 1..M.

    Attributes:
        path: where it was loaded from.
        manifest: its manifest; `env_info` is the environment's part.
        members: what is known of each member, in order.
        spec: of the rebuilt environment.
    """

    def __init__(self, path: Path, manifest: Manifest, members: tuple[MemberInfo, ...], spec: EnvSpec) -> None:
        self.path, self.manifest, self.members, self.spec = path, manifest, members, spec

    def __repr__(self) -> str:
        members = f"{len(self)} member{'' if len(self) == 1 else 's'}"
        about = f"by {self.manifest.method} in {self.env_info.name}, seed {self.manifest.seed}"
        return f"<Population of {members} {about}: {str(self.path)!r}>"

    @property
    def env_info(self) -> EnvironmentInfo:
        """The environment as the manifest names it."""
        return self.manifest.environment

    def __len__(self) -> int:
        return len(self.members)

    def __iter__(self) -> Iterator[Policy]:
        return (self[member] for member in range(1, len(self) + 1))

    def __getitem__(self, member: int) -> Policy:
        info = self.info(member)
        path = self.path / folder_name(member) / POLICY
        weights = files.read_tensors(path, info.policy_sha256)
        try:
            return build_policy(info.kind, info.config, weights, self.spec)
        except ValueError as error:
            fix = "restore the population from a good copy or use the popgen version that wrote it"
            raise UserError(str(path), str(error), f"{fix} ({info.versions.popgen})") from error

    def info(self, member: int) -> MemberInfo:
        """What is known of a member.

        Raises:
            IndexError: no such member; they count from 1.
        """
        if isinstance(member, bool) or not isinstance(member, int | np.integer):
            raise TypeError(f"member must be an integer, got {member!r}")
        if not 1 <= member <= len(self):
            have = f"members 1 to {len(self)}" if len(self) else "no members"
            raise IndexError(f"no member {member}: {self.path} has {have}")
        return self.members[int(member) - 1]

    def training(self, member: int) -> dict[str, np.ndarray] | None:
        """The member's training tensors (critics, decoder), None where none were saved."""
        info = self.info(member)
        if info.training_sha256 is None:
            return None
        return files.read_tensors(self.path / folder_name(member) / TRAINING, info.training_sha256)

    def make_env(self, num_envs: int = 1, seed: int = 0) -> BatchedEnv:
        """The environment the members were trained in."""
        return make_env(self.env_info.name, num_envs, seed=seed, **self.env_info.params)

    def play(self, *players: int | str, episodes: int = 20, seed: int = 0) -> Episodes:
        """Full episodes in the members' environment.

        Args:
            players: who sits in each seat: members, `"random"` or `"idle"`; one member alone plays with itself.
            episodes: how many, in one batch.
            seed: same arguments, same episodes.

        Returns:
            Scores, rewards and events, an episode each row (`popgen.play.episodes.Episodes`).

        Raises:
            IndexError: no such member.
            ValueError: players for another number of seats, an unknown player, or less than one episode.
        """
        seats = self.spec.num_players
        seated = players * seats if len(players) == 1 else players
        if len(seated) != seats:
            raise ValueError(f"players: {len(players)} given for {seats} seats")
        different = list(dict.fromkeys(seated))
        policies = [self._find_player(player) for player in different]
        match = tuple(different.index(player) for player in seated)
        return play_teams(lambda count, _: self.make_env(count), policies, [match], episodes, seed=seed)

    def _find_player(self, player: int | str) -> Policy:
        if isinstance(player, str):
            if player not in SIMPLE:
                raise ValueError(f"player must be a member, {' or '.join(map(repr, SIMPLE))}, got {player!r}")
            return build_policy(player, {}, {}, self.spec)
        return self[player]


def load_population(path: str | Path) -> Population:
    """Load and check a population; nothing in it is executed or unpickled.

    Args:
        path: the population's folder, or that of the run which made it.

    Raises:
        UserError: not a population, written by another format version, or any file missing, damaged or ill-fitting.
    """
    path = Path(path).expanduser()
    if not (path / MANIFEST).exists() and (path / "population" / MANIFEST).exists():
        path = path / "population"
    if not (path / MANIFEST).exists():
        raise UserError(str(path), f"is not a population: it has no {MANIFEST}", "give the folder that holds it")
    manifest = _read_manifest(path)
    members = tuple(_read_member(path, entry) for entry in manifest.members)
    population = Population(path, manifest, members, _rebuilt_spec(path, manifest.environment))
    for member in range(1, len(members) + 1):
        population[member]  # builds every member once, so that a bad one shows before anything starts
        population.training(member)
    return population


def _read_manifest(path: Path) -> Manifest:
    file = path / MANIFEST
    value = files.parse_json(file, files.read_bytes(file))
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise UserError(str(file), "is not the manifest of a population", "give a folder that `popgen run` wrote")
    if value.get("format_version") != FORMAT_VERSION or isinstance(value["format_version"], bool):
        problem = f"has format version {value.get('format_version')!r}, this popgen reads {FORMAT_VERSION}"
        raise UserError(str(file), problem, "install the popgen version that wrote it")
    return files.as_record(file, value, Manifest)


def _read_member(path: Path, entry: MemberEntry) -> MemberInfo:
    file = path / entry.folder / MEMBER
    data = files.read_bytes(file)
    if files.digest(data) != entry.sha256:
        problem = f"is damaged or was edited: its sha256 differs from the one in {MANIFEST}"
        raise UserError(str(file), problem, "restore the population from a good copy")
    info = files.as_record(file, files.parse_json(file, data), MemberInfo)
    if info.id != entry.id:
        raise UserError(str(file), f"is of member {info.id}, not {entry.id}", "restore the population from a good copy")
    return info


def _rebuilt_spec(path: Path, info: EnvironmentInfo) -> EnvSpec:
    file = path / MANIFEST
    try:
        spec = make_env(info.name, 1, **info.params).spec
    except (ValueError, TypeError) as error:
        raise UserError(str(file), f"its environment cannot be made: {error}", "restore it from a good copy") from error
    if spec.fingerprint != info.fingerprint:
        problem = (
            f"environment {info.name} has rules {spec.fingerprint[:12]} in this popgen, "
            f"the population was trained with {info.fingerprint[:12]}"
        )
        raise UserError(str(file), problem, "install the popgen version that wrote it")
    return spec


def check_compatible(population: Population, spec: EnvSpec) -> None:
    """Make sure that an environment is the one the population was trained in.

    Raises:
        UserError: its cooking mode or its rules (layout and parameters) differ; both values are named.
    """
    info = population.env_info
    fix = "choose the population's environment or another population"
    if cooking_of(spec) != info.cooking:
        problem = f"is {cooking_of(spec)}, the population was trained with {info.cooking}"
        raise UserError("env.params.cooking", problem, fix)
    if spec.fingerprint != info.fingerprint:
        if different := _name_differences(spec, info):
            raise UserError(*different[0], fix)
        here = f"{spec.name} ({spec.fingerprint[:12]})"
        there = f"{info.name} ({info.fingerprint[:12]})"
        raise UserError("env.name", f"is {here}, the population was trained in {there}", fix)


def _name_differences(spec: EnvSpec, info: EnvironmentInfo) -> list[tuple[str, str]]:
    """Field and problem of the parameters that tell two environments of one name apart."""
    ours, theirs = jsonable(spec.params), info.params
    if spec.name != info.name:
        return []
    return [
        (f"env.params.{name}", f"is {ours.get(name)!r}, the population was trained with {theirs.get(name)!r}")
        for name in sorted(ours.keys() | theirs.keys())
        if ours.get(name) != theirs.get(name)
    ]
