"""How many examples a property test draws: few in each run, and as many times more by hand or
weekly as TEATBENCH_EXAMPLES says.
"""

from __future__ import annotations

import os


def examples(usual: int) -> int:
    """So many, or the multiple that is asked for."""
    return usual * int(os.environ.get("TEATBENCH_EXAMPLES", "1"))
