"""All tables and figures that `popgen reproduce` makes, and how much may be spent on them."""

from __future__ import annotations

from popgen.errors import UserError
from popgen.reports.paper_ego_figures import EGOS
from popgen.reports.paper_figures import CRAMPED, LAYOUT_NAMES, RENDEZVOUS, RING, SIMULATOR_METHOD
from popgen.reports.reproduction import paper_lines, run_lists
from popgen.reports.reproduction.paper_lines import ANY_EXIT, AVERAGE, SP, TOTAL, XP
from popgen.reports.reproduction.target_records import Budget, Column, StudyBudget, Target

ALL = "all"
"""Name of all targets together."""

BUDGETS = {
    "smoke": Budget(
        "smoke",
        "minutes: every piece once, nothing learned",
        scale="smoke",
        agents=3,
        rendezvous_agents=2,
        layouts=(CRAMPED,),
        ring=CRAMPED,
        seeds=(1,),
        episodes=2,
        settings=("tracking.enabled=false",),
        rendezvous=("xpm_sim.unroll=30",),
        minutes=0.2,
        inline=True,
        study=StudyBudget(participants=3, pairs=1, tutorials=1, steps=40, random_keys=True),
        proxy={"drawn": 2, "rounds": 0, "episodes": 2, "final_episodes": 2},
    ),
    "laptop": Budget(
        "laptop",
        "two cores, about a day for all",
        scale="laptop",
        agents=3,
        rendezvous_agents=8,
        layouts=(CRAMPED, RING),
        ring=RING,
        seeds=(1, 2, 3),
        episodes=20,
        rendezvous=("evaluation.episodes=2", "ppo.max_steps=260000"),
        minutes=10.0,
        study=StudyBudget(participants=40, pairs=5),  # 23 games in two layouts
    ),
    "paper": Budget(
        "paper",
        "the paper's networks and steps; weeks on two cores",
        scale="paper",
        agents=8,
        rendezvous_agents=8,
        layouts=tuple(name for name in LAYOUT_NAMES if name != RENDEZVOUS),
        ring=RING,
        seeds=(1, 2, 3),
        episodes=40,
        minutes=600.0,
    ),
}
"""Name -> budget."""

_PLAY = (Column(SP, "scores.sp"), Column(XP, "scores.xp"))
_BESIDE = (Column("beside random", "scores.random"), Column("beside idle", "scores.idle"))
_MIXED = (
    Column("mixed play", "scores.mixed"),
    Column("mixed play, least", "scores.mixed_least"),
    Column("obstructed pairs", "scores.obstructed", 1),
)
_HELD = (Column("agents that pass", "held.passed", 1), Column("steps until all pass", "held.steps", 0))
_REAL, _MINUTES = Column("real steps", "costs.real", 0), Column("minutes", "costs.minutes", 1)
_COSTS = (_REAL, Column("simulated steps", "costs.simulated", 0), _MINUTES)
_SIMULATED = (
    "Simulated steps are of the exact simulator, the same compiled environment as that of real ones; they are in no "
    "other figure."
)

