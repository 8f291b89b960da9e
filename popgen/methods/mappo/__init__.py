"""MAPPO on RLlib, and the baselines on it."""
