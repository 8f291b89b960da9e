"""How strong each partner is in real cross-play, whom a member is trained against, and cross-play as a constraint."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from popgen.losses.policy_losses import next_multiplier

Rule = Literal["max_window", "max_buffer", "max_latest"]


class PartnerStrength:
    """Real returns (and scores) by partner, from the cross-play episodes that one member was in, in both seatings.

    A partner without episodes has no strength: it counts as not seen yet.

    Args:
        rule: `max_window` knows a partner by the mean of the episodes last added, `max_buffer` by the mean of all that
            were, `max_latest` by the mean of the latest `window`.
        window: episodes remembered of each partner under `max_latest`; None remembers all since `forget`.
    """

    def __init__(self, rule: Rule, window: int | None = None) -> None:
        self.rule, self.window = rule, window
        self.returns: dict[int, deque[float]] = {}
        self._scores: dict[int, deque[float]] = {}
        self._sums: dict[int, list[float]] = {}

    def add(self, partner: int, returns: Sequence[float], scores: Sequence[float] = ()) -> None:
        """Episodes with `partner`: their returns and, where somebody asks for `mean_scores`, their scores."""
        if not len(returns):
            return
        if self.rule == "max_window":
            self.forget(partner)
        self._remember_values(self.returns, partner, returns)
        self._remember_values(self._scores, partner, scores)
        if self.rule == "max_buffer":
            total, count = self._sums.get(partner, [0.0, 0])
            self._sums[partner] = [total + float(np.sum(returns)), count + len(returns)]
            self.forget(partner)

    def _remember_values(self, memory: dict[int, deque[float]], partner: int, values: Iterable[float]) -> None:
        memory.setdefault(partner, deque(maxlen=self.window)).extend(float(value) for value in values)

    def forget(self, partner: int) -> None:
        """Only episodes from now on count; the sums of `max_buffer` stay."""
        self.returns.pop(partner, None)
        self._scores.pop(partner, None)

    def scores(self) -> dict[int, float]:
        """Strength, the mean return, of every partner seen."""
        if self.rule == "max_buffer":
            return {partner: total / count for partner, (total, count) in self._sums.items()}
        return _mean_of_each(self.returns)

    def mean_scores(self) -> dict[int, float]:
        """Partner -> mean score of the episodes remembered, of those that have some."""
        return _mean_of_each(self._scores)

    def state(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "returns": {str(partner): list(values) for partner, values in self.returns.items()},
            "scores": {str(partner): list(values) for partner, values in self._scores.items()},
            "sums": {str(partner): list(sums) for partner, sums in self._sums.items()},
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Replace the contents with `state()`."""
        self.returns, self._scores = {}, {}
        for memory, name in ((self.returns, "returns"), (self._scores, "scores")):
            for partner, values in state[name].items():
                self._remember_values(memory, int(partner), values)
        self._sums = {int(partner): list(sums) for partner, sums in state["sums"].items()}


def _mean_of_each(memory: Mapping[int, deque[float]]) -> dict[int, float]:
    return {partner: float(np.mean(values)) for partner, values in memory.items() if values}


def strongest_partner(
    partners: Collection[int], strength: Mapping[int, float], unseen: Mapping[int, float] | None = None
) -> int:
    """The partner of the highest strength, the lowest number of equals; one that has none yet comes first.

    Args:
        partners: to choose from.
        strength: partner -> `PartnerStrength.scores`.
        unseen: which of those without strength leads; one that is not in it comes before those that are.

    Raises:
        ValueError: there are no partners.
    """
    members, guesses = sorted(partners), unseen or {}
    if new := [k for k in members if k not in strength]:
        return max(new, key=lambda k: guesses.get(k, float("inf")))
    return max(members, key=lambda k: strength[k])


def any_or_strongest(
    partners: Collection[int],
    strength: Mapping[int, float],
    random_share: float,
    rng: np.random.Generator,
    unseen: Mapping[int, float] | None = None,
) -> int:
    """The strongest, or now and then any: so every partner's critic and estimate stay fresh.

    The second number is drawn only where any partner is to be chosen.
    """
    if rng.random() < random_share:
        return int(rng.choice(sorted(partners)))
    return strongest_partner(partners, strength, unseen)


def any_then_strongest(
    partners: Collection[int], strength: Mapping[int, float], random_share: float, rng: np.random.Generator
) -> int:
    """`any_or_strongest` of the baselines, which draw both numbers every time: their generator's place does not depend
    on what is chosen."""
    candidate = int(rng.choice(sorted(partners)))
    return candidate if rng.random() < random_share else strongest_partner(partners, strength)


class PartnerConstraint:
    """Maximise J_SP(j) subject to J_XP(j, k) <= `limit` for every partner k (`popgen.losses.policy_losses`).

    Every multiplier is 1 until its partner has been met, so that the pressure is whole while conventions are chosen.
    Below the limit there is nothing to gain: a member that holds to a convention of its own has no reason to do worse.
    A partner is drawn in proportion to the multipliers: the strongest may be one whose convention has to be shared, as
    there are fewer conventions than members, and under max_k it would take the whole pressure, which only sabotage
    could relieve.

    Args:
        limit: a score; None: there is no constraint, and every multiplier is 1.
        step: of dual ascent, each time that scores with a partner arrive.
    """

    def __init__(self, limit: float | None, step: float) -> None:
        self.limit, self.step = limit, step
        self.multipliers: dict[int, float] = {}

    def add(self, cross_play: Mapping[int, float], self_play: float | None) -> None:
        """New mean scores by partner, and that of the member's own self-play (None: not known yet)."""
        if self.limit is None or self_play is None:
            return
        for partner, score in cross_play.items():
            now = self.multiplier(partner)
            self.multipliers[partner] = next_multiplier(now, score, self_play, limit=self.limit, step=self.step)

    def draw_partner(self, partners: Sequence[int], rng: np.random.Generator) -> int:
        """One of the partners, in proportion to their multipliers; any where all of these are 0."""
        weights = np.array([self.multiplier(partner) for partner in partners])
        total = weights.sum()
        return int(rng.choice(list(partners), p=weights / total if total else None))

    def multiplier(self, partner: int) -> float:
        """m_k in [0, 1]."""
        return self.multipliers.get(partner, 1.0)

    def pressure(self, partners: Sequence[int]) -> float:
        """The largest multiplier of the partners: the share of lambda_XP that one of them, drawn, gets."""
        return max(self.multiplier(partner) for partner in partners)

    def state(self) -> dict[str, float]:
        """JSON-able."""
        return {str(partner): value for partner, value in self.multipliers.items()}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Replace the multipliers by those of `state()`."""
        self.multipliers = {int(partner): float(value) for partner, value in state.items()}
