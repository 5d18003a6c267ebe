"""Whether a recording's calibration can be right: its pair sees depth, its pictures are of its size
and not exchanged, and what its truth calls visible has a place in them. Where not, nothing is
scored: every detector would be charged with what no detector can find. The truth of a run's trial
is checked in the same way.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress

import numpy as np

from bench.record.recording import FILES, Recording, RecordingError, TruthRow
from bench.results.cameras_agree import spread
from bench.results.working_volume import FARTHEST_MM, outside_picture
from bench.rig.frame_capture import StereoOrder
from detector.calibration import Calibration
from detector.calibration.gate import pair_faults
from detector.geometry import Array
from textfiles.text import plural

DOUBTS_FACT = "calibration can't be"
LOOKED_FACT = "calibration held against"  # of a recording: what it was looked for in
AGAIN = (
    "Put calibration.toml or the pictures right ('teatbench help calibration'): units in mm, left"
    " and right, the pictures' size, the world's axes of truth.csv. Then score the recording again."
)
NEAR = 0.05  # of the picture's size, by which an end that counts as visible may lie outside
LEAST_DISPARITY_PX = 2.0  # of less, one pixel is worth half of the distance


def doubts_of(recording: Recording, calibration: Calibration) -> tuple[str, ...]:
    """Why the calibration can't be of this recording, each part of a sentence; () where it may."""
    pair = (f"calibration.toml, [stereo] T: {w}" for w in pair_faults(calibration.right_from_left))
    found = [*pair, *_sizes(recording, calibration)]
    found = found or [*_exchanged(recording, calibration)]
    rows = [(frame, row) for frame, those in recording.truth.items() for row in those]
    return tuple(found or out_of_sight(rows, calibration))


def looked_at(recording: Recording) -> str:
    """What `doubts_of` holds a calibration against, in words; what it can't is "not checked"."""
    pictures = sum(len(recording.sizes(frame)) for frame in recording.frames)
    ends = sum(row.visible for rows in recording.truth.values() for row in rows)
    sizes = f"The calibration was held against the sizes of {plural(pictures, 'picture')}"
    if not ends:
        return f"{sizes}; not checked: whether visible ends have a place in them (none is known)"
    return f"{sizes} and the places of {plural(ends, 'visible end')}"


def _sizes(recording: Recording, calibration: Calibration) -> Iterator[str]:
    """Each camera whose pictures have another size, by its first one."""
    thermal, depth = calibration.thermal, calibration.depth
    sizes = calibration.left.image_size, calibration.right.image_size, thermal.image_size
    wanted = dict(zip(FILES, (*sizes, thermal.sensor_size), strict=False))
    wanted |= dict.fromkeys(FILES[4:], depth.image_size) if depth else {}
    other: dict[str, list[str]] = {}
    for frame in recording.frames:
        for name, size in recording.sizes(frame).items():
            if size != wanted.get(name, size):
                seen = "{} x {}".format(*size)
                other.setdefault(name, []).append(f"frames/{frame}/{name} is {seen} px")
    for name, frames in other.items():
        more = f" (and {len(frames) - 1} more)" if len(frames) > 1 else ""
        yield f"{frames[0]}{more}, the calibration is for {'{} x {}'.format(*wanted[name])}"


def _exchanged(recording: Recording, calibration: Calibration) -> Iterator[str]:
    """Of at most `MOST_POSES` frames, evenly spread, the first whose pictures are exchanged."""
    order, found = StereoOrder(calibration), dict[str, str]()
    for frame in sorted(looked := spread(recording.frames)):
        with suppress(RecordingError):  # raised again where the frame is asked for
            frames = recording.load(frame)
            if said := order.swapped(frames.left, frames.right):
                found[frame] = said
    for frame, said in [*found.items()][:1]:
        of = f" ({len(found)} of {plural(len(looked), 'frame')} looked at)"
        yield f"frames/{frame}/left.png is {said}{of}"


def out_of_sight(truth: Iterable[tuple[str, TruthRow]], calibration: Calibration) -> Iterator[str]:
    """Visible ends that the pictures can't show, or whose depth no disparity can tell; of rows with
    the name of their frame or trial.
    """
    rows = [(frame, row) for frame, row in truth if row.visible]
    if not rows:
        return
    points = np.array([row.xyz_mm for _, row in rows])
    cameras = calibration.left, calibration.right
    outside: Mapping[str, Array] = {
        name: outside_picture(pixels, camera.image_size, NEAR)
        for name, camera, pixels in zip(
            ("left", "right"), cameras, calibration.project(points), strict=True
        )
    }
    for name, out in outside.items():
        if out.any():
            frame, row = rows[int(np.flatnonzero(out)[0])]
            yield (
                f"{int(out.sum())} of {len(rows)} visible ends have no place in the {name} picture,"
                f" teat {row.teat} of frame {frame} for one"
            )
    per_px_mm = calibration.depth_per_disparity_px_mm(points)
    distance_mm = np.abs(calibration.world_from_right.inverse().apply(points)[:, 2])
    if (far := distance_mm > FARTHEST_MM).any():
        yield (
            f"{int(far.sum())} of {len(rows)} visible ends lie up to {distance_mm.max() / 1000:.0f}"
            " m from the cameras: are [world] T and truth.csv in mm?"
        )
    if (flat := distance_mm < LEAST_DISPARITY_PX * per_px_mm).any():
        yield (
            f"{int(flat.sum())} of {len(rows)} visible ends have a disparity of less than"
            f" {LEAST_DISPARITY_PX:g} px, which tells no depth"
        )
