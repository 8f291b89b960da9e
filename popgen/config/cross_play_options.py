"""Options of cross-play that every objective with lambda_XP has."""

from __future__ import annotations

from typing import Annotated

from popgen.config.schema import AddedLater, Number, Schema, Weight


class CrossPlayOptions(Schema):
    """A bound of its advantages, and a constraint in the place of a weight (`popgen.losses.policy_losses`); ours."""

    xp_clip: Weight = 0.0
    """Bound of cross-play advantages, in units of self-play's spread; 0: none."""
    xp_limit: Number | None = None
    """A score: cross-play with a partner is pressed down until it is there, by a multiplier of lambda_XP; null: always.
    """
    multiplier_step: Weight = 0.5
    """Step of that multiplier, which stays in [0, 1], each time that real scores with the partner arrive: for
    cross-play as good as self-play. Above 1 where scores cannot go far below the limit, as beside 0 dishes."""


class PaidCrossPlayOptions(CrossPlayOptions):
    """A floor too, where the environment or its exact simulation pays for cross-play (XPM-WM imagines its reward)."""

    xp_floor: Annotated[Number | None, AddedLater] = None
    """Least reward of a step that cross-play counts, in training: doing more harm gains nothing, and a task that is
    left counts so for each step that it still had; null: rewards as they are."""
