"""Takes a frame set that may be measured with: checks each, takes it again where something is
wrong, and at last refuses. Every fault is an event of the record and counted, also one that the
next try cured. The limits are the rig file's; checks that compare need the set before.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.rig.model import CamerasTable
from detector.calibration import Calibration
from detector.geometry import Array
from instruments.camera.cameras import CAN_GIVE
from instruments.camera.closing import CLOSE_S
from instruments.camera.frame import FrameError, FrameFault, FrameSet, Grey
from instruments.camera.opencv import LONGEST_WAIT_S, OPEN_S
from instruments.camera.quality import edge_blur_px, level_dn, missing_rows, saturated_share, spread
from instruments.drivers.protocols import Cameras
from instruments.errors import DeviceError
from textfiles.text import full_stop, plural

# the longest that a frame set takes: each camera hangs, is closed and opened again
CAPTURE_S = len(CAN_GIVE) * (CLOSE_S + OPEN_S + LONGEST_WAIT_S)
NEAREST_MM, FARTHEST_MM = 300.0, 8000.0
REDUCED = 4  # rows and columns are compared at a fourth of the resolution
SIGMA_PX = 1.0  # of the reduced picture: noise goes, edges stay
LEAST_FIT = 0.05  # below, the pictures have nothing in common either way: no verdict
CLEARLY = 1.25  # the exchanged pictures must fit so much better

Maps = tuple[NDArray[np.float32], NDArray[np.float32]]


class StereoOrder:
    """Whether left and right are exchanged: rectified both ways, which rows of edges fit."""

    def __init__(self, calibration: Calibration) -> None:
        left, right, motion = calibration.left, calibration.right, calibration.right_from_left
        K, D = [left.matrix, right.matrix], [np.array(left.kc), np.array(right.kc)]
        size = left.image_size
        T = motion.T.reshape(3, 1)
        R1, R2, P1, P2, *_ = cv2.stereoRectify(
            K[0], D[0], K[1], D[1], size, motion.R, T, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0
        )
        self._upright = abs(P2[1, 3]) > abs(P2[0, 3])
        shift = float(P2[1 if self._upright else 0, 3])  # focal length times baseline
        self._sign = -1.0 if shift > 0 else 1.0
        self._span = tuple(abs(shift) / depth / REDUCED for depth in (FARTHEST_MM, NEAREST_MM))
        reduced = (size[0] // REDUCED, size[1] // REDUCED)
        scale = np.diag([1.0 / REDUCED, 1.0 / REDUCED, 1.0])
        self._maps: tuple[Maps, Maps] = (
            _maps(K[0], D[0], R1, scale @ P1[:, :3], reduced),
            _maps(K[1], D[1], R2, scale @ P2[:, :3], reduced),
        )

    def swapped(self, left: Grey, right: Grey) -> str:
        """What says that they fit clearly better when exchanged; empty where they don't."""
        as_is, exchanged = self._fit(left, right), self._fit(right, left)
        if exchanged <= LEAST_FIT or exchanged <= CLEARLY * max(as_is, 0.0):
            return ""
        fits = f"the calibration fits {exchanged:.2f} when they are changed back, {as_is:.2f} as"
        return f"exchanged with the right one: {fits} they are"

    def _fit(self, left: Grey, right: Grey) -> float:
        """Normalised correlation of the edges at the best disparity in front, 0 to 1."""
        edges = [*map(self._edges, (left, right), self._maps)]
        size = 2 * edges[0].shape[1]
        spectra = [np.fft.rfft(edge, size, axis=1) for edge in edges]
        correlation = np.fft.irfft(np.sum(spectra[0] * np.conj(spectra[1]), axis=0), size)
        norm = float(np.sqrt(np.sum(edges[0] ** 2) * np.sum(edges[1] ** 2)))
        nearest = min(int(np.ceil(self._span[1])), size // 2 - 1)
        shifts = np.arange(int(self._span[0]), nearest + 1) * int(self._sign)
        return float(correlation[shifts].max() / norm) if norm > 0 else 0.0

    def _edges(self, picture: Grey, maps: Maps) -> Array:
        by = 1.0 / REDUCED
        small = cv2.resize(picture, None, fx=by, fy=by, interpolation=cv2.INTER_AREA)
        x, y = ((of - (REDUCED - 1) / 2) / REDUCED for of in maps)
        even = cv2.remap(small, x, y, cv2.INTER_LINEAR)
        even = even.T if self._upright else even
        smooth = cv2.GaussianBlur(even.astype(np.float32), (0, 0), SIGMA_PX)
        gradient: Array = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1).astype(np.float64)
        limit = 4.0 * float(np.sqrt(np.mean(gradient**2)))
        return np.clip(gradient, -limit, limit)  # one strong edge must not outweigh all others


