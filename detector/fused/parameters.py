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
    whole_end: float = 0.7  # share of the rounded end, below which a fit may have bridged two teats
    whole_end_both: float = 0.85  # where both sides are seen
    most_bridging: int = 3  # fits that may have bridged two
    most_shifted: int = 5  # and whose ends may be too high or low
    most_shapes: int = 6  # fits that are tried again as short teats of any shape
    least_side: float = 0.5  # share of the better side's outline that must be seen, a picture
    # of the rounded end's: in each picture; in both where the thermal one doesn't show it; where
    # both sides were followed up to it; that, closely and warm on both sides; where one is seen
    least_end: float = 0.4
    least_end_alone: float = 0.75
    least_end_followed: float = 0.57
    least_end_sure: float = 0.46
    least_end_one_sided: float = 0.45
    # of one that is less sure than this, of such a one that is warm all round, and in each picture
    least_end_unsure: float = 0.7
    least_end_unsure_warm: float = 0.6
    least_end_unsure_either: float = 0.6
    sure_one_sided_mm: float = 0.75
    greatest_thermal_px: float = 1.2  # how far the thermal outline may lie off, sensor pixels
    good_misfit_px: float = 0.15
    greatest_misfit_px: float = 0.35
    greatest_sd_mm: float = 7.5  # of an end, along the axis where it is the least sure
    # of the way from the surroundings' temperature to the warmest teat's
    least_warmth: float = 0.78
    # a gap that parts udders from half ends, and from all but those that all pictures show whole
    udder_mm: float = 200.0
    widest_udder_mm: float = 320.0
    # two teats' axes are never closer than this share of the sum of their radii
    overlap: float = 0.85
    # what a short stretch of an outline has in common (paint, shadow, sampling): a share of how the
    # stretches' means scatter about the fitted outline, and of how unlike the lines' light is
    stretch_share: float = 0.15
    stretch_unlike_share: float = 0.34
    # how wrong the correction for the fall of brightness towards the limb may be: as a share of it,
    # a part of the outline; as a share of what each line's own would change. And of the correction,
    # a part and a stretch, where it is decided whether there is a teat.
    limb_share: float = 0.485
    unlike_light_share: float = 0.5
    limb_shares_to_decide: tuple[float, float] = (0.55, 0.2)
    # how far an end may be from that of half an ellipsoid that fits its outline
    end_shape_sd_mm: float = 0.01
    # how much less sure an end is along its axis, of which nothing is seen
    unseen_end_sd_mm: float = 1.2
    # beside what a fit says of itself, by how far fits were off (path-traced frames; seed 7 from
    # member 1000 on). Along a teat: this share of how unlike half a ball its end is,
    end_unlike_share: float = 0.16
    end_misfit_mm_a_px2: float = 4.2  # of the square of its edges' misfit,
    # and of an end that optical pictures see in part and the thermal one not at all;
    end_in_part_sd_mm: float = 1.7
    end_led_to_sd_mm: float = 3.5  # and of one that its sides lead to,
    end_at_stop_sd_mm: float = 1.0  # or that is where both stop;
    # of an end that only the thermal picture shows;
    thermal_end_sd_mm: float = 2.0
    # along the line of sight, where one picture shows a side that the other doesn't: a px of
    # misfit; and no whole end either
    one_sees_mm_a_px: float = 10.0
    one_sees_in_part_sd_mm: float = 1.5
    unlike_sd_mm: float = 2.5  # or of both side and end one more than the other
    # and where no picture shows one of its sides and no other teat is before it
    alone_sd_mm: float = 0.8
    # across one with a side that an optical picture doesn't show, more where its sides are short
    one_side_sd_mm: float = 0.07
    short_one_side_sd_mm: float = 1.0
    neighbour_sd_mm: float = 0.3  # with one side, and a neighbour as warm;
    # with both, of which warmth shows one, where sides led to the end, and else
    covered_led_to_sd_mm: float = 0.4
    covered_sd_mm: float = 0.035
    short_sd_mm: float = 0.32  # anywhere, of one with short sides
    # sd of the disparity where a calibration states no uncertainty: what a frame's thermal outlines
    # leave unknown on the thesis's rig
    calibration_px: float = 0.35
    calibration_focal: float = 0.0007  # and of a focal length, as a share of it
    thermal_noise_px: float = 0.04  # of a frame's thermal outlines together, columns, sensor px
