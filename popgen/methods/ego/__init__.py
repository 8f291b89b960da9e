"""Ego agents: one agent trained beside a population, or by itself (hipt, fcp, br, sp, sp_aug)."""
