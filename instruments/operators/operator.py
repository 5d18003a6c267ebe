"""Who moves what no motor moves, and who touches the teat ends with the arm: what the bench asks of them.

A person at a terminal and the emulated operator keep this one protocol; the bench never asks which it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol


class OperatorAbort(Exception):  # noqa: N818 - a wish, not a fault
    """The operator wants the run to end, safely and now."""


@dataclass(frozen=True, slots=True)
class Arrangement:
    """How the phantom shall stand and what else shall be in the scene.

    ``layout`` names the teats' places, ``objects`` are keyword tables of the scene's other things, and
    ``instruction`` says the same to a person. ``teats`` is how many there are.
    """

    situation: str
    layout: str
    objects: tuple[Mapping[str, Any], ...]
    instruction: str
    teats: int


@dataclass(frozen=True, slots=True)
class Placed:
    """What was set up. ``visible[i]`` is False for a teat end that some camera can't see."""

    visible: tuple[bool, ...]


class Operator(Protocol):
    """Asked in this order: homing once, the check point, then for each trial set-up and touches; the check point once more."""

    def confirm_homing(self, instruction: str) -> None:
        """Return once the arm's stylus is on its peg. Raises OperatorAbort."""
        ...

    def touch_check_point(self, touch: int, of: int) -> None:
        """Return once the arm's tip rests in the divot of the check point and is held still, for the ``touch``-th time (from 1).

        The stylus leans another way each time, so that wrist and elbow swing. Raises OperatorAbort.
        """
        ...

    def set_up(self, arrangement: Arrangement) -> Placed:
        """Return once the scene stands as asked. Raises OperatorAbort."""
        ...

    def touch(self, teat: int, of: int) -> None:
        """Return once the arm's tip rests on the end of teat ``teat`` (from 1) and is held still. Raises OperatorAbort."""
        ...

    def release(self) -> None:
        """The reading is taken; the arm may be put away from the scene."""
        ...
