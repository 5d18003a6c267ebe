"""Operators of each kind for tests, all willing: the console's person presses Enter, the script
says go, the hands are emulated.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import cache
from typing import Any

from bench.script.phantom import shipped_phantom
from instruments.clock import VirtualClock
from instruments.operators.console import Console
from instruments.operators.emulated import EmulatedOperator
from instruments.operators.operator import Arrangement, Operator
from instruments.operators.prompted import KINDS, ScriptedAnswers
from instruments.world.phantom import PlatePose
from instruments.world.world import World
from tests.instruments.world.scenes import renderer

CHECK_POINT_MM = (-190.0, 120.0, 15.0)


@cache
def arrangement(layout: str = "table-5-1", pose: PlatePose | None = None) -> Arrangement:
    return Arrangement(
        "ideal", shipped_phantom(layout), (), "Four teats as in table 5.1.", pose or PlatePose()
    )


def world() -> World:
    return World(VirtualClock(), 3, renderer)


def hands(of: World, *, hand_error_mm: float = 0.0, **options: Any) -> EmulatedOperator:
    at = CHECK_POINT_MM
    return EmulatedOperator(of, hand_error_mm=hand_error_mm, check_point_mm=at, **options)


def person(answers: str, out: io.StringIO | None = None) -> Console:
    """Somebody who types ``answers`` and then leaves."""
    return Console(io.StringIO(answers), out or io.StringIO(), VirtualClock())


def willing_script(emulated: EmulatedOperator | None = None) -> ScriptedAnswers:
    """Says go to everything; ``emulated`` hands follow."""
    otherwise = {**dict.fromkeys(KINDS, "go"), "coordinates": "1 2 3"}
    script = ScriptedAnswers([], otherwise, "answers.toml")
    script.hands = emulated
    return script


ANSWERERS: dict[str, Callable[[], Operator]] = {
    "console": lambda: person("\n" * 100),
    "script": willing_script,
    "emulated": lambda: hands(world()),
    "rehearsal": lambda: willing_script(hands(world())),
}
