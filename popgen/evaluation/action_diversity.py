"""How differently the members of a population act in the same situations: what MEP and TrajeDi pay members for.

Each member plays with itself, or with its mate where it was trained in a pair, half of its games in each seat; and
every member says with what probability it would take each action there. All figures are in nats and means over the
members' own games, with a bootstrap over members and their games:

    entropy      H(mean_k pi_k), of one seat's action: the population entropy of MEP (Zhao et al. 2023)
    own entropy  mean_k H(pi_k): what is left of it where all members are one
    actions      their difference, the Jensen-Shannon divergence of actions
    trajectories JSD_gamma of joint trajectories (Lupu et al. 2021), between 0 and ln K

In the seat of a member's mate the others' mates answer: a joint trajectory is as probable under a member as under it
and its mate together. Entropies are of the members' own seats alone.
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
from popgen.evaluation.holdout_players import Group, Player, seat_mates
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

    A divergence says more of few members than of many: compare populations of different size by its `share`.
    """

    members: int
    entropy: Interval
    own_entropy: Interval
    actions: Interval
    trajectories: Interval
    most: float
    steps: int

    @property
    def share(self) -> Interval | None:
        """Divergence of trajectories as a part of ln K, between 0 and 1; None for one member."""
        if not self.most:
            return None
        return Interval(
            *(end / self.most for end in (self.trajectories.value, self.trajectories.low, self.trajectories.high))
        )


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


@dataclass(frozen=True)
class _Network:
    """What a policy would do, as a network with so large a memory, seen through a view."""

    run: nn.Module
    memory: int
    view: str


class _Answers:
    """What each of K members would do at every step that others play; they keep a memory of it.

    Args:
        networks: of the members, and after them of mates that are no members.
        mates: (K,) whose network answers for a member in its mate's seat.
        own: (B, P) bool, the seat is that of the member whose game it is.
        env: that they are asked in.
    """

    def __init__(self, networks: Sequence[_Network], mates: Sequence[int], own: np.ndarray, env: BatchedEnv) -> None:
        players, batch = env.spec.num_players, env.num_envs
        self.env, self.networks, self.mates, self.own = env, networks, list(mates), torch.from_numpy(own)
        self.seat = torch.arange(players).repeat(batch)
        self.memory = [torch.zeros(batch * players, network.memory) for network in networks]
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
            for view in {network.view for network in self.networks}
        }
        first = torch.from_numpy(step.is_first).repeat_interleave(players)
        previous = self.previous.repeat_interleave(players, 0)
        rows = []
        for k, network in enumerate(self.networks):
            logits, self.memory[k] = network.run(self.memory[k], obs[network.view], previous, first, self.seat)
            rows.append(torch.log_softmax(logits, -1))
        every = torch.stack(rows)
        log_probs = torch.where(self.own.reshape(1, -1, 1), every[: len(self.mates)], every[self.mates])
        self.previous = torch.from_numpy(step.actions.astype(np.int64))
        taken = self.previous.reshape(-1, 1).expand(len(log_probs), -1, 1)
        joint = log_probs.gather(-1, taken).squeeze(-1).unflatten(-1, (-1, players)).sum(-1)
        mean = torch.logsumexp(log_probs, 0) - math.log(len(log_probs))
        self.chosen.append(joint)
        self.entropy.append(self._average_own(_entropy(mean)))
        self.own_entropy.append(self._average_own(_entropy(log_probs).mean(0)))
        self.counted.append(step.counted)

    def _average_own(self, values: Tensor) -> Tensor:
        """(B,) means over own seats of (B * P,) values."""
        return (values.reshape(self.own.shape) * self.own).sum(-1) / self.own.sum(-1)


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
    mates: Sequence[int] | None = None,
) -> ActionDiversity | None:
    """How differently some policies act; None where one of them cannot tell its probabilities.

    Args:
        make: (num_envs, seed) -> environment.
        policies: K of them, one population's or what is to be seen as one; after them mates that are not of these.
        episodes: N of each with its mate or itself, at least 2.
        seed: same arguments, same result.
        kernel: TrajeDi's gamma, in [0, 1]: 0 compares single actions, 1 whole episodes.
        mates: (K,) place of each one's mate among the policies, its own where it has none; None where nobody has one.
    """
    networks = [_find_network(policy) for policy in policies]
    known = [network for network in networks if network is not None]
    if len(known) < len(networks):
        return None
    mates = range(len(policies)) if mates is None else mates
    env = make(len(mates) * episodes, 0)
    seats, own = _seat_members(mates, episodes, env.spec.num_players)
    answers = _Answers(known, mates, own, env)
    played = play(env, list(policies), seats, seed=seed, record=answers)
    counted = torch.from_numpy(np.stack(answers.counted))
    entropy = _mean_of_games(torch.stack(answers.entropy), counted, episodes)
    own = _mean_of_games(torch.stack(answers.own_entropy), counted, episodes)
    divergence = _mean_of_games(_diverge(torch.stack(answers.chosen, 1), counted, episodes, kernel), counted, episodes)
    return ActionDiversity(
        members=len(mates),
        entropy=_estimate_interval(entropy),
        own_entropy=_estimate_interval(own),
        actions=_estimate_interval(entropy - own),
        trajectories=_estimate_interval(divergence),
        most=math.log(len(mates)),
        steps=played.steps,
    )


def _find_network(policy: Policy) -> _Network | None:
    network = policy.seat_network() if isinstance(policy, Stackable) else None
    if network is None or not isinstance(policy, Stackable):
        return None
    return _Network(network, policy.memory_size, policy.view)


def _seat_members(mates: Sequence[int], episodes: int, players: int) -> tuple[np.ndarray, np.ndarray]:
    """(K * N, P) who sits where, and bool whose game it is: a member beside its mate in one seat, then in the other."""
    member = np.repeat(np.arange(len(mates)), episodes)
    own = np.arange(players) == np.arange(len(member))[:, None] % players
    own |= (np.array(mates)[member] == member)[:, None]
    return np.where(own, member[:, None], np.array(mates)[member][:, None]), own


def measure_groups(
    make: Callable[[int, int], BatchedEnv], groups: Sequence[Group], episodes: int, seed: int, *, kernel: float = KERNEL
) -> list[MeasuredActions]:
    """Each population as a whole and, where its members have skills or roles, those of one; see `measure_actions`.

    Members that were trained in pairs play with their mates, also where these have another role.

    Populations whose members cannot tell their probabilities are left out.
    """
    measured = []
    for group in groups:
        for part, players in _list_parts(group).items():
            everybody, mates = _add_mates(group, players)
            policies = [player.make() for player in everybody]
            found = measure_actions(make, policies, episodes, seed, kernel=kernel, mates=mates)
            if found is not None:
                measured.append(MeasuredActions(group.label, part, found))
    return measured


def _add_mates(group: Group, players: Sequence[Player]) -> tuple[list[Player], list[int]]:
    """Players and after them those of their mates that are not of them; the place of each one's mate."""
    together, places = seat_mates(group.players)
    mate_of = {id(player): together[place] for player, place in zip(group.players, places, strict=True)}
    mates = [mate_of[id(player)] for player in players]
    everybody = list({id(player): player for player in (*players, *mates)}.values())
    numbers = {id(player): number for number, player in enumerate(everybody)}
    return everybody, [numbers[id(mate)] for mate in mates]


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
