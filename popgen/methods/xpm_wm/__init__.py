"""XPM-WM: cross-play minimisation on trajectories imagined by a learned world model."""
