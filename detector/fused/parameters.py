"""What the fused detector knows of teats and rigs, and how much must speak for a teat."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from detector.outline.prior import Prior


@dataclass(frozen=True, slots=True)
class Parameters:
    """Prior knowledge of teats and rigs, and how much must speak for a teat.

    Edge settings were tuned by hand on path-traced frames and situations of seeds below 400; seeds
    from 400 on measure (but for one false teat: docs/detectors.md).
    """

    prior: Prior = dataclasses.field(default_factory=Prior)
    most_nominations: int = 20
    most_bars: int = 8
    starts_per_nomination: int = 4
    first_starts: int = 12  # are enough where they lead to all teats of an udder
    most_starts: int = 48
    more_bar_starts: int = 4  # of bars without a clear end, which others crowd out
    most_fits: int = 36
    most_bridging: int = 3  # fits that may have bridged two
    most_shifted: int = 5  # and whose ends may be too high or low
    most_shapes: int = 6  # fits that are tried again as short teats of any shape
    most_unsure: int = 4  # fits that aren't accepted and begin again from beside
    # what a short stretch of an outline has in common (paint, shadow, sampling): a share of how the
    # stretches' means scatter about the fitted outline, and of how unlike the lines' light is
    stretch_share: float = 0.15
    stretch_unlike_share: float = 0.34
    # how wrong the correction for the fall of brightness towards the limb may be: as a share of it,
    # a part of the outline; as a share of what each line's own would change. And of the correction,
    # a part and a stretch, where it is decided whether there is a teat.
    limb_share: float = 0.485
    unlike_light_share: float = 0.5
    # how much less sure an end is along its axis, of which nothing is seen
    unseen_end_sd_mm: float = 1.2
    # sd of the disparity where a calibration states no uncertainty: what a frame's thermal outlines
    # leave unknown on the thesis's rig
    calibration_px: float = 0.35
    calibration_focal: float = 0.0007  # and of a focal length, as a share of it
    thermal_noise_px: float = 0.04  # of a frame's thermal outlines together, columns, sensor px
