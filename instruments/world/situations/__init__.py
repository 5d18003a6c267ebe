"""Eleven families of scenes: from a name and a seed to everything that a scene needs, the same for
the same two.

The thesis's six situations (section 5.2), and five more: ideal, low contrast, dim light, a teat
missing or hidden, and anything anywhere. Whether a camera sees an end is no part of a situation:
`Renderer.visible_ends` says so of its state.
"""

from instruments.world.situations.families import SITUATIONS, situation
from instruments.world.situations.situation import Situation, collisions, faults, hidden_ways

__all__ = ["SITUATIONS", "Situation", "collisions", "faults", "hidden_ways", "situation"]
