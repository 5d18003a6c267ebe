"""How much of what could be tried is tried in each run: few examples of a property test, and as many
times more by hand or weekly as TEATBENCH_EXAMPLES says; some cells of a table, and all weekly.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

import pytest


def examples(usual: int) -> int:
    """So many, or the multiple that is asked for."""
    return usual * int(os.environ.get("TEATBENCH_EXAMPLES", "1"))


def few(cases: Iterable[Any], every: int) -> list[Any]:
    """Cases for ``parametrize``; one of so many is tried in each run, the others weekly."""
    return [
        pytest.param(
            *(case if isinstance(case, tuple) else (case,)),
            marks=pytest.mark.weekly if place % every else (),
        )
        for place, case in enumerate(cases)
    ]
