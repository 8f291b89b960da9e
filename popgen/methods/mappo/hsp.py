"""HSP (Yu et al. 2023), hidden-utility self-play: partners who want something else.

    biased agent b_i    max E[ sum of u_i(b_i's events) + the true reward ],   u_i linear, weights drawn
    its partner p_i     max E[ sum of the true reward ]                        both in the pair (b_i, p_i)

A pool of pairs is trained together. In the end those pairs become members whose biased agents do the most different
things: HSP's choice, by the distance of their mean event counts. ZSC-Eval (Wang et al. 2024) takes the same pairs as
hold-outs, behaviour-preferring partners and their best responses, and chooses by what the responses do (BR-Div).
Environment steps of all pairs are counted, evenly for all members, since each is chosen from all.

Counts are moving means over the last iterations of training. A utility that is the true reward leaves one policy for
both seats. Left out: the pool's self-play agents of other skill, which `method=fcp` makes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from popgen.envs import make_env
from popgen.envs.contract import EnvSpec
from popgen.envs.player_events import name_player_events
from popgen.methods.mappo.config import BpRun, HspConfig, HspRun
from popgen.methods.mappo.hidden_utility import draw_utility
from popgen.methods.mappo.needs import roles_of
from popgen.methods.mappo.objective import Objective
from popgen.methods.mappo.train import STEP_SECONDS, RllibTraining, refuse_inline
from popgen.methods.mappo.training_job import Job
from popgen.methods.training import PlannedPhase, TrainedMember, Transport
from popgen.play.event_diversity import choose_most_distant, choose_most_diverse
from popgen.types import BIASED_ROLE


class HspTraining(RllibTraining):
    """All pairs together; see `popgen.methods.training.Training`. Partners have the numbers 1 to `pool` in RLlib, the
    biased agents those after them."""

    def __init__(self, config: HspRun | BpRun, spec: EnvSpec, attempt: str) -> None:
        super().__init__(config, spec, attempt, Objective(together=True))
        self.hsp: HspConfig = config.hsp
        self.names = name_player_events(make_env(config.env.name, 1, **config.env.params))
        self.roles = roles_of(config.hsp)
        self.utilities = {
            pair: draw_utility(
                self.names,
                spread=config.hsp.spread,
                biases=config.hsp.biases,
                reward=config.hsp.reward,
                seed=(config.run.seed, pair),
            )
            for pair in range(1, config.hsp.pool + 1)
        }

    def make_job(self) -> Job:
        """Partners, and a biased agent beside each whose utility is not the true reward."""
        config, biased = self.config, {pair: self.biased_of(pair) for pair in self.utilities}
        pairs = {pair: other for pair, other in biased.items() if other != pair}
        return Job(
            env=config.env,
            ppo=config.ppo,
            diversity=None,
            learning=(*self.utilities, *pairs.values()),
            seed=config.run.seed * 1000 + 1,
            pairs=pairs,
            utilities={other: self.utilities[pair] for pair, other in pairs.items()},
        )

    def biased_of(self, pair: int) -> int:
        """Number in RLlib of a pair's biased agent: its partner's own where both want the same."""
        return pair if self.utilities[pair].is_true else pair + self.hsp.pool

    def member_of(self, trained: int) -> int:
        """The pool's steps are shared out evenly."""
        return 1 + (trained - 1) % self.config.population.size

    def figures_by_member(self) -> dict[int, dict[str, float]]:
        """Means over the partners whose steps count for a member."""
        found: dict[int, list[dict[str, float]]] = {}
        for pair in self.utilities:
            if figures := self.algorithm.report.figures.get(pair):
                found.setdefault(self.member_of(pair), []).append(figures)
        return {member: _mean_figures(rows) for member, rows in found.items()}

    def plan(self) -> list[PlannedPhase]:
        """One phase, of all pairs."""
        cost = self.hsp.pool * self.config.ppo.max_steps * STEP_SECONDS
        return [PlannedPhase(self.config.method, 1, cost, self.config.population.size, earliest=0.0)]

    def finish_members(self) -> Iterator[TrainedMember]:
        """The roles of the chosen pairs, one pair after the other."""
        chosen = self.choose_pairs()
        for member in self.learning:
            place, number = divmod(member - 1, len(self.roles))
            pair, role = chosen[place], self.roles[number]
            trained = self.biased_of(pair) if role == BIASED_ROLE else pair
            finished = self.finish_member(member, trained)
            finished.extra.update(
                role=role,
                pair=pair,
                pool=self.hsp.pool,
                utility=self.utilities[pair].describe(self.names),
                events=self._describe_events(trained),
            )
            yield finished

    def choose_pairs(self) -> list[int]:
        """Numbers of the pairs that become members, ascending."""
        wanted = self.config.population.size // len(self.roles)
        if self.hsp.select == "events":
            counts = np.stack([self.count_events(self.biased_of(pair)) for pair in self.utilities])
            return [row + 1 for row in choose_most_distant(counts, wanted)]
        counts = np.stack([self.count_events(pair) for pair in self.utilities])
        return [row + 1 for row in choose_most_diverse(counts, wanted)]

    def count_events(self, trained: int) -> np.ndarray:
        """(F,) mean counts of an episode of one of RLlib's policies, in its pair; 0 where nobody counted."""
        habits = self.algorithm.played.habits.get(trained)
        return np.zeros(len(self.names)) if habits is None else habits * self.spec.horizon

    def _describe_events(self, trained: int) -> dict[str, float]:
        counts = self.count_events(trained)
        return {name: round(float(count), 2) for name, count in zip(self.names, counts, strict=True) if count}


def _mean_figures(rows: list[dict[str, float]]) -> dict[str, float]:
    names = sorted(set().union(*rows))
    return {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}


def open_training(config: HspRun | BpRun, spec: EnvSpec, attempt: str, transport: Transport) -> HspTraining:
    """See `popgen.methods.training.OpenTraining`."""
    refuse_inline(transport)
    return HspTraining(config, spec, attempt)