def _maps(K: Array, D: Array, R: Any, P: Any, size: tuple[int, int]) -> Maps:
    x, y = cv2.initUndistortRectifyMap(K, D, R, P, size, cv2.CV_32FC1)
    return np.asarray(x, dtype=np.float32), np.asarray(y, dtype=np.float32)


NEARLY_ALL = 0.995
# a thermal picture's grey says nothing of its light: only what is plainly nothing counts
THERMAL_BLACK_DN = 2
THERMAL_FULL = 0.9
RADIOMETRIC, DEPTH = "thermal_ck", "depth_dmm"
PARTS = {"left": "left", "right": "right", "thermal": "thermal", RADIOMETRIC: "thermal"}
PARTS[DEPTH] = "depth"
FRAMES_FACT = "frame checks"  # of a run: how many pictures each check looked at
BY_DRIVERS = (FrameFault.DROPPED, FrameFault.LOST_PACKETS)
CHECKED = tuple(fault.value for fault in FrameFault if fault not in BY_DRIVERS)


# by what is seen, where a rig file's name of the fault is one cause of several
CALLED: Mapping[FrameFault, str] = {FrameFault.FLAT_FIELD: "no contrast"}


@dataclass(frozen=True, slots=True)
class FrameProblem:
    """A fault of a frame set: what it is called, whose it is, and what was seen."""

    fault: FrameFault
    camera: str
    sentence: str

    def __str__(self) -> str:
        return f"{self.camera} camera: {CALLED.get(self.fault, self.fault)}: {self.sentence}"


