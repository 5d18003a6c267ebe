"""The other end of `detector.external` for any registered detector: ``python -m
detector.external.serve thesis``. Its prints go to standard error; standard output is the bench's.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.calibration import load_calibration
from detector.external.lines import PICTURES, answer_line, context_in, ready_line
from detector.protocol import WithContext
from detector.registry import BrokenDetectorError, UnknownDetectorError, create


@dataclass(frozen=True, slots=True, eq=False)
class Pictures:
    """A frame set as read from the files of a question."""

    left: NDArray[Any]
    right: NDArray[Any]
    thermal: NDArray[Any] | None = None
    thermal_k: NDArray[Any] | None = None
    depth_mm: NDArray[Any] | None = None
    amplitude: NDArray[Any] | None = None


def serve(name: str, questions: IO[bytes], answers: IO[bytes]) -> None:
    """Answer every line of ``questions`` on ``answers`` until they end."""
    detector = create(name)
    answers.write(ready_line(detector))
    answers.flush()
    for line in questions:
        asked = json.loads(line)
        calibration = load_calibration(Path(asked["calibration"]))
        context, pictures = context_in(asked), read_pictures(asked)
        if context and isinstance(detector, WithContext):
            detection = detector.detect_with(pictures, calibration, context)
        else:
            detection = detector.detect(pictures, calibration)
        answers.write(answer_line(asked["frame"], detection))
        answers.flush()


def read_pictures(asked: dict[str, str]) -> Pictures:
    """The pictures that a question names."""
    images: dict[str, NDArray[Any]] = {}
    for name in PICTURES:
        if name in asked:
            # through memory, for imread knows only the ASCII paths of Windows
            data = np.frombuffer(Path(asked[name]).read_bytes(), dtype=np.uint8)
            image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
            if image is None:
                raise ValueError(f"{asked[name]} is no picture")
            images[name] = image
    kelvin, tenths = images.get("thermal_radiometric"), images.get("depth")
    kelvin = None if kelvin is None else kelvin / 100.0
    depth_mm = None if tenths is None else np.where(tenths > 0, tenths / 10.0, np.nan)
    given = images["left"], images["right"], images.get("thermal"), kelvin
    return Pictures(*given, depth_mm, images.get("depth_amplitude"))


def main(arguments: list[str]) -> int:
    """Serve the detector named; 2 and a sentence where there is none."""
    if len(arguments) != 1:
        needs = "needs the name of one detector, such as thesis"
        sys.stderr.write(f"python -m detector.external.serve {needs}\n")
        return 2
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        serve(arguments[0], sys.stdin.buffer, answers)
    except (UnknownDetectorError, BrokenDetectorError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