TARGETS = {
    target.name: target
    for target in (
        Target(
            "table1",
            "Self-sabotage on rendezvous",
            'table "Results of the MPPMR environment"',
            "XPM-Sim does not leave the task in cross-play, LIPO does, and its self-play is high.",
            run_lists.list_sabotage,
            (
                Column(ANY_EXIT, "sabotage.any_exit", 3),
                Column("own exit", "sabotage.own_exit", 3),
                Column(SP, "sabotage.sp", 1),
                Column(XP, "sabotage.xp", 1),
                Column("XP apart", "sabotage.xp_apart", 1),
                Column("landmarks", "sabotage.landmarks", 1),
                Column("pairs at one", "sabotage.sharing", 1),
                Column("beside random", "sabotage.random", 1),
                Column("beside idle", "sabotage.idle", 1),
            ),
            "draw_bars",
            (ANY_EXIT, XP),
            paper_lines.list_sabotage_lines,
            (
                "Any exit: share of cross-play episodes with earlier agents that ended early, whoever left; the paper "
                "counts these. Own exit: those in which this agent itself left. An exit costs the worst reward for "
                "every step that was left. XP apart: of pairs that do not share one of the 4 landmarks.",
                "Not to leave is no merit of members that play like independent seeds: compare XP with self-play only.",
                "`paper` is a method's published objective, `ours` the same floor, bound and limit of cross-play in "
                "every method.",
            ),
        ),
        Target(
            "steps-by-members",
            "Environment steps by number of agents",
            'figure "Scaling by number of agents"',
            "XPM-WM needs an expensive first agent and cheap later ones, so that it grows slowest.",
            run_lists.list_steps,
            (
                Column("agent 1", "costs.first", 0),
                Column("each later", "costs.later", 0),
                Column(TOTAL, "costs.real", 0),
                Column("simulated", "costs.simulated", 0),
                *_HELD,
            ),
            "draw_members",
            ("costs.by_members",),
            paper_lines.list_step_lines,
            (
                "An agent passes by a held evaluation of its own policy: SP at least 0.8 and XP with its strongest "
                "partner at most 0.2 of the SP of the paper's XPM-WM. Simulated steps are in no total.",
            ),
        ),
        Target(
            "sp-xp",
            "Self-play and cross-play",
            'table "Average SP and XP Results"',
            "XPM-WM's populations play best with themselves and least with each other.",
            run_lists.list_scores,
            (*_PLAY, *_BESIDE, *_MIXED, *_COSTS),
            "draw_bars",
            (SP, XP),
            paper_lines.list_score_lines,
            (
                "XP below play beside a random partner is obstruction, not another convention. Mixed play: what "
                "remains of self-play from a random step of a cross-play episode on, over members and seats.",
                _SIMULATED,
            ),
        ),
        Target(
            "ego",
            "Egos beside held-out populations",
            'table "Results for Ego agents", and the tables by layout',
            "An ego trained with XPM-WM's population does as well beside all hold-outs as with any other.",
            run_lists.list_egos,
            (
                *(Column(f"beside {ego}", f"holdout.{ego}") for ego in (*EGOS, SIMULATOR_METHOD)),
                Column(AVERAGE, "holdout.average"),
                Column("worst pair", "holdout.worst"),
            ),
            "draw_bars",
            (AVERAGE,),
            paper_lines.list_ego_lines,
            (
                "A row is the method whose population trained the ego; held out are populations of the next seed. "
                "Egos are HiPT's, or have one level: the same networks and training without the second.",
            ),
        ),
        Target(
            "curves",
            "Self-play in training",
            'figure "Training Curves for all 5 Overcooked layouts"',
            "Later agents of XPM-WM learn faster, by self-play steps, than those of the others.",
            run_lists.list_curves,
            (
                Column("final, later agents", "curves.final", 2),
                Column("steps to 80 % of it", "curves.reached", 0),
                *_PLAY,
            ),
            "draw_lines",
            ("curves.later",),
            notes=("Own real steps of a later agent of all kinds, of which self-play's are a part.",),
        ),
        Target(
            "wall-clock",
            "Training time by number of agents",
            'figures "Training wall clock time"',
            "XPM-WM's first agent takes longest, its later ones least.",
            run_lists.list_times,
            (
                Column("agent 1, minutes", "costs.first_minutes", 1),
                Column("each later", "costs.later_minutes", 1),
                Column("in all", "costs.minutes", 1),
            ),
            "draw_members",
            ("costs.minutes_by_members",),
            notes=("Wall-clock on a machine that other work may have shared: upper bounds.",),
        ),
        Target(
            "vector-reward",
            "A world model that predicts events, and one that predicts the reward",
            'figure "With and without vectorized event-based reward prediction"',
            "With a scalar reward XPM-WM's first agent learns nothing that is of use.",
            run_lists.list_rewards,
            (
                Column("self-play of agent 1", "first.final", 2),
                Column("its steps", "first.steps", 0),
                Column("minutes", "first.minutes", 1),
            ),
            "draw_lines",
            ("first.curve",),
            notes=("The scalar head is a Gaussian's mean, as in the paper. Self-play of the run's own evaluation.",),
        ),
        Target(
            "shared-encoder",
            "An encoder that all agents share",
            'figure "XPM-Sim with and without the shared encoder"',
            "A shared encoder alone does not help later agents: it is the world model's dynamics that do.",
            run_lists.list_encoders,
            (
                Column("final, later agents", "curves.final", 2),
                Column("simulated steps to 80 % of it", "curves.reached_simulated", 0),
                *_PLAY,
            ),
            "draw_lines",
            ("curves.later_simulated",),
        ),
        Target(
            "conventions",
            "What people do, and how much of it populations do",
            'table "Difference in average number of dishes served with specific human conventions"',
            "The ego of XPM-WM's population differs least between people of different conventions.",
            run_lists.list_conventions,
            (
                *(
                    Column(f"{behaviour}, {group}", f"conventions.{behaviour} {group}")
                    for behaviour in ("plating", "onion picking", "movement")
                    for group in ("high", "low")
                ),
                Column("games", "conventions.games", 0),
                Column("dishes", "conventions.dishes"),
                Column("nearest", "conventions.nearest"),
                Column("of the average person", "conventions.average"),
            ),
            "draw_bars",
            ("nearest", "of the average person"),
            paper_lines.list_convention_lines,
            (
                "The paper's people played with its egos; no people have played with ours. Rows of a method are its "
                "members in self-play. Rows of an ego are clones of recorded people (at the smoke budget random keys) "
                "who took part in the study of docs/study.md with egos of these methods' populations, all layouts at "
                "once: its recordings, all proven, and Table 3 with sizes and intervals are in OUT/studies. Effects "
                "are dishes of the high and of the low group less those of all, pooled as in the paper. Nearest: "
                "median distance of a recorded person to the nearest member, in people's standard deviations; a "
                "population covers people only where it is below that of the average person.",
            ),
        ),
        Target(
            "ablations",
            "One part left out or put in",
            "",
            "",
            run_lists.list_ablations,
            (*_PLAY, *_BESIDE, *_MIXED, Column(ANY_EXIT, "sabotage.any_exit", 3), *_COSTS),
            "draw_bars",
            (SP, XP),
            notes=(_SIMULATED,),
        ),
        Target(
            "baselines",
            "The baselines' lambda, and no early end",
            "",
            "",
            run_lists.list_baselines,
            (
                *_PLAY,
                *_BESIDE,
                *_MIXED,
                *_HELD,
                *(_REAL, _MINUTES),
            ),
            "draw_bars",
            (SP, XP),
            notes=("Without an early end a member trains for its whole budget, whatever it scores.",),
        ),
        Target(
            "generators",
            "All generators of populations",
            "",
            "",
            run_lists.list_generators,
            (
                Column("members", "diversity.members", 0),
                *_PLAY,
                *_BESIDE,
                *_MIXED,
                Column("BR-Div, log det", "diversity.log_determinant", 1),
                Column("effective rank", "diversity.effective_rank", 1),
                Column("entropy of the mean policy", "acting.entropy", 2),
                Column("divergence of trajectories, of ln K", "acting.share", 2),
                Column("nearest to people", "conventions.nearest"),
                Column("of the average person", "conventions.average"),
                *_COSTS,
                Column("its ego, average", "holdout.average"),
                Column("its ego, worst pair", "holdout.worst"),
                Column("its ego beside people's clone", "human.score"),
            ),
            "draw_bars",
            (SP, XP),
            paper_lines.list_score_lines,
            (
                "Egos of all populations are held against the same: populations of the next seed of the paper's three "
                "methods, and a clone of the people whose games are held out. Steps count discarded runs.",
                "Members of pairs (HSP, BP, BRDiv) never learned to play with themselves: SP is play with the mate, XP "
                "is across pairs, and mixed play, which goes on with one member in both seats, is left out. Their "
                "events, actions and dishes are those beside the mate too.",
                "Divergence: of joint trajectories, as a share of ln K, the most that K members can have; K is all "
                "members, or those that were trained to the end.",
                _SIMULATED,
                "Nearest to people: as in the table of conventions; populations cover people only below the average "
                "person.",
            ),
        ),
    )
}
"""Name -> target."""


def find_targets(name: str) -> list[Target]:
    """The target with a name, or all.

    Raises:
        UserError: there is none.
    """
    if name == ALL:
        return list(TARGETS.values())
    if name not in TARGETS:
        raise UserError("TARGET", f"there is no target {name!r}", f"choose one of {', '.join((*TARGETS, ALL))}")
    return [TARGETS[name]]
