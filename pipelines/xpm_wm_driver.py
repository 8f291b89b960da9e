"""XPM-WM, member after member (paper, algorithm 1 and section 4.2): phases 1 and 2, checkpoints, resuming."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import ray

from popgen.actors.sampler_actor import Collected, PolicySnapshot
from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec
from popgen.methods.xpm_wm.acting import WorldModelPolicy
from popgen.nets.weights import Weights
from popgen.pipelines.crew import Crew
from popgen.pipelines.first_member import FirstMember
from popgen.pipelines.later_member import LaterMember
from popgen.pipelines.snapshot import Snapshot
from popgen.play.sampler import Episode
from popgen.population import load_population
from popgen.progress import Reporter
from popgen.runs.checkpoints import Checkpoints, finished_member, fitting, member_folder, same_form
from popgen.runs.recorder import RunRecorder
from popgen.runs.state_files import save_state
from popgen.types import Kind

SP_KINDS = (str(Kind.SP), str(Kind.RANDOM))
XP_KINDS = (str(Kind.XP),)
LEARNERS = ("model", "agent")
REPLAYS = ("replay_sp", "replay_xp")
HALT_SECONDS = 30.0
"""Least time between two checkpoints with schedule=async, where all work halts for one."""


class XpmWm:
    """Walks through the members; holds what they hand on to each other, and does what all of them need."""

    def __init__(self, config: RunConfig, spec: EnvSpec, recorder: RunRecorder, reporter: Reporter) -> None:
        self.config, self.spec, self.recorder, self.reporter = config, spec, recorder, reporter
        self.crew = Crew.hire(config, f"{recorder.run_id}.{recorder.attempt}")
        long = max(1, config.replay.capacity // 2)
        seconds = max(config.run.checkpoint_seconds, HALT_SECONDS if config.run.schedule == "async" else 0.0)
        self.checkpoints = Checkpoints(recorder.dir, long=long, seconds=seconds)
        self.members: dict[int, Weights] = {}
        self.steps = 0

    # ---- the walk ------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Train every member that is not there yet."""
        try:
            known, base, saved = self._resume()
            for member in range(known + 1, self.config.population.size + 1):
                began, self.steps = time.time(), 0
                seed = self.config.run.seed * 1000 + member
                if saved is None:
                    self.checkpoints.begin(base)
                trainer = FirstMember(self, seed) if member == 1 else LaterMember(self, member, seed)
                self._complete(member, seed, trainer.train(saved), time.time() - began)
                base, saved = member_folder(self.recorder.dir, member), None
        finally:
            self.crew.dismiss()

    def _complete(self, member: int, seed: int, snapshot: Snapshot, seconds: float) -> None:
        """Add the member to the population, keep the buffers and the model, enter it in the recorder."""
        weights = snapshot.published.weights()
        training = {f"model.{k}": v for k, v in weights["model"].items() if not k.startswith("filter.")}
        training |= {f"critics.{k}": v for k, v in weights["critics"].items()}
        report = ray.get(self.crew.model.report.remote())
        extra = {"sp": snapshot.sp, "xp": snapshot.xp, "seconds": round(seconds, 1), "world_model": report}
        self.log(member, final_sp=snapshot.sp, final_xp=snapshot.xp, **report)
        state = self._replays() | {"model": ray.get(self.crew.model.state.remote())}
        save_state(member_folder(self.recorder.dir, member), state | {"ledger": len(self.recorder.ledger)})
        policy = WorldModelPolicy(self.config.world_model, self.config.agent, self.spec)
        policy.load(weights["acting"])
        self.recorder.add_member(policy, training, seed=seed, extra=extra)
        self.members[member] = weights["acting"]
        steps = sum(self.recorder.training_steps(member).values())
        self.reporter.note(
            f"member {member}: SP {snapshot.sp:.2f}, XP {snapshot.xp:.2f} {self.spec.score_name} in training, "
            f"{steps:,} environment steps, {seconds / 60:.1f} min"
        )

    # ---- what members are trained with ---------------------------------------------------------------------------

    def parts(self, weights: Weights) -> PolicySnapshot:
        """A member's policy as it travels to a sampler."""
        config = self.config
        sizes = {
            "world_model": config.world_model.model_dump(mode="json"),
            "agent": config.agent.model_dump(mode="json"),
        }
        return PolicySnapshot("world_model", sizes, weights)

    def play(self, member: int, steps: int) -> list[Episode]:
        """Let all samplers play for `member`'s training, take in what they give; the episodes that ended."""
        episodes: list[Episode] = []
        for segments, collected in self.crew.players.collect(steps):
            self.absorb(member, segments, collected)
            episodes += collected.episodes
        return episodes

    def absorb(self, member: int, segments: Any, collected: Collected) -> None:
        """Segments (a reference) to the buffers and the checkpoint's log, counts to the ledger."""
        added = self._store(segments, member)
        self.checkpoints.keep(ray.get(segments), member)
        ray.get(added)
        self.recorder.record_sampling(member, collected)
        self.steps += sum(steps for *_, steps in collected.counts)

    def _store(self, segments: Any, owner: int) -> list[Any]:
        kinds = ((self.crew.replay_sp, SP_KINDS), (self.crew.replay_xp, XP_KINDS))
        return [replay.add.remote(segments, owner, kept) for replay, kept in kinds]

    def log(self, member: int, **figures: float) -> None:
        """A point of metrics at the member's present step.

        Raises:
            FloatingPointError: a learner's figure is not finite: it will not recover.
        """
        self.recorder.record_metrics(member, self.steps, **figures)
        for name, value in figures.items():
            if name.partition("/")[0] in LEARNERS and not math.isfinite(value):
                raise FloatingPointError(f"{name} of member {member} is {value} after {self.steps:,} steps")

    # ---- resume --------------------------------------------------------------------------------------------------

    def save(self, member: int, iteration: int, state: dict[str, Any]) -> None:
        """The checkpoint after `iteration` iterations: the members' part, and what is common to them."""
        crew = self.crew
        common = {name: getattr(crew, name).state.remote() for name in LEARNERS}
        marks = {name: getattr(crew, name).marks.remote() for name in REPLAYS}
        state = state | dict(zip(common, ray.get([*common.values()]), strict=True))
        state["marks"] = dict(zip(marks, ray.get([*marks.values()]), strict=True))
        self.checkpoints.save(
            member, {**state, "steps": self.steps, "ledger": len(self.recorder.ledger)}, self._replays
        )
        self.recorder.record_checkpoint(member, iteration)

    def restore_learners(self, saved: dict[str, Any]) -> None:
        """Buffers, world model and agent as `save` found them; the member must have begun.

        Raises:
            UserError: a damaged part, or one that does not fit.
        """
        with fitting(self.checkpoints.folder):
            self._restore(saved)
            self.steps = int(saved["steps"])
        self.reporter.note(f"going on after {self.steps:,} steps of member {saved['member']}")

    def _restore(self, saved: dict[str, Any]) -> None:
        crew = self.crew
        whole = self.checkpoints.replays()
        for name in REPLAYS if whole else ():
            ray.get(getattr(crew, name).load_state.remote(whole[name]))
        for segments, owner in self.checkpoints.log():
            stored = ray.put(segments)
            added = (
                crew.replay_sp.add.remote(stored, owner, SP_KINDS),
                crew.replay_xp.add.remote(stored, owner, XP_KINDS),
            )
            ray.get(list(added))
        ray.get([getattr(crew, name).load_marks.remote(saved["marks"][name]) for name in REPLAYS])
        ray.get([getattr(crew, name).load_state.remote(saved[name]) for name in LEARNERS])

    def check_published(self, *published: dict[str, Weights]) -> None:
        """Weights that a checkpoint brings back beside the learners' states must be of the restored learners' form.

        Raises:
            ValueError: they are not.
        """
        model, agent = ray.get([self.crew.model.weights.remote(), self.crew.agent.state.remote()])
        acting = ray.get(self.crew.agent.acting_weights.remote(model))
        for weights in published:
            same_form(weights, {"acting": acting, "model": model, "critics": agent["critics"]}, "the published policy")

    def _replays(self) -> dict[str, Any]:
        states = ray.get([getattr(self.crew, name).state.remote() for name in REPLAYS])
        return dict(zip(REPLAYS, states, strict=True))

    def _resume(self) -> tuple[int, Path | None, dict[str, Any] | None]:
        """Take over finished members of this run, or of the run this one continues.

        Returns:
            How many; the checkpoint of the last one; the running member's last checkpoint, if there is one.
        """
        present, origin = len(self.recorder.population), self.config.population
        if origin.init_from and present <= origin.init_members:
            root, known = Path(origin.init_from), origin.init_members
        else:
            root, known = self.recorder.dir, present
        saved = self.checkpoints.load(known + 1)
        if self.checkpoints.note:
            self.reporter.note(self.checkpoints.note)
        if not known:
            self.recorder.rewind_ledger(saved["ledger"] if saved else 0, self.reporter.note)
            return 0, None, saved
        folder = member_folder(root, known)
        state = finished_member(root, known)
        own = state if root == self.recorder.dir else {}
        self.recorder.rewind_ledger((saved or own).get("ledger", 0), self.reporter.note)
        if saved is None:
            with fitting(folder):
                ray.get([getattr(self.crew, name).load_state.remote(state[name]) for name in (*REPLAYS, "model")])
        self._take_over(root, known, present)
        return known, folder, saved

    def _take_over(self, root: Path, known: int, present: int) -> None:
        source = load_population(root / "population")
        for member in range(1, known + 1):
            self.members[member] = source[member].weights()
            if member > present:
                self.recorder.adopt_member(source[member], source.info(member), source.training(member))
        self.reporter.note(f"going on after member {known} of {root}")
