"""Playing: who sits where, rollouts, episodes, partners' strength."""
