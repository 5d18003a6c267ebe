"""Whether the left and the right picture have changed places, told by the calibration.

Strategy: rectify both ways, as they are and exchanged, and see with which one the pictures fit at a
disparity that a thing in front of the cameras can have. Whole rows of edges are compared, not
single features: that works on smooth teats, in dim light and in noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.geometry import Array, Camera

NEAREST_MM, FARTHEST_MM = 300.0, 8000.0
REDUCED = 4  # rows and columns are compared at a fourth of the resolution
SIGMA_PX = 1.0  # of the reduced picture: noise goes, edges stay
LEAST_FIT = 0.05  # below, the pictures have nothing in common either way: no verdict
CLEARLY = 1.25  # the exchanged pictures must fit so much better

Grey = NDArray[np.uint8]
Maps = tuple[NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class Order:
    """How well the pictures fit as they are and exchanged: correlation of their edges at the best
    disparity, 0 to 1.
    """

    as_is: float
    exchanged: float

    @property
    def swapped(self) -> bool:
        """The pictures fit clearly better when exchanged."""
        return self.exchanged > LEAST_FIT and self.exchanged > CLEARLY * max(self.as_is, 0.0)


class StereoOrder:
    """Made once a calibration; then asked for each pair of pictures of the calibration's size."""

    def __init__(self, calibration: Calibration) -> None:
        left, right, motion = calibration.left, calibration.right, calibration.right_from_left
        K, D = zip(*(_matrices(camera) for camera in (left, right)), strict=True)
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
            _maps(
                K[0],
                D[0],
                np.asarray(R1, dtype=np.float64),
                scale @ np.asarray(P1[:, :3], dtype=np.float64),
                reduced,
            ),
            _maps(
                K[1],
                D[1],
                np.asarray(R2, dtype=np.float64),
                scale @ np.asarray(P2[:, :3], dtype=np.float64),
                reduced,
            ),
        )

    def judge(self, left: Grey, right: Grey) -> Order:
        """How well the pictures fit in either order."""
        return Order(self._fit(left, right), self._fit(right, left))

    def _fit(self, left: Grey, right: Grey) -> float:
        """Correlation (normalised, summed over all rows) of the pictures' edges at the best
        disparity of a thing in front.
        """
        edges = [
            self._edges(picture, maps)
            for picture, maps in zip((left, right), self._maps, strict=True)
        ]
        size = 2 * edges[0].shape[1]
        spectra = [np.fft.rfft(edge, size, axis=1) for edge in edges]
        correlation = np.fft.irfft(np.sum(spectra[0] * np.conj(spectra[1]), axis=0), size)
        norm = float(np.sqrt(np.sum(edges[0] ** 2) * np.sum(edges[1] ** 2)))
        nearest = min(int(np.ceil(self._span[1])), size // 2 - 1)
        shifts = np.arange(int(self._span[0]), nearest + 1) * int(self._sign)
        return float(correlation[shifts].max() / norm) if norm > 0 else 0.0

    def _edges(self, picture: Grey, maps: Maps) -> Array:
        small = cv2.resize(
            picture, None, fx=1.0 / REDUCED, fy=1.0 / REDUCED, interpolation=cv2.INTER_AREA
        )
        even = cv2.remap(
            small,
            (maps[0] - (REDUCED - 1) / 2) / REDUCED,
            (maps[1] - (REDUCED - 1) / 2) / REDUCED,
            cv2.INTER_LINEAR,
        )
        even = even.T if self._upright else even
        smooth = cv2.GaussianBlur(even.astype(np.float32), (0, 0), SIGMA_PX)
        gradient = np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1), dtype=np.float64)
        limit = 4.0 * float(np.sqrt(np.mean(gradient**2)))
        return np.clip(gradient, -limit, limit)  # one glaring edge must not outvote all others


def _matrices(camera: Camera) -> tuple[Array, Array]:
    K = np.array(
        [
            [camera.fc[0], camera.alpha_c * camera.fc[0], camera.cc[0]],
            [0.0, camera.fc[1], camera.cc[1]],
            [0.0, 0.0, 1.0],
        ]
    )
    return K, np.array(camera.kc)


def _maps(K: Array, D: Array, R: Array, P: Array, size: tuple[int, int]) -> Maps:
    x, y = cv2.initUndistortRectifyMap(K, D, R, P, size, cv2.CV_32FC1)
    return np.asarray(x, dtype=np.float32), np.asarray(y, dtype=np.float32)
