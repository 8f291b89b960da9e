"""RLlib's PPO with a training step for self-play, cross-play and mixed play on batched simulators."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self, cast

import ray
from ray.exceptions import RayActorError
from ray.rllib.algorithms.ppo import PPO, PPOConfig

from popgen.config.sections import ClusterConfig
from popgen.envs.contract import EnvSpec
from popgen.methods.mappo.batched_runner import BatchedRunner, Failure
from popgen.methods.mappo.play_record import Counted, PlayRecord
from popgen.methods.mappo.pooled_learner import PooledLearner
from popgen.methods.mappo.rl_module import module_id, module_spec, spaces
from popgen.methods.mappo.slots import Rollout
from popgen.methods.mappo.training_job import Job

ATTEMPTS = 5
"""Requests to the runners that may fail one after the other before the run does."""


class RunnerError(RuntimeError):
    """A runner could not do what it was asked for."""


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
            num_cpus_per_env_runner=cluster.sampler_cpus,  # pyright: ignore[reportArgumentType]
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
        config.debugging(seed=job.seed % 2**32, log_level="ERROR")  # numpy's global generator takes no more
        config._dont_auto_sync_env_runner_states = True
        return config


def _no_mapping(agent: Any, *arguments: Any, **kwargs: Any) -> str:
    """RLlib wants a mapping and must not use it: the runner knows who sits where."""
    raise RuntimeError(f"agent {agent!r} was to be mapped to a module, which only RLlib's own runners do")


class Mappo(PPO):
    """One iteration: choose each member's partner, sample, learn. The driver reads `report` after `train()`."""

    config: MappoConfig  # RLlib makes these three
    learner_group: Any
    env_runner_group: Any

    def __init__(self, config: MappoConfig, *arguments: Any, **keywords: Any) -> None:
        assert config.job is not None
        self.job = config.job
        self.matches = self.job.matches()
        self.played = PlayRecord(self.job)
        self.lost: set[int] = set()
        self.rounds, self.report = 0, Report()
        super().__init__(config, *arguments, **keywords)

    @classmethod
    def get_default_config(cls) -> MappoConfig:
        """RLlib's hook."""
        return MappoConfig()

    def _setup_logdir(self) -> None:
        """Nothing: RLlib would make an empty folder in the user's home for every training."""

    # ---- one iteration -------------------------------------------------------------------------------------------

    def training_step(self) -> None:
        """Partners, rollouts, update; see `report`."""
        began, ppo = time.perf_counter(), self.job.ppo
        self.lost.clear()
        counted: list[Counted] = []
        weights = self._ask_learner(lambda learner: learner.actors())
        self._select_partners(weights, counted)
        plans = {member: self.played.plan(member, self.rounds) for member in self.job.learning}
        active = [index for index, match in enumerate(self.matches) if self.played.is_played(match, plans)]
        rollouts = self._request_rollouts("sample", counted, weights=weights, active=active, steps=ppo.steps)
        sampled = time.perf_counter()
        self.learner_group.update(episodes=rollouts, timesteps={}, plans=plans, progress=self.progress)
        learned = time.perf_counter()
        figures = self._ask_learner(lambda learner: learner.figures())
        self.rounds += 1
        for member in self.job.learning:
            figures[member] = figures.get(member, {}) | self.played.scores(member)
        seconds = {"sampling": sampled - began, "learning": learned - sampled}
        seconds |= self._ask_learner(lambda learner: learner.seconds)
        self.report = Report(counted, figures, seconds, sorted(self.lost))

    @property
    def progress(self) -> float:
        """Share of the budget that every member's self-play has used up."""
        return self.played.progress

    @property
    def finished(self) -> bool:
        """The budget is used up, or every member's targets are reached."""
        return self.played.finished

    def scores(self, member: int) -> dict[str, float]:
        """Mean scores of the latest episodes: `sp`, and `xp` of the partner with the highest."""
        return self.played.scores(member)

    def _select_partners(self, weights: Any, counted: list[Counted]) -> None:
        """Where it is time for them, fresh whole episodes with every partner decide who is the strongest."""
        diversity = self.job.diversity
        if diversity is None or not self.job.fresh or not self.job.frozen or self.rounds % diversity.select_every:
            return
        for member in self.job.learning:
            matches = self.played.selection_matches(member, diversity)
            seed = int(self.played.rng.integers(2**31))
            self._request_rollouts("episodes", counted, weights=weights, matches=matches, seed=seed)

    # ---- runners -------------------------------------------------------------------------------------------------

    def _request_rollouts(self, what: str, counted: list[Counted], **request: Any) -> list[Rollout]:
        """Ask every runner, and count what comes back. A lost runner's share is missing until it has been restarted; a
        runner may have none."""
        rollouts: list[tuple[int, Rollout]] = []
        for _ in range(ATTEMPTS):
            answers = self._ask_runners(what, request)
            if rollouts := [(runner, answer) for runner, answer in answers if answer is not None]:
                break
            self.restore_env_runners(self.env_runner_group)
        if not rollouts:
            raise RayActorError(error_msg=f"no runner answered {ATTEMPTS} times")
        self.played.add_habits([rollout for _, rollout in rollouts])
        for runner, rollout in rollouts:
            judge = what == "episodes" or not self.job.fresh
            counted += self.played.add(runner, rollout, judge_partners=judge)
        return [rollout for _, rollout in rollouts]

    def _ask_runners(
        self, what: str, request: Mapping[str, Any], only: list[int] | None = None
    ) -> list[tuple[int, Any]]:
        """Answers of the runners (`only` some of them), in their order; those that did not answer are `lost`.

        Raises:
            RunnerError: one of them could not do it.
        """
        group = self.env_runner_group
        if group.num_remote_env_runners():
            if "weights" in request:  # one copy for all runners
                request = {**request, "weights": ray.put(request["weights"])}
            answers = group._worker_manager.foreach_actor(what, kwargs=request, remote_actor_ids=only)
            replies = {answer.actor_id: answer.get() for answer in answers if answer.ok}
            self.lost |= set(group._worker_manager.actor_ids() if only is None else only) - replies.keys()
        else:
            replies = {0: getattr(group.local_env_runner, what)(**request)}
        for runner, answer in replies.items():
            if isinstance(answer, Failure):
                raise RunnerError(f"runner {runner} failed:\n{answer.text}")
        return sorted(replies.items())

    def restore_env_runners(self, env_runner_group: Any) -> list[int]:
        """Find runners that Ray has restarted; their weights come with the next request."""
        return env_runner_group.probe_unhealthy_env_runners()

    def _ask_learner(self, function: Any) -> Any:
        return self.learner_group.foreach_learner(function).result_or_errors[0].get()

    # ---- what the driver asks for --------------------------------------------------------------------------------

    def actors(self) -> Any:
        """Member -> weights of its actor."""
        return self._ask_learner(lambda learner: learner.actors())

    def critics(self, member: int) -> Any:
        """Weights of a member's critics."""
        return self._ask_learner(lambda learner: learner.critics(member))

    def snapshot(self) -> dict[str, Any]:
        """Everything to continue from exactly here: learner, runners, partners, generators, counters."""
        runners = dict(self._ask_runners("snapshot", {}))
        return {
            "learner": self._ask_learner(lambda learner: learner.snapshot()),
            "runners": {str(index): state for index, state in runners.items()},
            "played": self.played.state(),
            "rounds": self.rounds,
        }

    def resume(self, state: Mapping[str, Any]) -> None:
        """Continue from `snapshot()` of an algorithm of the same job.

        Raises:
            KeyError, ValueError: it is of another job.
        """
        self._ask_learner(lambda learner: learner.restore(state["learner"]))
        for index, saved in state["runners"].items():
            try:
                self._ask_runners("restore", {"state": saved}, only=[int(index)])
            except RunnerError as error:
                raise ValueError(str(error).strip().rpartition("\n")[2]) from None
        self.played.load_state(state["played"])
        self.rounds = int(state["rounds"])


def build_algorithm(job: Job, spec: EnvSpec, cluster: ClusterConfig) -> Mappo:
    """RLlib's learner and runners for a job."""
    return cast(Mappo, MappoConfig.of(job, spec, cluster).build_algo())