class FrameChecks:
    """The checks of one rig, with the last set. Size and order need a calibration; ``flat`` False
    where nothing warm need be seen. ``looked``: how many pictures each check has looked at.
    """

    def __init__(
        self, table: CamerasTable, calibration: Calibration | None, *, flat: bool = True
    ) -> None:
        self._checks, self._max_skew_s = table.checks, table.max_skew_s
        self._calibration, self._flat = calibration, flat
        self._order: StereoOrder | None = None
        self._last: FrameSet | None = None
        self._found: list[FrameProblem] = []  # of the last
        self.looked: Counter[str] = Counter(dict.fromkeys(CHECKED, 0))

    def notice(self, frames: FrameSet) -> list[FrameProblem]:
        """All that is wrong with ``frames``; they are then the last that was seen."""
        if frames is self._last and not self._checks.frozen:  # a rehearsal's stand-in, once more
            return self._found
        last, self._last = self._last, frames
        found = [*self._late(frames), *self._sizes(frames)]
        for part, camera in PARTS.items():
            if getattr(frames, part) is not None:
                # the first alone: a black one is not called frozen too
                faults = self._picture(part, getattr(frames, part), getattr(last, part, None))
                problems = [FrameProblem(fault, camera, said) for fault, said in faults if said]
                found += problems[:1]
        found += self._thermal_flat(frames)
        if self._checks.swapped and not any(one.camera in ("left", "right") for one in found):
            found += self._swapped(frames)
        self._found = list({(one.fault, one.camera): one for one in found}.values())
        return self._found

    def _late(self, frames: FrameSet) -> Iterator[FrameProblem]:
        times_s = frames.exposed_s
        latest = max(times_s, key=lambda name: times_s[name], default="")
        skew_s = times_s[latest] - min(times_s.values()) if latest else 0.0
        self.looked[FrameFault.LATE] += len(times_s) if len(times_s) > 1 else 0
        if skew_s > self._max_skew_s:
            said = (
                f"exposed {skew_s:.3f} s after the first of its set, limit {self._max_skew_s:g} s:"
                " what moves would be scored wrongly"
            )
            yield FrameProblem(FrameFault.LATE, latest, said)

    def _sizes(self, frames: FrameSet) -> Iterator[FrameProblem]:
        for part, camera in PARTS.items() if self._calibration else ():
            of, image = getattr(self._calibration, camera), getattr(frames, part)
            if image is None or of is None:
                continue
            self.looked[FrameFault.WRONG_SIZE] += 1
            size = of.sensor_size if part == RADIOMETRIC else of.image_size
            if image.shape != size[::-1]:
                seen, wanted = ("{} x {}".format(*each) for each in (image.shape[::-1], size))
                said = f"{seen}, the calibration is for {wanted}"
                yield FrameProblem(FrameFault.WRONG_SIZE, camera, said)

    def _picture(
        self, part: str, image: NDArray[Any], last: NDArray[Any] | None
    ) -> Iterator[tuple[FrameFault, str]]:
        """Each fault of one picture, with what is wrong; empty where nothing is."""
        checks = self._checks
        if part in (RADIOMETRIC, DEPTH):
            black = "" if image.any() else "every count is zero"
            white = float(np.mean(image == np.iinfo(image.dtype).max))
        else:
            dark, level = checks.black_dn, level_dn(image, NEARLY_ALL)
            dark = THERMAL_BLACK_DN if part == "thermal" else dark
            said = f"99.5 % of it is no brighter than {level}, limit {dark}"
            black, white = said if level <= dark else "", saturated_share(image)
        full = checks.saturated_share if part in ("left", "right") else THERMAL_FULL
        same = checks.frozen and last is not None and np.array_equal(image, last)
        # what is too far or too dark for a depth camera may be rows at an edge
        share = 0.0 if part == DEPTH else missing_rows(image, last if checks.frozen else None)
        self.looked.update((FrameFault.BLACK, FrameFault.SATURATED))
        self.looked[FrameFault.FROZEN] += checks.frozen and last is not None
        self.looked[FrameFault.HALF] += part != DEPTH
        yield FrameFault.BLACK, black
        said = f"{100 * white:.0f} % of it is white, limit {100 * full:.0f} %"
        yield FrameFault.SATURATED, said if white > full else ""
        yield FrameFault.FROZEN, "identical to the last frame, noise and all" if same else ""
        said = f"{100 * share:.0f} % of its rows at an edge are empty or the last frame's"
        yield FrameFault.HALF, said if share > checks.missing_rows_share else ""
        yield FrameFault.OUT_OF_FOCUS, self._out_of_focus(part, image)

    def _out_of_focus(self, part: str, image: NDArray[Any]) -> str:
        times = self._checks.focus_times
        reference_px = getattr(self._checks.focus_px, part, None)
        if reference_px is None:
            return ""
        self.looked[FrameFault.OUT_OF_FOCUS] += 1
        blur_px, limit_px = edge_blur_px(image), times * reference_px
        if blur_px is None:
            return "it has no edge that could be measured"
        said = f"its edges are blurred by {blur_px:.1f} px, limit {limit_px:.1f} px"
        return f"{said} ({times:g} times the reference)" if blur_px > limit_px else ""

    def _thermal_flat(self, frames: FrameSet) -> Iterator[FrameProblem]:
        within = ""
        self.looked[FrameFault.FLAT_FIELD] += self._flat and frames.thermal is not None
        if frames.thermal_ck is not None:
            span_k = spread(frames.thermal_ck) / 100.0
            if span_k < self._checks.flat_k:
                within = f"{span_k:.2f} K"
        elif frames.thermal is not None and spread(frames.thermal) < self._checks.flat_dn:
            within = f"{spread(frames.thermal):.0f} grey levels"
        if within and self._flat:
            said = f"all of it within {within}: is the bath warm? If so, the shutter may be shut"
            yield FrameProblem(FrameFault.FLAT_FIELD, "thermal", said)

    def _swapped(self, frames: FrameSet) -> Iterator[FrameProblem]:
        if self._calibration and not self._order:
            self._order = StereoOrder(self._calibration)
        self.looked[FrameFault.SWAPPED] += 2 * bool(self._order)
        if self._order and (said := self._order.swapped(frames.left, frames.right)):
            yield FrameProblem(FrameFault.SWAPPED, "left", said)


