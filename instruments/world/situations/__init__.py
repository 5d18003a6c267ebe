"""Eleven families of scenes: from a name and a seed to everything that a scene needs.

The thesis's six (section 5.2), and ideal, low contrast, dim light, a teat missing or hidden, and
anything anywhere.
"""

from instruments.world.situations.families import SITUATIONS, situation
from instruments.world.situations.situation import Situation, collisions, faults, hidden_ways

__all__ = ["SITUATIONS", "Situation", "collisions", "faults", "hidden_ways", "situation"]
