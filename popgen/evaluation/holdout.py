"""Egos beside hold-out partners: everything that one evaluation plays, in as few batches as fit.

Beside each ego with each partner in both seats there are controls: the ego with itself, beside a random and an idle
partner; the partner with itself, beside a random and an idle player; either with the mate of a pair that it was trained
in (HSP, BP, BRDiv); and the partner's best response, where one is given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.errors import UserError
from popgen.evaluation.holdout_players import Group, Player, Response, list_distinct, seat_mates
from popgen.play.episodes import Episodes
from popgen.play.policy import Policy
from popgen.play.rollout import play_teams
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy
from popgen.population.manifest import EnvironmentInfo

RANDOM, IDLE = "random", "idle"
CONTROLS = (RANDOM, IDLE)
SEATS = (0, 1)
MAX_ENVS = 8192
"""Episodes that are played side by side."""


@dataclass(frozen=True)
class Casting:
    """Who is to play.

    Attributes:
        egos, partners: groups; `partners` are held out, but for those of `met`.
        responses: partner's identity -> the best response trained for it.
        humans, met: labels of those partners that stand for people, and of those that taught an ego; they count in no
            average over hold-outs.
    """

    egos: tuple[Group, ...]
    partners: tuple[Group, ...]
    responses: Mapping[str, Response] = field(default_factory=dict)
    humans: frozenset[str] = frozenset()
    met: frozenset[str] = frozenset()

    @property
    def ego_players(self) -> list[Player]:
        """R of them, seeds of egos."""
        return [player for group in self.egos for player in group.players]

    @property
    def partner_players(self) -> list[Player]:
        """K of them."""
        return [player for group in self.partners for player in group.players]

    def rows(self, label: str) -> list[int]:
        """Indices of an ego's players among the R; of copies of one policy the first, so that it counts once."""
        return _choose_places(self.ego_players, [label])

    def columns(self, labels: Sequence[str]) -> list[int]:
        """Indices of the players of some groups of partners among the K; of copies of one policy the first."""
        return _choose_places(self.partner_players, labels)


def _choose_places(players: Sequence[Player], labels: Sequence[str]) -> list[int]:
    chosen = [place for place, player in enumerate(players) if player.group in labels]
    return [chosen[number] for number in list_distinct([players[place] for place in chosen])]


@dataclass(frozen=True)
class HoldoutResult:
    """Scores of N episodes of each pairing. R ego players, K partners, the last axis but one is a seat.

    Attributes:
        casting, environment: who played what.
        episodes, seed: N for each pair and seat.
        steps: environment steps taken.
        scores: (R, K, 2, N), by the ego's seat.
        ego_alone: (R, N), each ego with itself.
        ego_beside: control -> (R, 2, N), by the ego's seat.
        ego_mates: (R, 2, N) of egos' mates beside them, by the mate's seat; NaN where an ego has none.
        partner_alone: (K, N), each partner with itself.
        partner_beside: control -> (K, 2, N), by the control's seat, as if it were an ego.
        partner_mates: (K, 2, N) of partners' mates beside them, by the mate's seat; NaN where a partner has none.
        responses: (K, 2, N) of best responses by their seat; NaN where a partner has none.
    """

    casting: Casting
    environment: EnvironmentInfo
    episodes: int
    seed: int
    steps: int
    scores: np.ndarray
    ego_alone: np.ndarray
    ego_beside: Mapping[str, np.ndarray]
    ego_mates: np.ndarray
    partner_alone: np.ndarray
    partner_beside: Mapping[str, np.ndarray]
    partner_mates: np.ndarray
    responses: np.ndarray


