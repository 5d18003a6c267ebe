"""Pixels as GenICam cameras send them, to arrays.

EMVA, Pixel Format Naming Convention 2.4 ("p": one little-endian bit stream, pixel i at bit i x
bits); AIA, GigE Vision 2.0 ("Packed": two pixels in three bytes, upper eight bits in the outer
bytes, the rest in the middle one, the first pixel's in its low half). Lines have no gap but the
leader's x padding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.camera.frame import Pixels

Bytes = NDArray[np.uint8]
Decoder = Callable[[Bytes, int], NDArray[Any]]


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """``stored_bits`` a pixel on the wire, ``bits`` of signal; ``decode`` gives a line's values."""

    name: str
    code: int
    stored_bits: int
    bits: int
    decode: Decoder
    channels: int = 1
    to_bgr: int | None = None  # OpenCV's code for what isn't grey yet


def _plain(kind: str) -> Decoder:
    """Little-endian values of a type of numpy's."""
    dtype = np.dtype(kind)
    return lambda data, n: np.frombuffer(data, dtype, n).astype(dtype.newbyteorder("="))


def _bit_stream(bits: int) -> Decoder:
    """The "p" formats: pixel i starts at bit i x ``bits``, least significant first."""

    def decode(data: Bytes, count: int) -> NDArray[np.uint16]:
        start = np.arange(count) * bits
        padded = np.concatenate([data, np.zeros(2, dtype=np.uint8)]).astype(np.uint32)
        at = start >> 3
        word = padded[at] | padded[at + 1] << 8 | padded[at + 2] << 16
        return np.asarray(word >> (start & 7) & ((1 << bits) - 1), dtype=np.uint16)

    return decode


def _packed(bits: int) -> Decoder:
    """ "Packed": upper 8 bits of each pixel outside, ``bits - 8`` lower ones in the middle byte."""
    low = (1 << (bits - 8)) - 1

    def decode(data: Bytes, count: int) -> NDArray[np.uint16]:
        triples = np.zeros((-(-count // 2), 3), dtype=np.uint16)
        triples.flat[: len(data)] = data  # the last one may lack its third byte
        first, middle, second = triples.T
        pair = first << (bits - 8) | middle & low, second << (bits - 8) | middle >> 4 & low
        return np.column_stack(pair).reshape(-1)[:count]

    return decode


_bytes8, _words16, _floats32 = _plain("u1"), _plain("<u2"), _plain("<f4")
FORMATS: tuple[PixelFormat, ...] = (
    PixelFormat("Mono8", 0x01080001, 8, 8, _bytes8),
    PixelFormat("Mono10", 0x01100003, 16, 10, _words16),
    PixelFormat("Mono12", 0x01100005, 16, 12, _words16),
    PixelFormat("Mono14", 0x01100025, 16, 14, _words16),
    PixelFormat("Mono16", 0x01100007, 16, 16, _words16),
    PixelFormat("Mono10Packed", 0x010C0004, 12, 10, _packed(10)),
    PixelFormat("Mono12Packed", 0x010C0006, 12, 12, _packed(12)),
    PixelFormat("Mono10p", 0x010A0046, 10, 10, _bit_stream(10)),
    PixelFormat("Mono12p", 0x010C0047, 12, 12, _bit_stream(12)),
    PixelFormat("Coord3D_C16", 0x011000B8, 16, 16, _words16),
    PixelFormat("Coord3D_C32f", 0x012000BF, 32, 32, _floats32),
    PixelFormat("Confidence8", 0x010800C6, 8, 8, _bytes8),
    PixelFormat("Confidence16", 0x011000C7, 16, 16, _words16),
    PixelFormat("RGB8", 0x02180014, 24, 8, _bytes8, 3, cv2.COLOR_RGB2BGR),
    PixelFormat("BGR8", 0x02180015, 24, 8, _bytes8, 3),
    # OpenCV names a mosaic by its second row's second and third pixel, the PFNC by its first two
    PixelFormat("BayerGR8", 0x01080008, 8, 8, _bytes8, 1, cv2.COLOR_BayerGB2BGR),
    PixelFormat("BayerRG8", 0x01080009, 8, 8, _bytes8, 1, cv2.COLOR_BayerBG2BGR),
    PixelFormat("BayerGB8", 0x0108000A, 8, 8, _bytes8, 1, cv2.COLOR_BayerGR2BGR),
    PixelFormat("BayerBG8", 0x0108000B, 8, 8, _bytes8, 1, cv2.COLOR_BayerRG2BGR),
)
BY_CODE = {known.code: known for known in FORMATS}


def unpack(
    data: bytes, code: int, width: int, height: int, x_padding: int = 0
) -> tuple[Pixels, int]:
    """Pixels (h, w), or (h, w, 3) blue-green-red, and their bits, of a payload with ``x_padding``
    bytes behind each line. Raises ValueError.
    """
    if (layout := BY_CODE.get(code)) is None:
        known = ", ".join(known.name for known in FORMATS)
        what = f"pixel format 0x{code:08X} is not one that is unpacked here"
        raise ValueError(f"{what}; choose one of {known}")
    if width < 1 or height < 1:
        raise ValueError(f"a picture of {width} x {height} pixels has none")
    # without padding all lines are one
    lines, per_line = (height, width) if x_padding else (1, width * height)
    step = -(-per_line * layout.stored_bits // 8) + x_padding  # the last byte is filled up
    raw = np.frombuffer(data, dtype=np.uint8)
    if len(raw) < (needed := step * lines - x_padding):
        what = f"{width} x {height} pixels of {layout.name} take {needed} bytes"
        raise ValueError(f"{what}, {len(raw)} came")
    count = per_line * layout.channels
    flat = [layout.decode(raw[y * step :][: step - x_padding], count) for y in range(lines)]
    image = np.concatenate(flat).reshape((height, width, layout.channels))
    if layout.to_bgr is not None:
        return np.asarray(cv2.cvtColor(image, layout.to_bgr), dtype=np.uint8), layout.bits
    return np.ascontiguousarray(image.squeeze(2) if layout.channels == 1 else image), layout.bits
