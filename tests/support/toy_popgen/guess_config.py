"""Schema and recipe of the method `guess`."""

from __future__ import annotations

from typing import Literal

from popgen.config.run_config import RunConfig
from popgen.config.schema import Batch, Positive, Schema, Weight
from popgen.methods.recipe import Recipe, because


class GuessConfig(Schema):
    """Random search for habits."""

    rounds: Positive = 8
    """Habits that are tried for each member."""
    episodes: Batch = 4
    """Episodes of self-play, and of cross-play with each partner in each seating, behind a habit's score."""
    lambda_xp: Weight = 0.5
    """Weight of the strongest partner's cross-play score, subtracted from self-play's (lambda_XP)."""


class GuessRun(RunConfig):
    """A run of random search."""

    method: Literal["guess"] = "guess"
    """Members that are the best of some random habits."""
    guess: GuessConfig = GuessConfig()
    """The search."""


RECIPES = {
    "laptop": Recipe(
        "laptop",
        "Seconds.",
        {"guess.rounds": 12},
        {"line/long": {"guess.rounds": because(30, "chance seldom meets on a long line")}},
    )
}
