"""How differently the members of a population act in the same situations: what MEP and TrajeDi pay members for.

Each member plays with itself, and every member says with what probability it would take each action there. All figures
are in nats and means over the members' own games, with a bootstrap over members and their games:

    entropy      H(mean_k pi_k), of one seat's action: the population entropy of MEP (Zhao et al. 2023)
    own entropy  mean_k H(pi_k): what is left of it where all members are one
    actions      their difference, the Jensen-Shannon divergence of actions
    trajectories JSD_gamma of joint trajectories (Lupu et al. 2021), between 0 and ln K
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from popgen.envs.contract import BatchedEnv
from popgen.evaluation.holdout_metrics import Interval, bootstrap_interval
from popgen.evaluation.holdout_players import Group, Player
from popgen.losses.population_diversity import trajectory_divergence
from popgen.play.policy import Policy
from popgen.play.rollout import Transition, play
from popgen.play.stacked_partners import Stackable

KERNEL = 0.5
"""TrajeDi's gamma unless another one is asked for: a neighbouring step's weight beside the step's own."""


@dataclass(frozen=True)
class ActionDiversity:
    """How differently K members act; see the module's docstring.

    Attributes:
        members: K.
        entropy, own_entropy, actions, trajectories: in nats.
        most: ln K, the largest divergence there is.
        steps: environment steps taken.
    """

    members: int
    entropy: Interval
    own_entropy: Interval
    actions: Interval
    trajectories: Interval
    most: float
    steps: int


@dataclass(frozen=True)
class MeasuredActions:
    """How differently some members of a population act.

    Attributes:
        group: label of their population.
        part: `all`, or the skill or role that they have.
        found: the figures.
    """

    group: str
    part: str
    found: ActionDiversity


class _Answers:
    """What each of K networks would do at every step that others play; they keep a memory of it."""

    def __init__(self, networks: Sequence[nn.Module], sizes: Sequence[int], views: Sequence[str], env: BatchedEnv):
        players, batch = env.spec.num_players, env.num_envs
        self.env, self.networks, self.views = env, networks, views
        self.seat = torch.arange(players).repeat(batch)
        self.memory = [torch.zeros(batch * players, size) for size in sizes]
        self.previous = torch.zeros(batch, players, dtype=torch.int64)
        self.chosen: list[Tensor] = []
        self.entropy: list[Tensor] = []
        self.own_entropy: list[Tensor] = []
        self.counted: list[np.ndarray] = []

    @torch.no_grad()
    def __call__(self, step: Transition) -> None:
        players = self.previous.shape[1]
        obs = {
            view: torch.from_numpy(self.env.encode(step.states, view)).repeat_interleave(players, 0)
            for view in set(self.views)
        }
        first = torch.from_numpy(step.is_first).repeat_interleave(players)
        previous = self.previous.repeat_interleave(players, 0)
        rows = []
        for k, network in enumerate(self.networks):
            logits, self.memory[k] = network(self.memory[k], obs[self.views[k]], previous, first, self.seat)
            rows.append(torch.log_softmax(logits, -1))
        log_probs = torch.stack(rows)
        self.previous = torch.from_numpy(step.actions.astype(np.int64))
        taken = self.previous.reshape(-1, 1).expand(len(rows), -1, 1)
        joint = log_probs.gather(-1, taken).squeeze(-1).unflatten(-1, (-1, players)).sum(-1)
        mean = torch.logsumexp(log_probs, 0) - math.log(len(rows))
        self.chosen.append(joint)
        self.entropy.append(_entropy(mean).unflatten(0, (-1, players)).mean(-1))
        self.own_entropy.append(_entropy(log_probs).mean(0).unflatten(0, (-1, players)).mean(-1))
        self.counted.append(step.counted)


def _entropy(log_probs: Tensor) -> Tensor:
    """(..., A) -> (...)."""
    return -(log_probs.exp() * log_probs).sum(-1)


