"""RLlib's PPO with a training step for self-play, cross-play and mixed play on batched simulators."""

from __future__ import annotations

import logging
import time
from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import ray
from ray.exceptions import RayActorError
from ray.rllib.algorithms.ppo import PPO, PPOConfig

from popgen.config.sections import ClusterConfig
from popgen.envs.contract import EnvSpec
from popgen.methods.mappo.batched_runner import BatchedRunner, Failure
from popgen.methods.mappo.partner_episodes import PartnerEpisodes
from popgen.methods.mappo.pooled_learner import PooledLearner
from popgen.methods.mappo.pooling import Plan
from popgen.methods.mappo.rl_module import module_id, module_spec, spaces
from popgen.methods.mappo.slots import Rollout
from popgen.methods.mappo.training_job import Group, Job
from popgen.types import Kind

ATTEMPTS = 5
"""Requests to the runners that may fail one after the other before the run does."""


class RunnerError(RuntimeError):
    """A runner could not do what it was asked for."""


@dataclass(frozen=True)
class Counted:
    """Environment steps of one owner and kind in one call of one runner."""

    runner: int
    owner: int
    kind: Kind
    steps: int
    episodes: int
    score: float


@dataclass(frozen=True)
class Report:
    """What one iteration did.

    Attributes:
        counted: every environment step that came back, once.
        figures: member -> figures for the logs.
        seconds: sampling, learning, and of the latter pooling and gradients.
        lost: runners that did not answer, whose share is missing.
    """

    counted: list[Counted] = field(default_factory=list)
    figures: dict[int, dict[str, float]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    lost: list[int] = field(default_factory=list)


class MappoConfig(PPOConfig):
    """PPOConfig with a `Job`; `of` makes one that is complete."""

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class or Mappo)
        self.job: Job | None = None
        self.env_spec: EnvSpec | None = None
        self.runner_threads = 1

    @classmethod
    def of(cls, job: Job, spec: EnvSpec, cluster: ClusterConfig) -> Self:
        """The whole configuration of one training; with `cluster.agent_gpus` the learner is on this process's card."""
        # It warns of defaults that are meant here, and of runners' deaths, which the report tells.
        logging.getLogger("ray.rllib").setLevel(logging.CRITICAL)
        config, ppo = cls(), job.ppo
        config.job, config.env_spec, config.runner_threads = job, spec, cluster.threads
        observation, action = spaces(job, spec)
        names = [module_id(member) for member in job.learning]
        config.environment(observation_space=observation, action_space=action, disable_env_checking=True)
        config.env_runners(
            env_runner_cls=BatchedRunner,
            num_env_runners=ppo.runners,
            num_cpus_per_env_runner=cluster.sampler_cpus,
            custom_resources_per_env_runner=dict(cluster.resources),
            validate_env_runners_after_construction=False,
            merge_env_runner_states=False,
            broadcast_env_runner_states=False,
        )
        config.fault_tolerance(restart_failed_env_runners=True, env_runner_health_probe_timeout_s=60.0)
        config.learners(learner_class=PooledLearner, num_learners=0, num_gpus_per_learner=cluster.agent_gpus)
        config.training(
            lr=ppo.learning_rate,
            gamma=ppo.discount,
            lambda_=ppo.lam,
            clip_param=ppo.clip,
            entropy_coeff=0.0,
            use_kl_loss=False,
            grad_clip=ppo.grad_clip or None,
            grad_clip_by="global_norm",
            num_epochs=ppo.epochs,
            train_batch_size_per_learner=ppo.envs * ppo.steps,
            minibatch_size=max(1, ppo.envs * ppo.steps // ppo.minibatches),
        )
        config.multi_agent(policies=set(names), policy_mapping_fn=_no_mapping)
        config.rl_module(rl_module_spec=module_spec(job, spec, inference_only=False))
        config.reporting(min_time_s_per_iteration=None, log_gradients=False)
        config.debugging(seed=job.seed, log_level="ERROR")
        config._dont_auto_sync_env_runner_states = True
        return config


def _no_mapping(agent: Any, *arguments: Any, **kwargs: Any) -> str:
    """RLlib wants a mapping and must not use it: the runner knows who sits where."""
    raise RuntimeError(f"agent {agent!r} was to be mapped to a module, which only RLlib's own runners do")


class Mappo(PPO):
    """One iteration: choose each member's partner, sample, learn. The driver reads `report` after `train()`."""

    @classmethod
    def get_default_config(cls) -> MappoConfig:
        """RLlib's hook."""
        return MappoConfig()

    def setup(self, config: MappoConfig) -> None:
        """Runners, learner, and what the training step remembers."""
        super().setup(config)
        self.job: Job = self.config.job
        self.groups = self.job.groups()
        diversity, ppo = self.job.diversity, self.job.ppo
        # All fresh episodes count, or those of one seating alone would be left of many.
        window = None if self.job.fresh or diversity is None else diversity.window
        self.partners = {m: PartnerEpisodes(self.job.partners(m), window) for m in self.job.learning}
        self.strongest: dict[int, int] = {}
        self.own: dict[int, deque[float]] = {m: deque(maxlen=ppo.window) for m in self.job.learning}
        self.rng = np.random.default_rng(self.job.seed)
        self.taken = dict.fromkeys(self.job.learning, 0)  # self-play steps
        self.lost: set[int] = set()
        self.rounds, self.report = 0, Report()

    def _setup_logdir(self) -> None:
        """Nothing: RLlib would make an empty folder in the user's home for every training."""

    # ---- one iteration -------------------------------------------------------------------------------------------

    def training_step(self) -> None:
        """Partners, rollouts, update; see `report`."""
        began, ppo = time.perf_counter(), self.job.ppo
        self.lost.clear()
        counted: list[Counted] = []
        weights = self._learner(lambda learner: learner.actors())
        if self._selects():
            self._select(weights, counted)
        plans = {member: self._plan(member) for member in self.job.learning}
        active = [index for index, group in enumerate(self.groups) if self._plays(group, plans)]
        rollouts = self._request("sample", counted, weights=weights, active=active, steps=ppo.steps)
        sampled = time.perf_counter()
        self.learner_group.update(episodes=rollouts, timesteps={}, plans=plans, progress=self.progress)
        learned = time.perf_counter()
        figures = self._learner(lambda learner: learner.figures())
        self.rounds += 1
        for member in self.job.learning:
            figures[member] = figures.get(member, {}) | self.scores(member)
        seconds = {"sampling": sampled - began, "learning": learned - sampled}
        seconds |= self._learner(lambda learner: learner.seconds)
        self.report = Report(counted, figures, seconds, sorted(self.lost))

    @property
    def progress(self) -> float:
        """Share of the budget that every member's self-play has used up."""
        return min(self.taken.values()) / self.job.ppo.max_steps

    @property
    def finished(self) -> bool:
        """The budget is used up, or every member's targets are reached."""
        return self.progress >= 1.0 or all(self._reached(member) for member in self.job.learning)

    def scores(self, member: int) -> dict[str, float]:
        """Mean scores of the latest episodes: `sp`, and `xp` of the partner with the highest."""
        found = {"sp": float(np.mean(self.own[member]))} if self.own[member] else {}
        cross = self.partners[member].mean_scores()
        return found | ({"xp": max(cross.values())} if cross else {})

    def _reached(self, member: int) -> bool:
        ppo, diversity, scores = self.job.ppo, self.job.diversity, self.scores(member)
        if len(self.own[member]) < ppo.window or scores["sp"] < ppo.target_score:
            return False
        partners = self.job.partners(member)
        if not partners or diversity is None:
            return True
        known = self.partners[member].mean_scores()
        return len(known) == len(partners) and max(known.values()) <= diversity.target_xp

    def _plan(self, member: int) -> Plan:
        diversity, partners = self.job.diversity, self.job.partners(member)
        if diversity is None or not partners:
            return Plan()
        partner = self.partners[member].choose(diversity.partner_random, self.rng)
        ramp = min(1.0, (self.rounds + 1) / max(1, diversity.warmup))
        return Plan(partner, diversity.lambda_xp * ramp, diversity.lambda_mp if self.job.mixed else 0.0)

    def _plays(self, group: Group, plans: Mapping[int, Plan]) -> bool:
        """LIPO samples cross-play with every partner; CoMeDi with the chosen one, for both kinds."""
        if group.kind is Kind.SP or (group.kind is Kind.XP and not self.job.fresh):
            return True
        return plans[group.owner].partner == group.partner_of(group.owner)

    def _selects(self) -> bool:
        diversity = self.job.diversity
        return self.job.fresh and bool(self.job.frozen) and self.rounds % diversity.select_every == 0

    def _select(self, weights: Any, counted: list[Counted]) -> None:
        """Fresh whole episodes with every partner, in both seatings, decide who is the strongest."""
        diversity = self.job.diversity
        for member in self.job.learning:
            groups = [
                Group(Kind.XP, pair, diversity.select_episodes, member)
                for k in self.job.partners(member)
                for pair in ((member, k), (k, member))
            ]
            for partner in self.job.partners(member):
                self.partners[member].forget(partner)
            seed = int(self.rng.integers(2**31))
            self._request("episodes", counted, weights=weights, groups=groups, seed=seed)

    # ---- runners -------------------------------------------------------------------------------------------------

    def _request(self, what: str, counted: list[Counted], **request: Any) -> list[Rollout]:
        """Ask every runner, and count what comes back. A lost runner's share is missing until it has been restarted."""
        found: list[tuple[int, Any]] = []
        for _ in range(ATTEMPTS):
            found = self._ask(what, request)
            if found:
                break
            self.restore_env_runners(self.env_runner_group)
        if not found:
            raise RayActorError(error_msg=f"no runner answered {ATTEMPTS} times")
        rollouts = [(runner, answer) for runner, answer in found if answer is not None]
        for runner, rollout in rollouts:
            counted += self._count(runner, rollout, listen=what == "episodes" or not self.job.fresh)
        return [rollout for _, rollout in rollouts]

    def _ask(self, what: str, request: Mapping[str, Any], only: list[int] | None = None) -> list[tuple[int, Any]]:
        """Answers of the runners (`only` some of them), in their order; those that did not answer are `lost`.

        Raises:
            RunnerError: one of them could not do it.
        """
        group = self.env_runner_group
        if group.num_remote_env_runners():
            if "weights" in request:  # one copy for all runners
                request = {**request, "weights": ray.put(request["weights"])}
            answers = group._worker_manager.foreach_actor(what, kwargs=request, remote_actor_ids=only)
            found = {answer.actor_id: answer.get() for answer in answers if answer.ok}
            self.lost |= set(group._worker_manager.actor_ids() if only is None else only) - found.keys()
        else:
            found = {0: getattr(group.local_env_runner, what)(**request)}
        for runner, answer in found.items():
            if isinstance(answer, Failure):
                raise RunnerError(f"runner {runner} failed:\n{answer.text}")
        return sorted(found.items())

    def restore_env_runners(self, env_runner_group: Any) -> list[int]:
        """Find runners that Ray has restarted; their weights come with the next request."""
        return env_runner_group.probe_unhealthy_env_runners()

    def _count(self, runner: int, rollout: Rollout, *, listen: bool) -> list[Counted]:
        """Steps and episodes by owner and kind; scores to the windows, cross-play's where `listen`."""
        steps: dict[tuple[int, Kind], list[float]] = defaultdict(lambda: [0, 0, 0.0])
        for group in rollout.groups:
            played = len(rollout.reward) * group.envs
            steps[group.owner, group.kind][0] += played
            if group.kind is Kind.SP:
                self.taken[group.owner] += played
        for episode in rollout.episodes:
            group = rollout.groups[episode.group]
            total = steps[group.owner, group.kind]
            total[1] += 1
            total[2] += episode.score
            if group.kind is Kind.SP:
                self.own[group.owner].append(episode.score)
            elif group.kind is Kind.XP and listen:
                for member in set(group.members) & set(self.job.learning):
                    self.partners[member].add(group.partner_of(member), episode.reward, episode.score)
        return [
            Counted(runner, owner, kind, int(count), int(episodes), score)
            for (owner, kind), (count, episodes, score) in steps.items()
        ]

    def _learner(self, function: Any) -> Any:
        return self.learner_group.foreach_learner(function).result_or_errors[0].get()

    # ---- what the driver asks for --------------------------------------------------------------------------------

    def actors(self) -> Any:
        """Member -> weights of its actor."""
        return self._learner(lambda learner: learner.actors())

    def critics(self, member: int) -> Any:
        """Weights of a member's critics."""
        return self._learner(lambda learner: learner.critics(member))

    def snapshot(self) -> dict[str, Any]:
        """Everything to go on from exactly here: learner, runners, partners, generators, counters."""
        runners = dict(self._ask("snapshot", {}))
        return {
            "learner": self._learner(lambda learner: learner.snapshot()),
            "runners": {str(index): state for index, state in runners.items()},
            "partners": {str(m): known.state() for m, known in self.partners.items()},
            "own": {str(m): list(scores) for m, scores in self.own.items()},
            "taken": {str(m): steps for m, steps in self.taken.items()},
            "rng": self.rng.bit_generator.state,
            "rounds": self.rounds,
        }

    def resume(self, state: Mapping[str, Any]) -> None:
        """Go on from `snapshot()` of an algorithm of the same job.

        Raises:
            KeyError, ValueError: it is of another job.
        """
        self._learner(lambda learner: learner.restore(state["learner"]))
        for index, saved in state["runners"].items():
            try:
                self._ask("restore", {"state": saved}, only=[int(index)])
            except RunnerError as error:
                raise ValueError(str(error).strip().rpartition("\n")[2]) from None
        for member in self.job.learning:
            self.partners[member].load_state(state["partners"][str(member)])
            self.own[member].extend(state["own"][str(member)])
            self.taken[member] = int(state["taken"][str(member)])
        self.rng.bit_generator.state = state["rng"]
        self.rounds = int(state["rounds"])
