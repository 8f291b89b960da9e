"""Policies: anything that looks at a joint observation and answers with an action for each seat."""

from popgen.policies.base import Policy
from popgen.policies.feed_forward import FeedForwardPolicy
from popgen.policies.registry import POLICIES, build_policy
from popgen.policies.seating import Seating
from popgen.policies.simple import IdlePolicy, RandomPolicy

__all__ = ["POLICIES", "FeedForwardPolicy", "IdlePolicy", "Policy", "RandomPolicy", "Seating", "build_policy"]
