"""How the objective's weights change from update to update: pure functions of what an agent's learner has done."""

from __future__ import annotations

from popgen.losses.policy_losses import geometric, linear
from popgen.methods.xpm_wm.config import AgentConfig, DiscoveryConfig


def cross_play_weight(config: AgentConfig, updates: int) -> float:
    """lambda_XP after so many updates: rising from `lambda_start`, if that is less, to `lambda_xp` over `lambda_ramp`.

    Cross-play pressure must be there from the first update, or the member settles on its predecessor's convention; at
    full strength from the start it keeps self-play from starting at all.
    """
    start = min(config.lambda_start, config.lambda_xp)
    return linear(start, config.lambda_xp, updates, config.lambda_ramp)


def entropy_scale(config: AgentConfig, discovery: DiscoveryConfig, finding: int, playing: int) -> float:
    """Of the bonus: `entropy`, then falling to `found_entropy` over the updates since the dearest event was found, and
    to `entropy_end` over those since self-play has started, each within `entropy_ramp` and by the same factor in each.

    In units of the returns' range, which grows tenfold once dishes are delivered, advantages shrink: a scale that lets
    self-play start would then win over them, and the policy would get more random the better it plays.
    """
    scale, ramp = config.entropy, config.entropy_ramp
    if ramp and finding:
        scale = geometric(scale, min(discovery.found_entropy, scale), finding, ramp)
    if ramp and playing:
        scale = geometric(scale, min(config.entropy_end, scale), playing, ramp)
    return scale