EVENT = "camera"
HINTS: Mapping[FrameFault, str] = {
    FrameFault.DROPPED: "Look at the camera's cable and power.",
    FrameFault.LOST_PACKETS: "Lower the frame rate, or raise packet size and socket buffers.",
    FrameFault.LATE: "Use a common trigger, or allow more skew in the rig file if nothing moves.",
    FrameFault.WRONG_SIZE: (
        "Set the camera's resolution, or turn the picture, in the rig file; or calibrate anew."
    ),
    FrameFault.FROZEN: "Restart the camera.",
    FrameFault.BLACK: "Take the lens cap off, or switch the light on.",
    FrameFault.SATURATED: "Expose shorter, or dim the light.",
    FrameFault.HALF: "Look at the camera's cable; its link may be too slow.",
    FrameFault.FLAT_FIELD: (
        "See that the bath is warm and that the teats stand out ('teatbench bath read'). If they"
        " do, the camera corrects itself: let it wait longer between tries (retry_s)."
    ),
    FrameFault.OUT_OF_FOCUS: "Set the lens with 'teatbench camera focus'.",
    FrameFault.SWAPPED: "Exchange the left and the right camera's addresses in the rig file.",
}


@dataclass(eq=False)
class FrameTaker:
    """``wait`` lets time pass between tries, ``report`` records one; ``flat``, and ``looked`` at,
    as of `FrameChecks`.
    """

    cameras: Cameras
    table: CamerasTable
    calibration: Calibration | None
    wait: Callable[[float], None]
    report: Callable[[str, str], None]
    _: KW_ONLY
    flat: bool = True

    def __post_init__(self) -> None:
        recorded = self._recorded = self.table.recorded
        flat = self.flat and not recorded
        self._checks = FrameChecks(self.table, self.calibration, flat=flat)
        self._retries = 0 if recorded else self.table.retries
        self.counts: Counter[str] = Counter()
        self.looked = self._checks.looked

    def take(self) -> FrameSet:
        """A frame set without a fault. Raises DeviceError after the last try."""
        for left in range(self._retries, -1, -1):
            frames, noticed = self._try()
            if frames is not None and not noticed:
                return frames
            self.counts.update(f"{one.camera}: {one.fault}" for one in noticed)
            what = "; ".join(str(one) for one in noticed)
            more = f"Taken again; {left} {'try is' if left == 1 else 'tries are'} left"
            self.report(EVENT, f"{full_stop(what)} {more if left else 'Refused'}.")
            if left:
                self.wait(self.table.retry_s)
        raise _refused(noticed, self._retries + 1, self.cameras.identity)

    def look(self) -> None:
        """Check that the cameras give a usable set now, but not a recording. Raises as ``take``."""
        if self._recorded:
            return
        frames, noticed = self._try()
        if frames is None or noticed:
            raise _refused(noticed, 1, self.cameras.identity)

    def _try(self) -> tuple[FrameSet | None, Sequence[FrameProblem]]:
        try:
            frames = self.cameras.capture()
        except FrameError as error:
            return None, [FrameProblem(error.fault, error.camera, str(error))]
        for camera, count in frames.passed_over.items():
            self.counts[f"{camera}: {FrameFault.LOST_PACKETS}"] += count
            were = plural(count, "damaged frame", "was")
            said = f"{were} passed over; the next whole one was taken"
            self.report(EVENT, f"{camera} camera: {FrameFault.LOST_PACKETS}: {said}.")
        return frames, self._checks.notice(frames)


def _refused(noticed: Sequence[FrameProblem], tries: int, known: Mapping[str, str]) -> DeviceError:
    hints = dict.fromkeys(HINTS[one.fault] for one in noticed)
    seen = (f"{one} ({known.get(one.camera, 'unknown')})" for one in noticed)
    counted = "1 try" if tries == 1 else f"{tries} tries"
    what = f"no usable frame set in {counted}: {'; '.join(seen)}"
    return DeviceError("cameras", what, hint=" ".join(hints))
