"""How often the interval of a comparison covers, and how often it lies within the margin, for
changes with long tails: simulated.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bench.scoring.comparison import upper_bound
from bench.scoring.errors import Floats

LIMIT_MM, MARGIN_MM = 5.0, 0.25
Draw = Callable[[np.random.Generator, int], Floats]


def _outliers(share: float, low_mm: float, high_mm: float, sd_mm: float = 0.2) -> Draw:
    return lambda rng, n: (
        rng.normal(0.0, sd_mm, n)
        + np.where(rng.random(n) < share, rng.uniform(low_mm, high_mm, n), 0.0)
    )


DRAWS: dict[str, Draw] = {
    "lognormal, median 0.37 mm, σ = 1": lambda rng, n: rng.lognormal(-1.0, 1.0, n),
    "difference of two lognormal errors, medians 0.25 mm, σ = 0.8": lambda rng, n: (
        rng.lognormal(-1.4, 0.8, n) - rng.lognormal(-1.4, 0.8, n)
    ),
    "normal, σ = 0.2 mm, and 5 % of poses worse by 2 to 6 mm": _outliers(0.05, 2.0, 6.0),
    "normal, σ = 0.2 mm, and 7 % of poses worse by 4 mm": _outliers(0.07, 4.0, 4.0),
    "none, but 5.05 % of poses worse by 5 mm": _outliers(0.0505, 5.0, 5.0, sd_mm=0.0),
}


def coverage(name: str, poses: int, runs: int) -> tuple[float, float, float, float]:
    """The changes' mean, the share of `runs` that cover it, their median width, and the share that
    shows less than the margin.
    """
    rng, draw = np.random.default_rng(poses), DRAWS[name]
    mean = float(np.clip(draw(rng, 2_000_000), -LIMIT_MM, LIMIT_MM).mean())
    drawn = [np.clip(draw(rng, poses), -LIMIT_MM, LIMIT_MM) for _ in range(runs)]
    spans = np.array(
        [
            (-upper_bound(-changes, LIMIT_MM, 0.975), upper_bound(changes, LIMIT_MM, 0.975))
            for changes in drawn
        ]
    )
    covers = (spans[:, 0] <= mean) & (mean <= spans[:, 1])
    return (
        mean,
        float(covers.mean()),
        float(np.median(np.diff(spans))),
        float((spans[:, 1] <= MARGIN_MM).mean()),
    )
