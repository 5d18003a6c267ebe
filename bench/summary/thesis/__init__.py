"""The thesis's published figures and what a report says of them. Lowest first: `figures` < `situations`, `plane`, `picking`, `rig` <
`chapter`."""

from bench.summary.thesis.chapter import elsewhere_table, published_counts, thesis_chapter
from bench.summary.thesis.figures import Thesis, thesis
from bench.summary.thesis.picking import components_table, first_test_table, second_test_table

__all__ = [
    "Thesis",
    "components_table",
    "elsewhere_table",
    "first_test_table",
    "published_counts",
    "second_test_table",
    "thesis",
    "thesis_chapter",
]
