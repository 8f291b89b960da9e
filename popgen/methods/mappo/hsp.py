"""HSP (Yu et al. 2023), hidden-utility self-play: partners who want something else.

    biased agent b_i    max E[ sum of u_i(b_i's events) + the true reward ],   u_i linear, weights drawn
    its partner p_i     max E[ sum of the true reward ]                        both in the pair (b_i, p_i)

A pool of pairs is trained together. In the end pairs that deliver next to nothing are dropped (`hsp.least_score`), as
ZSC-Eval (Wang et al. 2024) drops them. Of the others those become members whose biased agents do the most different
things: HSP's choice, by the distance of their mean event counts. ZSC-Eval takes the same pairs as hold-outs,
behaviour-preferring partners and their best responses, and chooses by what the responses do (BR-Div; here of both
seats together, since no counts are kept of each). Where too few
deliver, the best of the rest are taken, and a line says so. Environment steps of all pairs are counted, evenly for all
members, since each is chosen from all; scores during training are those of pairs (`pair_3/sp`), as no member is known.

Counts are moving means over the last iterations of training. A utility that is the true reward leaves one policy for
both seats. Left out: the pool's self-play agents of other skill, which `method=fcp` makes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from popgen.envs import make_env
from popgen.envs.contract import EnvSpec
from popgen.envs.player_events import BR_DIV_EVENTS, SPARSE_REWARD, name_player_events
from popgen.methods.mappo.config import BpRun, HspConfig, HspRun
from popgen.methods.mappo.hidden_utility import draw_utility
from popgen.methods.mappo.needs import list_pair_roles
from popgen.methods.mappo.objective import Objective
from popgen.methods.mappo.play_record import Counted
from popgen.methods.mappo.train import STEP_SECONDS, RllibTraining, check_transport
from popgen.methods.mappo.training_job import Job
from popgen.methods.training import Checkpoint, PlannedPhase, Progress, Record, State, Transport
from popgen.play.event_diversity import choose_most_distant, choose_most_diverse
from popgen.types import BIASED_ROLE


class HspTraining(RllibTraining):
    """All pairs together; see `popgen.methods.training.Training`. Partners have the numbers 1 to `pool` in RLlib, the
    biased agents those after them."""

    def __init__(self, config: HspRun | BpRun, spec: EnvSpec, attempt: str) -> None:
        super().__init__(config, spec, attempt, Objective(together=True))
        self.hsp: HspConfig = config.hsp
        self.names = name_player_events(make_env(config.env.name, 1, **config.env.params))
        self.roles = list_pair_roles(config.hsp)
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
        self.episodes: dict[int, int] = {}  # member -> those that count for it

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

    def begin(self, first: int) -> tuple[int, ...]:
        """See `RllibTraining`."""
        learning = super().begin(first)
        self.episodes = dict.fromkeys(learning, 0)
        return learning

    def assign_counts(self, counted: Sequence[Counted]) -> list[Counted]:
        """The steps of the whole pool are shared out evenly over all iterations, and so are its episodes."""
        steps, shares = dict(self.progress.steps), list[Counted]()
        for runner in sorted({one.runner for one in counted}):
            mine = [one for one in counted if one.runner == runner]
            played, ended = sum(one.steps for one in mine), sum(one.episodes for one in mine)
            score = sum(one.score for one in mine)
            parts = zip(self.learning, level_totals(played, steps), level_totals(ended, self.episodes), strict=True)
            for member, part, episodes in parts:
                steps[member] += part
                self.episodes[member] += episodes
                share = score * episodes / max(1, ended)
                shares.append(replace(mine[0], owner=member, steps=part, episodes=episodes, score=share))
        return [share for share in shares if share.steps or share.episodes]

    def figures_by_member(self) -> dict[int, dict[str, float]]:
        """Means over the pairs' partners, and each pair's own score: in one row, for no member is of a pair yet."""
        found = {pair: self.algorithm.report.figures.get(pair, {}) for pair in self.utilities}
        scores = {f"pair_{pair}/sp": figures["sp"] for pair, figures in found.items() if "sp" in figures}
        learned = [{name: one for name, one in figures.items() if name != "sp"} for figures in found.values()]
        return {self.learning[0]: _mean_figures(learned) | scores}

    def plan(self) -> list[PlannedPhase]:
        """One phase, of all pairs."""
        cost = self.hsp.pool * self.config.ppo.max_steps * STEP_SECONDS
        return [PlannedPhase(self.config.method, 1, cost, self.config.population.size, earliest=0.0)]

    def finish_members(self) -> Iterator[Record]:
        """What was dropped, and the roles of the chosen pairs, one pair after the other."""
        chosen, idle = self.choose_pairs(), self.rank_pairs()[1]
        if idle:
            first = self.learning[0]
            yield Progress(first, self.progress.steps[first], note=self._describe_choice(chosen, idle))
        for member in self.learning:
            place, number = divmod(member - 1, len(self.roles))
            pair, role = chosen[place], self.roles[number]
            trained = self.biased_of(pair) if role == BIASED_ROLE else pair
            finished = self.finish_member(member, trained)
            finished.extra.update(
                role=role,
                pair=pair,
                pool=self.hsp.pool,
                dropped=len(set(idle) - set(chosen)),
                utility=self.utilities[pair].describe(self.names),
                events=self._describe_events(trained),
            )
            yield finished

    def choose_pairs(self) -> list[int]:
        """Numbers of the pairs that become members, ascending: the most different of those that deliver, or all these
        and the best of the rest."""
        wanted = self.config.population.size // len(self.roles)
        able, idle = self.rank_pairs()
        if len(able) <= wanted:
            return sorted(able + idle[: wanted - len(able)])
        if self.hsp.select == "events":
            rows = choose_most_distant(np.stack([self.count_events(self.biased_of(pair)) for pair in able]), wanted)
        else:
            rows = choose_most_diverse(np.stack([self.count_response(pair) for pair in able]), wanted)
        return [able[row] for row in rows]

    def rank_pairs(self) -> tuple[list[int], list[int]]:
        """Pairs whose own score is above `hsp.least_score`, ascending, and the others, the best first; a pair that has
        ended no episode has no score and is the last."""
        least = self.hsp.least_score
        scores = {pair: self.algorithm.scores(pair).get("sp", -np.inf) for pair in self.utilities}
        idle = [] if least is None else [pair for pair, score in scores.items() if score <= least]
        return [pair for pair in scores if pair not in idle], sorted(idle, key=lambda pair: (-scores[pair], pair))

    def _describe_choice(self, chosen: Sequence[int], idle: Sequence[int]) -> str:
        score = f"a score of at most {self.hsp.least_score:g} {self.spec.score_name}"
        found = f"{len(idle)} of {self.hsp.pool} pairs with {score}"
        if not (taken := sorted(set(idle) & set(chosen))):
            return f"{found}: dropped"
        names = ", ".join(map(str, taken))
        return f"{found}: too few others for {len(chosen)} pairs, so the best of them are kept (pair {names})"

    def checkpoint(self) -> State:
        """See `Training`."""
        return {**super().checkpoint(), "episodes": {str(member): count for member, count in self.episodes.items()}}

    def restore(self, checkpoint: Checkpoint) -> None:
        """See `Training`."""
        super().restore(checkpoint)
        saved = checkpoint.state.get("episodes", {})  # an earlier version did not keep them
        self.episodes |= {int(member): int(count) for member, count in saved.items()}

    def count_events(self, trained: int) -> np.ndarray:
        """(F,) mean counts of an episode of one of RLlib's policies, in its pair; 0 where nobody counted."""
        habits = self.algorithm.played.habits.get(trained)
        return np.zeros(len(self.names)) if habits is None else habits * self.spec.horizon

    def count_response(self, pair: int) -> np.ndarray:
        """(F,) mean counts of BR-Div's kinds by a pair's partner, over both seats. Every dish pays the same, so that
        deliveries stand for the reward too."""
        counts = dict(zip(self.names, self.count_events(pair), strict=True))
        kinds = BR_DIV_EVENTS if "delivery" in counts else self.names
        return np.array([counts["delivery" if name == SPARSE_REWARD else name] for name in kinds])

    def _describe_events(self, trained: int) -> dict[str, float]:
        counts = self.count_events(trained)
        return {name: round(float(count), 2) for name, count in zip(self.names, counts, strict=True) if count}


def level_totals(amount: int, before: Mapping[int, int]) -> list[int]:
    """Parts of `amount`, at least 0, that bring the totals `before` as near to each other as they can, in their order;
    of equals the first get what does not divide."""
    order = sorted(before, key=lambda name: before[name])
    parts = dict.fromkeys(before, 0)
    for count in range(len(order), 0, -1):
        low = order[:count]
        level, over = divmod(amount + sum(before[name] for name in low), count)
        if level >= before[low[-1]]:
            parts |= {name: level + (place < over) - before[name] for place, name in enumerate(low)}
            break
    return list(parts.values())


def _mean_figures(rows: list[dict[str, float]]) -> dict[str, float]:
    names = sorted(set().union(*rows))
    return {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}


def open_training(config: HspRun | BpRun, spec: EnvSpec, attempt: str, transport: Transport) -> HspTraining:
    """See `popgen.methods.training.OpenTraining`."""
    check_transport(transport)
    return HspTraining(config, spec, attempt)
