"""Evaluation: full episodes of any teams, cross-play figures, reports and plots."""
