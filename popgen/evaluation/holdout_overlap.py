"""The proof that egos and hold-out partners have nothing in common: no member, no teacher, no people, no start."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from popgen.errors import UserError
from popgen.evaluation.holdout_lineages import Lineage
from popgen.evaluation.holdout_players import Group

_OTHERS = "hold out populations of other seeds"
"""What to do about a shared member."""


def check_disjoint(egos: Sequence[Group], partners: Sequence[Group]) -> None:
    """Make sure that no ego has met a partner, or learned from what a partner learned from.

    What counts on both sides is what they are and what they were trained with: an ego's teachers, what these were
    trained with, and the same of a partner. See `Lineage.is_related` for what is too near.

    Raises:
        UserError: one line that names both, for a shared member, a common teacher, the same people, or one seed of one
            family of methods.
    """
    for ego in egos:
        for partner in partners:
            _check_members(ego, partner)
            _check_lineages(ego, partner)


def has_met(ego: Group, partner: Group) -> bool:
    """All of a partner's players are training partners of an ego, by their digests."""
    met = frozenset[str]().union(*(one.digests for one in ego.partners))
    return all(player.digest in met for player in partner.players)


def check_met(egos: Sequence[Group], partners: Sequence[Group]) -> None:
    """Make sure that all who are named as training partners taught an ego.

    Raises:
        UserError: one did not.
    """
    for partner in partners:
        if not any(has_met(ego, partner) for ego in egos):
            problem = f"{partner.label} has members that trained none of the egos"
            raise UserError("--met", problem, "hold them out by --with, or name those that did: PATH:1,3")


def _check_members(ego: Group, partner: Group) -> None:
    own = _gather_digests(ego.lineages)
    met = frozenset[str]().union(*(one.digests for one in ego.partners))
    beside = _gather_digests(ego.partners)
    for player in partner.players:
        if player.digest in own:
            raise UserError(player.source, f"member {player.member} is the ego {ego.label} itself", _OTHERS)
        if player.digest in beside:
            what = "a training partner of" if player.digest in met else "of a population that trained"
            raise UserError(player.source, f"member {player.member} is {what} the ego {ego.label}", _OTHERS)
    if _gather_digests(partner.lineages) & (own | beside):
        problem = f"is of a population that holds members of the ego {ego.label} or of those that trained it"
        raise UserError(partner.label, problem, _OTHERS)
    theirs = _gather_digests(partner.partners)
    if theirs & own:
        raise UserError(partner.label, f"was trained with the ego {ego.label} itself", _OTHERS)
    if theirs & beside:
        raise UserError(partner.label, f"was trained with members that trained the ego {ego.label} too", _OTHERS)


def _gather_digests(lineages: Sequence[Lineage]) -> frozenset[str]:
    return frozenset[str]().union(*(one.known for one in lineages))


def _check_lineages(ego: Group, partner: Group) -> None:
    for theirs, has in _list_origins(partner, "has", "was trained with"):
        for ours, learned in _list_origins(ego, "is itself of", "is trained with"):
            if not ours.is_related(theirs):
                continue
            if people := ", ".join(sorted(map(str, theirs.people or ours.people))):
                problem = (
                    f"{has} clones of people ({people}) of whom the ego {ego.label} or its teachers are clones too"
                )
                raise UserError(partner.label, problem, "hold out clones of the other half")
            which = f"which the ego {ego.label} {learned}"
            if ours.method != theirs.method:
                which = f"which starts from the same weights as {ours}, {which}"
            raise UserError(partner.label, f"{has} {theirs}, {which}", "hold out another seed")


def _list_origins(group: Group, own: str, met: str) -> Iterator[tuple[Lineage, str]]:
    """Each lineage with the words for it."""
    yield from ((one, own) for one in group.lineages)
    yield from ((one, met) for one in group.partners)
