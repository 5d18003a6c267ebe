"""The plots of a report: arrays in, SVG text out, the same bytes for the same arrays.

Without data a figure says "not measured"; numbers that are not finite are refused. Importing this
loads matplotlib (some tenths of a second), so importers do it late.
"""

from reports.figures.campaign import error_spreads, failure_map, rate_intervals
from reports.figures.course import (
    Slope,
    bath_curve,
    bath_sparkline,
    found_bars,
    latency_strip,
    slope_intervals,
)
from reports.figures.errors import (
    change_by_situation,
    change_scatter,
    error_drift,
    error_histogram,
    error_scatter,
    per_axis_errors,
    teat_boxes,
)
from reports.figures.plane import (
    MOST_GROUPS,
    ErrorGroup,
    TeatPlaces,
    error_map,
    error_maps,
    error_regions,
)
from reports.figures.sensitivity import precision_by_distance, residual_field
from reports.figures.situations import error_strips, outcome_bars

__all__ = [
    "MOST_GROUPS",
    "ErrorGroup",
    "Slope",
    "TeatPlaces",
    "bath_curve",
    "bath_sparkline",
    "change_by_situation",
    "change_scatter",
    "error_drift",
    "error_histogram",
    "error_map",
    "error_maps",
    "error_regions",
    "error_scatter",
    "error_spreads",
    "error_strips",
    "failure_map",
    "found_bars",
    "latency_strip",
    "outcome_bars",
    "per_axis_errors",
    "precision_by_distance",
    "rate_intervals",
    "residual_field",
    "slope_intervals",
    "teat_boxes",
]