def measure_actions(
    make: Callable[[int, int], BatchedEnv],
    policies: Sequence[Policy],
    episodes: int,
    seed: int,
    *,
    kernel: float = KERNEL,
) -> ActionDiversity | None:
    """How differently some policies act; None where one of them cannot tell its probabilities.

    Args:
        make: (num_envs, seed) -> environment.
        policies: K of them, one population's or what is to be seen as one.
        episodes: N of each with itself, at least 2.
        seed: same arguments, same result.
        kernel: TrajeDi's gamma, in [0, 1]: 0 compares single actions, 1 whole episodes.
    """
    networks, sizes = [], []
    for policy in policies:
        network = policy.seat_network() if isinstance(policy, Stackable) else None
        if network is None or not isinstance(policy, Stackable):
            return None
        networks.append(network)
        sizes.append(policy.memory_size)
    env = make(len(policies) * episodes, 0)
    answers = _Answers(networks, sizes, [policy.view for policy in policies], env)
    seats = np.repeat(np.arange(len(policies)), episodes)[:, None].repeat(env.spec.num_players, 1)
    played = play(env, list(policies), seats, seed=seed, record=answers)
    counted = torch.from_numpy(np.stack(answers.counted))
    entropy = _mean_of_games(torch.stack(answers.entropy), counted, episodes)
    own = _mean_of_games(torch.stack(answers.own_entropy), counted, episodes)
    divergence = _mean_of_games(_diverge(torch.stack(answers.chosen, 1), counted, episodes, kernel), counted, episodes)
    return ActionDiversity(
        members=len(policies),
        entropy=_estimate_interval(entropy),
        own_entropy=_estimate_interval(own),
        actions=_estimate_interval(entropy - own),
        trajectories=_estimate_interval(divergence),
        most=math.log(len(policies)),
        steps=played.steps,
    )


def measure_groups(
    make: Callable[[int, int], BatchedEnv], groups: Sequence[Group], episodes: int, seed: int, *, kernel: float = KERNEL
) -> list[MeasuredActions]:
    """Each population as a whole and, where its members have skills or roles, those of one; see `measure_actions`.

    Populations whose members cannot tell their probabilities are left out.
    """
    measured = []
    for group in groups:
        for part, players in _list_parts(group).items():
            found = measure_actions(make, [player.make() for player in players], episodes, seed, kernel=kernel)
            if found is not None:
                measured.append(MeasuredActions(group.label, part, found))
    return measured


def _list_parts(group: Group) -> dict[str, list[Player]]:
    """All members, then those of each skill or role of which there are two."""
    parts: dict[str, list[Player]] = {"all": list(group.players)}
    for player in group.players:
        if label := player.part:
            parts.setdefault(label, []).append(player)
    return {part: players for part, players in parts.items() if part == "all" or len(players) > 1}


def _diverge(chosen: Tensor, counted: Tensor, episodes: int, kernel: float) -> Tensor:
    """(T, N) each step's part of the divergence, of (K, T, N) log-probabilities of the joint actions."""
    ends = counted.clone()
    ends[:-1] &= ~counted[1:]
    parts = []
    for own in range(len(chosen)):
        games = slice(own * episodes, (own + 1) * episodes)
        parts.append(trajectory_divergence(chosen[:, :, games].double(), own, ends[:, games], kernel))
    return torch.cat(parts, 1)


def _mean_of_games(values: Tensor, counted: Tensor, episodes: int) -> np.ndarray:
    """(K, N) means over each game's steps of (T, K * N) values."""
    means = (values.double() * counted).sum(0) / counted.sum(0)
    return means.reshape(-1, episodes).numpy()


def _estimate_interval(games: np.ndarray) -> Interval:
    """Over members and their games (K, N)."""
    return bootstrap_interval(games.T, lambda drawn: float(np.mean(drawn)), over_tasks=True)
