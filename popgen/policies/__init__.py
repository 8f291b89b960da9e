"""Policies that several methods share, the registry of policy kinds, and the adapter to overcooked_ai's agents."""
