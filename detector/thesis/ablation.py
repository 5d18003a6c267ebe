"""The published algorithm with one thing changed, each under a name of its own, so that what that thing is worth can be measured.

Published homographies (section 3.2.2) or the calibration's at the teats' plane; with and without optical refinement (sections 4.2, 4.3).
"""

from __future__ import annotations

from detector.thesis.detector import ThesisDetector
from detector.thesis.parameters import Parameters


def published_homography() -> ThesisDetector:
    """With the printed homographies: right at 1168 mm from the cameras, some 6 px off at the teats."""
    return ThesisDetector(Parameters(homographies="published"), "thesis-published-homography")


def no_refinement() -> ThesisDetector:
    """Without looking into the optical pictures: what the thermal picture and a homography give alone."""
    return ThesisDetector(Parameters(refinement=False), "thesis-no-refinement")


def published_homography_no_refinement() -> ThesisDetector:
    """Both: the printed homographies and nothing after them."""
    return ThesisDetector(Parameters(homographies="published", refinement=False), "thesis-published-homography-no-refinement")