class _Programme:
    """Lists matches and hands out their scores afterwards."""

    def __init__(self, casting: Casting, env: BatchedEnv) -> None:
        if not casting.egos or not casting.partners:
            raise UserError("holdout", "needs an ego and a partner at least")
        self.policies: list[Policy] = []
        self._seen: dict[str, int] = {}
        partners = casting.partner_players
        self.egos, self.ego_mates = self._add_players(casting.ego_players)
        self.partners, self.partner_mates = self._add_players(partners)
        found = [casting.responses.get(player.identity or "") for player in partners]
        self.responses = [None if one is None else self._add_player(one.player) for one in found]
        spec = env.spec
        self.controls = {
            RANDOM: self._add_policy(RandomPolicy(spec.num_actions)),
            IDLE: self._add_policy(IdlePolicy(spec.action_names)),
        }
        self.numbers: dict[tuple[int, int], int] = {}
        for match in self._list_matches():
            self.numbers.setdefault(match, len(self.numbers))

    def _add_players(self, players: Sequence[Player]) -> tuple[list[int], list[int | None]]:
        """Their numbers, and those of their mates; None without one."""
        everybody, mates = seat_mates(players)
        numbers = [self._add_player(player) for player in everybody]
        found = [None if mate == place else numbers[mate] for place, mate in enumerate(mates)]
        return numbers[: len(players)], found

    def _add_player(self, player: Player) -> int:
        """Its number; that of an earlier one with the same policy, which is played once."""
        if player.identity is None:
            return self._add_policy(player.make())
        if player.identity not in self._seen:
            self._seen[player.identity] = self._add_policy(player.make())
        return self._seen[player.identity]

    def _add_policy(self, policy: Policy) -> int:
        self.policies.append(policy)
        return len(self.policies) - 1

    def _list_matches(self) -> Iterator[tuple[int, int]]:
        """(seat 0, seat 1): partners one after the other, so that each is in as few batches as possible."""
        for partner, mate, response in zip(self.partners, self.partner_mates, self.responses, strict=True):
            yield partner, partner
            others = [one for one in (mate, response) if one is not None]
            for other in (*self.egos, *self.controls.values(), *others):
                yield from ((other, partner), (partner, other))
        for ego, mate in zip(self.egos, self.ego_mates, strict=True):
            yield ego, ego
            for other in (*self.controls.values(), *([] if mate is None else [mate])):
                yield from ((ego, other), (other, ego))

    def gather(self, played: Episodes, episodes: int, firsts: Sequence[int], seconds: Sequence[int]) -> np.ndarray:
        """(F, S, 2, N) scores of each first player with each second one, by the first one's seat."""
        table = played.score.reshape(len(self.numbers), episodes)
        pairs = [[[(f, s), (s, f)] for s in seconds] for f in firsts]
        chosen = [[[table[self.numbers[match]] for match in seats] for seats in row] for row in pairs]
        return np.array(chosen).reshape(len(firsts), len(seconds), len(SEATS), episodes)

    def gather_beside(
        self, played: Episodes, episodes: int, others: Sequence[int | None], players: Sequence[int]
    ) -> np.ndarray:
        """(K, 2, N) scores of the other beside each of K players, by the other's seat; NaN where there is none."""
        nothing = np.full((len(SEATS), episodes), np.nan)
        pairs = zip(others, players, strict=True)
        return np.array([nothing if a is None else self.gather(played, episodes, [a], [b])[0, 0] for a, b in pairs])


def evaluate_holdout(
    casting: Casting,
    environment: EnvironmentInfo,
    make: Callable[[int, int], BatchedEnv],
    episodes: int,
    seed: int,
    *,
    progress: Callable[[int, int], None] | None = None,
    max_envs: int = MAX_ENVS,
) -> HoldoutResult:
    """Play all egos with all partners in both seats, and the controls.

    Args:
        casting: who plays; see `popgen.evaluation.holdout_overlap.check_disjoint`.
        environment: that all were trained in.
        make: (num_envs, seed) -> that environment.
        episodes: N for each pair and seat.
        seed: same arguments, same result.
        progress: called with (episodes done, episodes in all).
        max_envs: episodes that are played side by side.

    Raises:
        UserError: less than one episode, or nobody on one side.
    """
    if episodes < 1:
        raise UserError("evaluation.episodes", f"must be at least 1, got {episodes}")
    programme = _Programme(casting, make(1, 0))
    played = play_teams(
        make, programme.policies, list(programme.numbers), episodes, seed=seed, max_envs=max_envs, progress=progress
    )

    scores = partial(programme.gather, played, episodes)
    scores_beside = partial(programme.gather_beside, played, episodes)
    egos, partners = programme.egos, programme.partners
    return HoldoutResult(
        casting=casting,
        environment=environment,
        episodes=episodes,
        seed=seed,
        steps=played.steps,
        scores=scores(egos, partners),
        ego_alone=np.array([scores([ego], [ego])[0, 0, 0] for ego in egos]),
        ego_beside={name: scores(egos, [index])[:, 0] for name, index in programme.controls.items()},
        ego_mates=scores_beside(programme.ego_mates, egos),
        partner_alone=np.array([scores([one], [one])[0, 0, 0] for one in partners]),
        partner_beside={name: scores([index], partners)[0] for name, index in programme.controls.items()},
        partner_mates=scores_beside(programme.partner_mates, partners),
        responses=scores_beside(programme.responses, partners),
    )
