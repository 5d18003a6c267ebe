"""Which numbers a person may write or a program give."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import NamedTuple


class Bounds(NamedTuple):
    """Finite numbers within these bounds; ``what`` says which, for the message."""

    what: str
    above: float = -math.inf
    least: float = -math.inf
    below: float = math.inf
    whole: bool = False

    def has(self, value: object) -> bool:
        """Whether it is one of them; neither a text nor a truth is."""
        if isinstance(value, bool) or not isinstance(value, Integral if self.whole else Real):
            return False
        number = float(value)
        return self.above < number < self.below and number >= self.least


NUMBER = Bounds("a number")
WHOLE = Bounds("a whole number", whole=True)
ABOVE_0 = Bounds("a number above 0", above=0.0)
COUNT = Bounds("a whole number of 1 or more", least=1, whole=True)
FROM_0 = Bounds("a whole number of 0 or more", least=0, whole=True)
MARGIN = Bounds("a number of 0 or more", least=0.0)
MARGIN_OF_RATE = Bounds("a number of 0 or more, below 1", least=0.0, below=1.0)
SHARE = Bounds("a number between 0 and 1, both excluded", above=0.0, below=1.0)
SPEED = Bounds("a number of 1 or more, below 21", least=1.0, below=21.0)
