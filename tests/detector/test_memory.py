"""A detector that ships stays below 300 MiB in a process of its own, whatever it answers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.registry import available
from tests.conftest import ROOT
from tests.detector.conftest import Draw

MOST_MIB = 300
CALLS = 4
PROGRAM = """
import sys
from pathlib import Path
from detector.calibration import load_calibration
from detector.external.serve import read_pictures
from detector.registry import create

detector, calibration = create(sys.argv[1], []), load_calibration(Path(sys.argv[2]))
asked = {name: f"{sys.argv[3]}/{name}.png" for name in ("left", "right", "thermal")}
for _ in range(int(sys.argv[4])):
    print(len(detector.detect(read_pictures(asked), calibration).teats))
status = Path("/proc/self/status").read_text(encoding="ascii")
print(int(status.partition("VmHWM:")[2].split()[0]) // 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(
    sys.platform != "linux",
    reason="only Linux tells a program's own peak, without that of whoever started it",
)
# the frames that are drawn here have no depth
@pytest.mark.parametrize("name", [name for name in available([]) if name != "depth"])
def test_it_needs_little_memory(
    name: str, draw: Draw, teats_mm: NDArray[np.float64], rig_file: Path, tmp_path: Path
) -> None:
    frames = draw(teats_mm)
    for what, picture in (
        ("left", frames.left),
        ("right", frames.right),
        ("thermal", frames.thermal),
    ):
        assert picture is not None
        cv2.imwrite(str(tmp_path / f"{what}.png"), picture)
    command = [sys.executable, "-c", PROGRAM, name, str(rig_file), str(tmp_path), str(CALLS)]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=300
    )
    *found, peak_mib = (int(line) for line in done.stdout.split())
    assert found == [4] * CALLS
    assert peak_mib < MOST_MIB
