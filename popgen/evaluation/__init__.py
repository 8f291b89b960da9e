"""Evaluation of populations: cross-play and self-sabotage."""
