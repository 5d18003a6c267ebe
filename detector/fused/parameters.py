"""Every setting that changes an answer, with unit and origin."""

from __future__ import annotations

from dataclasses import dataclass, field

from detector.fused.fit import Prior


@dataclass(frozen=True, slots=True)
class Parameters:
    """Prior knowledge of teats and rigs, and how much must speak for a teat.

    Edge settings were tuned by hand on path-traced frames and situations of seeds below 400; seeds
    from 400 on measure (but for one false teat: docs/detectors.md).
    """

    nearest_mm: float = 850.0  # working volume, along the right camera's axis
    farthest_mm: float = 1900.0
    least_radius_mm: float = 7.5  # teats are 8 to 14 mm in radius
    greatest_radius_mm: float = 15.0
    greatest_lean: float = 0.5  # slope, some 27 degrees: teats lean by less than 20 either way
    prior: Prior = field(default_factory=Prior)
    most_nominations: int = 14
    most_bars: int = 5
    starts_per_nomination: int = 3
    most_starts: int = 26
    most_fits: int = 12
    whole_end: float = 0.7  # share of the rounded end, below which a fit may have bridged two teats
    whole_end_both: float = 0.85  # where both sides are seen
    most_doubts: int = 3
    least_side: float = 0.5  # share of the better side's outline that must be seen, a picture
    least_end: float = 0.4  # of the rounded end's; where the thermal picture doesn't show it,
    least_end_alone: float = 0.75  # where both sides were followed up to it,
    least_end_followed: float = 0.6  # and where only one side is seen,
    least_end_one_sided: float = 0.45
    # of one that is less sure than this; least_end_alone where it is warm all round
    least_end_unsure: float = 0.87
    sure_one_sided_mm: float = 0.75
    greatest_thermal_px: float = 1.2  # how far the thermal outline may lie off, sensor pixels
    good_misfit_px: float = 0.15
    greatest_misfit_px: float = 0.35
    greatest_sd_mm: float = 5.5  # of an end, along the axis where it is the least sure
    # of the way from the surroundings' temperature to the warmest teat's
    least_warmth: float = 0.78
    # two teats' axes are never closer than this share of the sum of their radii
    overlap: float = 0.85
    # what a short stretch of an outline has in common (paint, shadow, sampling) at the least,
    stretch_least_px: float = 0.012
    # and as a share of how the stretches' means scatter about the fitted outline
    stretch_share: float = 0.22
    # how wrong the correction for the fall of brightness towards the limb may be, as a share of it,
    # a part
    limb_share: float = 0.66
    limb_share_of_stretch: float = 0.25  # of the outline, and a stretch of it
    # how far an end may be from that of half an ellipsoid that fits its outline
    end_shape_sd_mm: float = 0.07
    # how much less sure an end is along its axis, of which nothing is seen
    unseen_end_sd_mm: float = 1.2
