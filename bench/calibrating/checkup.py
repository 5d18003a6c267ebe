"""An existing calibration against a board seen today: does it still hold?"""

from __future__ import annotations

from bench.calibrating.views import BoardViews
from bench.config import ConfigError
from detector.calibration import Part
from detector.calibration.diagnosis import Finding, measured_again
from detector.calibration.remeasure import Remeasured, remeasure
from detector.calibration.uncertainty import Pair
from detector.geometry import Motion


def check_pair(part: Part, views: BoardViews) -> tuple[Remeasured, tuple[Finding, ...]]:
    """The board measured with the pair, and what that tells. Raises ConfigError without a pair, or without a view of both."""
    if part.left is None or part.right is None or part.right_from_left is None:
        raise ConfigError.plain("the file holds no stereo pair ([cameras.left], [cameras.right], [stereo])")
    for camera, lens in (("left", part.left), ("right", part.right)):
        if views.image_size[camera] != lens.image_size:
            seen, known = ("{} x {}".format(*size) for size in (views.image_size[camera], lens.image_size))
            raise ConfigError.plain(f"the {camera} pictures are {seen} px, the calibration is for {known}: made for other cameras")
    pairs = views.pairs()
    if not pairs:
        raise ConfigError.plain("the board was found in no view of both cameras")
    pair = Pair(part.left, part.right, part.right_from_left, Motion.identity())
    again = remeasure(pair, views.board, pairs)
    return again, tuple(measured_again(again, pair))
