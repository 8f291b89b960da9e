"""XPM-Sim: cross-play minimisation on trajectories of the exact simulator."""
