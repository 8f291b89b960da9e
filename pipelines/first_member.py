"""Member 1: the world model and a self-play agent together (phase 1)."""

from __future__ import annotations

import time
from collections import Counter, deque
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import ray

from popgen.actors.sampler_actor import Collected, PolicySnapshot
from popgen.methods.xpm_wm.config import PREFILL_CHUNK
from popgen.methods.xpm_wm.start_states import Starts
from popgen.pipelines.rounds import Pace, run_rounds
from popgen.pipelines.snapshot import Published, Snapshot
from popgen.play.sampler import Match
from popgen.policies.simple_policies import RandomPolicy
from popgen.runs.checkpoints import fitting
from popgen.types import RANDOM_MEMBER, Kind

if TYPE_CHECKING:
    from popgen.pipelines.xpm_wm_driver import XpmWm

MEMBER = 1
LEARNERS = ("model", "agent")
PIECE = 100
"""World-model updates between two signs of progress."""
CONFIRMED = 0.97
"""Share of the target that the last policy must reach by itself."""


class FirstMember:
    """Random play, world-model updates alone, then rounds of sampling, model learning and agent learning.

    What the three kinds of work published last is kept here, as references.
    """

    def __init__(self, driver: XpmWm, seed: int) -> None:
        self.driver, self.config, self.phase, self.seed = driver, driver.config, driver.config.phase1, seed
        # An episode of each environment: fewer reach the target by luck, where some episodes end in a stand-still.
        window = max(16, self.phase.envs)
        self.recent: deque[float] = deque(maxlen=window)
        self.shaped: deque[float] = deque(maxlen=window)
        self.figures: dict[str, float] = {}
        self.rounds = self.since_best = 0
        self.top: Snapshot | None = None
        self.restarted = self.plays = self.confirmed = False
        self.confirmations = 0
        self.busy: Counter[str] = Counter()
        self.cpu: Counter[str] = Counter()
        self.report: Any = None

    def train(self, saved: dict[str, Any] | None) -> Snapshot:
        """Until the budget, the target or the patience ends; `saved` is a checkpoint to go on from."""
        crew = self.driver.crew
        ray.get(crew.agent.begin_member.remote(MEMBER, self.seed, {}))
        if saved is None:
            self._prefill()
            self._pretrain()
        else:
            self.driver.restore_learners(saved)
            with fitting(self.driver.checkpoints.folder):
                self._restore(saved["first_member"])
        self.driver.reporter.phase("member 1: self-play", self.phase.max_steps)
        self._sit_down()
        if saved is None:
            self._save()
        else:
            with fitting(self.driver.checkpoints.folder):
                crew.players.load_state(saved["samplers"])
        checkpoints, work = self.driver.checkpoints, self._work()
        self.pace, self.began = Pace(work, LEARNERS, self.config.run.overlap), time.perf_counter()
        while True:
            run_rounds(
                work,
                stop=self._stop,
                after=self._after,
                schedule=self.config.run.schedule,
                due=checkpoints.due,
                save=self._save,
                pace=self.pace,
            )
            if not self._reached() or self._confirm():
                return self._best()
            self._sit_down()

    # ---- before the rounds -----------------------------------------------------------------------------------------

    def _prefill(self) -> None:
        """K random episodes (algorithm 1)."""
        phase, driver = self.phase, self.driver
        driver.reporter.phase("member 1: random play", phase.prefill_steps)
        names, interact, probabilities = driver.spec.action_names, phase.prefill_interact, None
        if interact and "interact" in names:
            rest = (1.0 - interact) / (len(names) - 1)
            probabilities = [interact if name == "interact" else rest for name in names]
        random = RandomPolicy(driver.spec.num_actions, probabilities)
        parts = {RANDOM_MEMBER: PolicySnapshot(random.kind, random.config(), {})}
        match = Match(Kind.RANDOM, (RANDOM_MEMBER, RANDOM_MEMBER), phase.envs)
        driver.crew.players.open([match], parts, self.seed)
        while driver.steps < phase.prefill_steps:
            missing = (phase.prefill_steps - driver.steps) // phase.envs
            driver.play(MEMBER, max(1, min(PREFILL_CHUNK, missing)))
            driver.reporter.update(driver.steps, steps=driver.steps)

    def _pretrain(self) -> None:
        """World-model updates alone, in pieces for the progress bar; then the agent's first ones."""
        driver, total = self.driver, self.phase.pretrain_updates
        driver.reporter.phase("member 1: world model on random play", total)
        for done in range(0, total, PIECE):
            count = min(PIECE, total - done)
            self.model, self.starts, info = self._learn_model(count)
            metrics = ray.get(info)
            driver.log(MEMBER, **{f"model/{k}": v for k, v in metrics.items()})
            driver.reporter.update(done + count, model_loss=round(metrics["loss_observation"], 2))
        self.published, info = self._publish(self._learn_agent())
        ray.get(info)

    def _sit_down(self, stagger: bool = True) -> None:
        """Fresh episodes of the published policy."""
        parts = {MEMBER: self.driver.parts(ray.get(self.published.acting))}
        seed = self.seed + 10_000 * (2 * self.confirmations - (not stagger))
        self.driver.crew.players.open([Match(Kind.SP, (MEMBER, MEMBER), self.phase.envs)], parts, seed, stagger)

    # ---- the rounds ------------------------------------------------------------------------------------------------

    def _learn_model(self, updates: int) -> tuple[Any, ...]:
        """Imagination starts from chosen windows only once self-play has begun: before, the model does not know what
        follows a rare event, and nothing corrects it."""
        train, chosen = self.driver.crew.model.train, self.plays or self.phase.event_starts == "always"
        return train.options(num_returns=3).remote(updates, self.config.agent.starts_sp, chosen)

    def _learn_agent(self) -> tuple[Any, ...]:
        """References to acting weights, critics, model and metrics."""
        train = self.driver.crew.agent.train.options(num_returns=3)
        acting, critics, info = train.remote(self.phase.agent_updates, self.model, self.starts, 0.0, {}, self.plays)
        return acting, critics, self.model, info

    def _publish(self, result: tuple[Any, ...]) -> tuple[Published, Any]:
        acting, critics, model, info = result
        return Published(acting, model, critics), info

    def _work(self) -> dict[str, tuple[Any, Any]]:
        """The kinds of work, each sampler one of them; their order is that in which a round takes the results."""
        players = self.driver.crew.players
        samplers = {f"sampler{i}": (partial(self._sample, i), self._sampled) for i in players.active}
        return samplers | {
            "model": (lambda: self._learn_model(self.phase.model_updates), self._model_learned),
            "agent": (self._learn_agent, self._agent_learned),
        }

    def _sample(self, index: int) -> Any:
        self.played = self.published
        return self.driver.crew.players.start(index, self.phase.steps_per_iteration, MEMBER, self.published.acting)

    def _sampled(self, result: tuple[Any, Collected]) -> None:
        segments, collected = result
        self.cpu["sampler"] += collected.cpu_seconds
        self.driver.absorb(MEMBER, segments, collected)
        self.recent.extend(e.score for e in collected.episodes)
        self.shaped.extend(e.shaped for e in collected.episodes)

    def _model_learned(self, result: tuple[Any, Any, dict[str, float]]) -> None:
        self.model, self.starts, metrics = result
        self._worked("model", metrics)
        self.figures |= {f"model/{name}": value for name, value in metrics.items()}

    def _agent_learned(self, result: tuple[Any, ...]) -> None:
        self.published, metrics = self._publish(result)
        self._worked("agent", metrics)
        self.figures |= {f"agent/{name}": value for name, value in metrics.items()}

    def _worked(self, learner: str, metrics: dict[str, float]) -> None:
        self.busy[learner] += metrics["seconds"]
        self.cpu[learner] += metrics["cpu_seconds"]

    def _after(self) -> None:
        """Book-keeping at the end of a round."""
        driver = self.driver
        self.rounds += 1
        if self.recent:
            self.figures |= {
                "real_sp": float(np.mean(self.recent)),
                "real_shaped_sp": float(np.mean(self.shaped)) / driver.spec.horizon,
            }
        self._look_into_the_model()
        self.figures |= self.pace.figures() | self._idle()
        driver.log(MEMBER, **self.figures)
        self._keep_best()
        self._restart_if_due()
        score = round(self.figures.get("real_sp", 0.0), 2)
        driver.reporter.update(driver.steps, steps=driver.steps, **{driver.spec.score_name: score})

    def _look_into_the_model(self) -> None:
        """Now and then its report; with `async` it is taken in when it is there, and nothing waits for it."""
        if self.report is None and self.rounds % self.phase.check_every == 0:
            self.report = self.driver.crew.model.report.remote()
        wait = None if self.config.run.schedule == "sync" else 0.0
        if self.report is not None and ray.wait([self.report], timeout=wait)[0]:
            self.figures |= {f"report/{k}": v for k, v in ray.get(self.report).items()}
            self.report = None

    def _idle(self) -> dict[str, float]:
        """idle/LEARNER: the share of the time since these rounds began in which it was not at work."""
        passed = max(1e-9, time.perf_counter() - self.began)
        return {f"idle/{name}": max(0.0, 1.0 - self.busy[name] / passed) for name in LEARNERS}

    @property
    def _full(self) -> bool:
        """Enough episodes to judge by."""
        return len(self.recent) == self.recent.maxlen

    def _keep_best(self) -> None:
        """The policy that played, not the one learned meanwhile; rounds count once there is something to judge by."""
        if not self._full:
            return
        score = float(np.mean(self.recent))
        self.plays |= score >= self.config.agent.entropy_after * self.phase.target_score
        if self.top is None or score > self.top.sp:
            self.top = Snapshot(self.played, score, 0.0)
            self.since_best = 0
        else:
            self.since_best += 1

    def _restart_if_due(self) -> None:
        """Fresh actor and critics on the world model learned so far, once (an actor can get stuck, a model less)."""
        phase, driver = self.phase, self.driver
        if self.restarted or not phase.restart_updates or driver.steps < phase.restart_after:
            return
        self.restarted = True
        driver.reporter.note(f"member 1: actor and critics start again on the world model of {driver.steps:,} steps")
        ray.get(driver.crew.agent.restart.remote(self.seed + 500))
        for _ in range(0, phase.restart_updates, phase.agent_updates):
            self.published, info = self._publish(self._learn_agent())
            ray.get(info)

    def _reached(self) -> bool:
        """The target, over a full window of episodes."""
        return self._full and float(np.mean(self.recent)) >= self.phase.target_score

    def _stop(self) -> bool:
        """Budget spent, target reached, or no better for `patience` rounds."""
        spent = self.driver.steps >= self.phase.max_steps
        return spent or self._reached() or self.since_best >= self.phase.patience

    def _confirm(self) -> bool:
        """Whether the last policy is good by itself: a whole episode of it in each environment, counted as all others.

        What the window holds was played by several policies, of which the last can be the worse. Where the budget
        leaves no room for it, the window must do.
        """
        driver, horizon = self.driver, self.driver.spec.horizon
        if driver.steps + self.phase.envs * horizon > self.phase.max_steps:
            return True
        self.confirmations += 1
        self._sit_down(stagger=False)
        episodes = driver.play(MEMBER, horizon)
        self.recent.extend(e.score for e in episodes)
        self.shaped.extend(e.shaped for e in episodes)
        score = float(np.mean([e.score for e in episodes]))
        self.confirmed = score >= CONFIRMED * self.phase.target_score
        outcome = "taken" if self.confirmed else "learning goes on"
        told = f"{score:.2f} {driver.spec.score_name} in {len(episodes)} episodes of one policy: {outcome}"
        driver.reporter.note(f"member 1: {told}")
        return self.confirmed

    def _best(self) -> Snapshot:
        """The weights with the best window, unless the last ones are about as good (they learned longer)."""
        last = Snapshot(self.published, float(np.mean(self.recent)) if self.recent else 0.0, 0.0)
        return last if self.confirmed or self.top is None or last.sp >= 0.95 * self.top.sp else self.top

    # ---- checkpoints -----------------------------------------------------------------------------------------------

    def _save(self) -> None:
        model, starts = ray.get([self.model, self.starts])
        state = {
            "model": model,
            "starts": vars(starts),
            "published": self.published.weights(),
            "top": None if self.top is None else self.top.state(),
            "recent": list(self.recent),
            "shaped": list(self.shaped),
            "figures": dict(self.figures),
            "counters": [self.rounds, self.since_best, self.restarted, self.plays, self.confirmations],
        }
        self.driver.save(MEMBER, self.rounds, {"first_member": state, "samplers": self.driver.crew.players.state()})

    def _restore(self, state: dict[str, Any]) -> None:
        published, top = state["published"], state["top"]
        self.driver.check_published(published, published | {"model": state["model"]}, (top or state)["published"])
        self.model, self.starts = ray.put(state["model"]), ray.put(Starts(**state["starts"]))
        self.published, self.top = Published.of(published), Snapshot.of(top)
        self.recent.extend(map(float, state["recent"]))
        self.shaped.extend(map(float, state["shaped"]))
        self.figures = {str(name): float(value) for name, value in state["figures"].items()}
        self.rounds, self.since_best, restarted, plays, self.confirmations = map(int, state["counters"])
        self.restarted, self.plays = bool(restarted), bool(plays)
