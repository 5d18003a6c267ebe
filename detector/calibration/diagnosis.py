"""Names what is wrong with a calibration, from a board measured again and from touched points.

A wrong baseline or square scales all lengths; a column shift scales them with distance; a row shift
is an epipolar offset; a bent board has a raised middle; swapped cameras see points behind them. A
mark counts where significant and large enough.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, t

from detector.calibration.remeasure import Remeasured
from detector.calibration.uncertainty import Pair
from detector.calibration.world import WorldFit
from detector.geometry import Motion

# standard deviations of a normal distribution: several marks are looked at, and views are not quite
# independent
SIGNIFICANT = 4.0
SCALE_MATTERS = 0.002  # 2 mm a metre
ROWS_MATTER_PX = 0.2
BEND_MATTERS = 0.002  # of the board's diagonal
OUTLIER_RATIO = 2.5  # of a view's error to the median of all


@dataclass(frozen=True, slots=True)
class Finding:
    """``name`` for programs; ``sentence`` for people: what is seen, and its likely cause."""

    name: str
    sentence: str


def swapped(right_from_left: Motion) -> list[Finding]:
    """Whether what is called left stands on the right. The pair is taken to stand upright."""
    x = float((-right_from_left.R.T @ right_from_left.T)[0])
    if x > 0:
        return []
    said = (
        f"the right camera stands {-x:.0f} mm to the left of the left one: the cameras' names, or"
        " their cables, are swapped"
    )
    return [Finding("swapped cameras", said)]


def outlier_views(rms_px: Mapping[str, float], camera: str) -> list[Finding]:
    """Views that fit far worse than the others: listed, never dropped."""
    if len(rms_px) < 4:
        return []
    middle = float(np.median(list(rms_px.values())))
    return [
        Finding(
            "outlier view",
            f"view {name} of {camera} misses by {value:.2f} px, the median view by {middle:.2f} px:"
            " look at it, and decide",
        )
        for name, value in rms_px.items()
        if value > OUTLIER_RATIO * middle
    ]


def measured_again(again: Remeasured, pair: Pair) -> list[Finding]:
    """What a board measured again tells of the calibration, or of the board."""
    depths = np.array([view.depth_mm for view in again.views])
    if (depths <= 0).any():
        return [
            Finding(
                "swapped cameras",
                "the board is measured behind the cameras: left and right pictures are swapped",
            )
        ]
    return [*bent(again), *_scale(again, pair), *_rows(again)]


def against_the_arm(world: WorldFit) -> list[Finding]:
    """What the arm's points tell: its lengths are the reference."""
    off = world.scale - 1.0
    if not (abs(off) > SCALE_MATTERS and abs(off) > SIGNIFICANT * world.scale_sd):
        return []
    said = (
        f"lengths come out {abs(100 * off):.2f} % too {'short' if off > 0 else 'long'} against the"
        f" arm: the board's squares are {world.scale:.4f} of what its file says, or the baseline is"
    )
    return [Finding("wrong square size", said)]


def _significant(value: float, sd: float, again: Remeasured) -> bool:
    """Whether a mean over views differs from 0 at `SIGNIFICANT`, its sd from as many views."""
    freedom = len(again.views) - 1
    return freedom > 0 and abs(value) > float(t.isf(norm.sf(SIGNIFICANT), freedom)) * sd


def _scale(again: Remeasured, pair: Pair) -> list[Finding]:
    scale, sd = again.scale
    off = scale - 1.0
    if not (abs(off) > SCALE_MATTERS and _significant(off, sd, again)):
        return []
    said = f"the board is measured {100 * abs(off):.2f} % too {'large' if off > 0 else 'small'}"
    if again.grows_with_distance:
        # a disparity wrong by d px makes lengths at the distance Z wrong by d Z / (f B)
        depth_mm = float(np.mean([view.depth_mm for view in again.views]))
        shift_px = off * pair.right.fc[0] * float(np.linalg.norm(pair.right_from_left.T)) / depth_mm
        said += (
            f", the more the farther, as by {abs(shift_px):.2f} px between the columns of the two"
            " cameras"
        )
        return [
            Finding(
                "shifted columns",
                f"{said}: pixel centres counted from 0 in one and 0.5 in the other, or a lens that"
                " moved",
            )
        ]
    return [
        Finding(
            "wrong baseline",
            f"{said} at every distance: the baseline is wrong by that factor, or the board is not"
            " the one described",
        )
    ]


def _rows(again: Remeasured) -> list[Finding]:
    offset, sd = again.epipolar
    if not (abs(offset) > ROWS_MATTER_PX and _significant(offset, sd, again)):
        return []
    said = (
        f"the right camera's rows are {abs(offset):.2f} px too {'low' if offset > 0 else 'high'}"
        " against the left's"
    )
    return [
        Finding(
            "shifted rows",
            f"{said}: pixel centres counted from 0 in one and 0.5 in the other, or a lens or camera"
            " that moved",
        )
    ]


def bent(again: Remeasured) -> list[Finding]:
    """Whether the board's middle stands off its rim. What the calibration's lenses took up is
    missing, so what is left is real.
    """
    bend, sd = again.bend
    diagonal = float(np.hypot(*again.board.size_mm))
    if not (abs(bend) > BEND_MATTERS * diagonal and _significant(bend, sd, again)):
        return []
    return [
        Finding(
            "bent board",
            f"the board's middle stands {abs(bend):.2f} mm {'before' if bend > 0 else 'behind'} its"
            " rim: it is bent",
        )
    ]
