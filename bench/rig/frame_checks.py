"""Whether a frame set may be measured with: every fault that pictures and times show, by name, with
a sentence. Nothing is refused here. Checks that compare need the set before; the limits are the rig
file's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.rig.camera_model import Checks
from bench.rig.stereo_order import StereoOrder
from detector.calibration import Calibration
from instruments.camera.frame import FrameFault, FrameSet
from instruments.camera.quality import edge_blur_px, level_dn, missing_rows, saturated_share, spread

NEARLY_ALL = 0.995
# a thermal picture's grey says nothing of its light: only what is plainly nothing counts
THERMAL_BLACK_DN = 2
THERMAL_FULL = 0.9
RADIOMETRIC = "thermal_ck"
PARTS = {"left": "left", "right": "right", "thermal": "thermal", RADIOMETRIC: "thermal"}


@dataclass(frozen=True, slots=True)
class FrameProblem:
    """A fault of a frame set: what it is called, whose it is, and what was seen."""

    fault: FrameFault
    camera: str
    sentence: str

    def __str__(self) -> str:
        return f"{self.camera} camera: {self.fault}: {self.sentence}"


class FrameChecks:
    """The looks of one rig, with the set that was seen last. Without a calibration neither size nor
    order is looked at.

    ``flat`` False where nothing warm need stand before the thermal camera.
    """

    def __init__(
        self,
        checks: Checks,
        max_skew_s: float,
        calibration: Calibration | None,
        *,
        flat: bool = True,
    ) -> None:
        self._checks = checks
        self._max_skew_s = max_skew_s
        self._calibration = calibration
        self._flat = flat
        self._order: StereoOrder | None = None
        self._last: FrameSet | None = None

    def notice(self, frames: FrameSet) -> list[FrameProblem]:
        """All that is wrong with ``frames``; they are then the last that was seen."""
        last, self._last = self._last, frames
        found = [*self._late(frames), *self._sizes(frames)]
        for part, camera in PARTS.items():
            image = getattr(frames, part)
            if image is not None:
                found += self._picture(
                    part, camera, image, None if last is None else getattr(last, part)
                )
        found += self._thermal_flat(frames)
        if self._checks.swapped and not any(one.camera in ("left", "right") for one in found):
            found += self._swapped(frames)
        return list({(one.fault, one.camera): one for one in found}.values())

    def _late(self, frames: FrameSet) -> Iterator[FrameProblem]:
        if not frames.exposed_s:
            return
        latest = max(frames.exposed_s, key=lambda name: frames.exposed_s[name])
        skew_s = frames.exposed_s[latest] - min(frames.exposed_s.values())
        if skew_s > self._max_skew_s:
            said = (
                f"exposed {skew_s:.3f} s after the first of its set, limit {self._max_skew_s:g} s:"
                " what moves would be scored wrongly"
            )
            yield FrameProblem(FrameFault.LATE, latest, said)

    def _sizes(self, frames: FrameSet) -> Iterator[FrameProblem]:
        c = self._calibration
        if c is None:
            return
        wanted = {
            "left": c.left.image_size,
            "right": c.right.image_size,
            "thermal": c.thermal.image_size,
            RADIOMETRIC: c.thermal.sensor_size,
        }
        for part, (width, height) in wanted.items():
            image = getattr(frames, part)
            if image is not None and image.shape != (height, width):
                said = (
                    f"{image.shape[1]} x {image.shape[0]}, the calibration is for {width} x"
                    f" {height}"
                )
                yield FrameProblem(FrameFault.WRONG_SIZE, PARTS[part], said)

    def _picture(
        self, part: str, camera: str, image: NDArray[Any], last: NDArray[Any] | None
    ) -> Iterator[FrameProblem]:
        """The first that is wrong with one picture: a black one is not called frozen too."""
        looks = (
            self._black(part, image),
            self._saturated(part, image),
            self._frozen(image, last),
            self._half(image, last),
        )
        for fault, said in (*looks, self._out_of_focus(part, image)):
            if said:
                yield FrameProblem(fault, camera, said)
                return

    def _black(self, part: str, image: NDArray[Any]) -> tuple[FrameFault, str]:
        if part == RADIOMETRIC:
            return FrameFault.BLACK, "every count is zero" if not image.any() else ""
        limit = THERMAL_BLACK_DN if part == "thermal" else self._checks.black_dn
        level = level_dn(image, NEARLY_ALL)
        return FrameFault.BLACK, (
            f"99.5 % of it is no brighter than {level}, limit {limit}" if level <= limit else ""
        )

    def _saturated(self, part: str, image: NDArray[Any]) -> tuple[FrameFault, str]:
        limit = self._checks.saturated_share if part in ("left", "right") else THERMAL_FULL
        share = (
            float(np.mean(image == np.iinfo(image.dtype).max))
            if part == RADIOMETRIC
            else saturated_share(image)
        )
        return FrameFault.SATURATED, (
            f"{100 * share:.0f} % of it is white, limit {100 * limit:.0f} %"
            if share > limit
            else ""
        )

    def _frozen(self, image: NDArray[Any], last: NDArray[Any] | None) -> tuple[FrameFault, str]:
        same = self._checks.frozen and last is not None and np.array_equal(image, last)
        return FrameFault.FROZEN, "identical to the last frame, noise and all" if same else ""

    def _half(self, image: NDArray[Any], last: NDArray[Any] | None) -> tuple[FrameFault, str]:
        share = missing_rows(image, last if self._checks.frozen else None)
        many = share > self._checks.missing_rows_share
        return FrameFault.HALF, (
            f"{100 * share:.0f} % of its rows at an edge are empty or the last frame's"
            if many
            else ""
        )

    def _out_of_focus(self, part: str, image: NDArray[Any]) -> tuple[FrameFault, str]:
        reference_px = None if part == RADIOMETRIC else getattr(self._checks.focus_px, part)
        if reference_px is None:
            return FrameFault.OUT_OF_FOCUS, ""
        blur_px = edge_blur_px(image)
        if blur_px is None:
            return FrameFault.OUT_OF_FOCUS, "it has no edge that could be measured"
        limit_px = self._checks.focus_times * reference_px
        said = (
            f"its edges are blurred by {blur_px:.1f} px, limit {limit_px:.1f} px"
            f" ({self._checks.focus_times:g} times the reference)"
        )
        return FrameFault.OUT_OF_FOCUS, said if blur_px > limit_px else ""

    def _thermal_flat(self, frames: FrameSet) -> Iterator[FrameProblem]:
        if not self._flat:
            return
        if frames.thermal_ck is not None:
            span_k = spread(frames.thermal_ck) / 100.0
            if span_k < self._checks.flat_k:
                yield FrameProblem(
                    FrameFault.FLAT_FIELD,
                    "thermal",
                    f"all of it within {span_k:.2f} K, though something warm is there: its"
                    " shutter?",
                )
        elif frames.thermal is not None and spread(frames.thermal) < self._checks.flat_dn:
            yield FrameProblem(
                FrameFault.FLAT_FIELD,
                "thermal",
                f"all of it within {spread(frames.thermal):.0f} grey levels: its shutter?",
            )

    def _swapped(self, frames: FrameSet) -> Iterator[FrameProblem]:
        if self._calibration is None:
            return
        if self._order is None:
            self._order = StereoOrder(self._calibration)
        order = self._order.judge(frames.left, frames.right)
        if order.swapped:
            said = (
                f"exchanged with the right one: the calibration fits {order.exchanged:.2f} when"
                f" they are changed back, {order.as_is:.2f} as they are"
            )
            yield FrameProblem(FrameFault.SWAPPED, "left", said)
