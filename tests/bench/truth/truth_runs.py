"""What the end-to-end tests of the truth share: a script over a few poses, the emulated rig with
more lines, and what a run left.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.cli.main import main
from bench.record.reader import RunRecord, read_run
from bench.rig.loading import RIGS

HEAD = """title = "Carry"
detectors = ["thesis"]
visible_within_mm = 5.0
time_limit_s = 2.0

[bath]
set_point_c = 24.0
window_s = 30.0

[truth]
{truth}

[[requirements]]
kind = "error"
name = "error below 5 mm"
limit_mm = 5.0

[[trials]]
name = "map"
situation = "plane"
layout = "non-vertical"
set_up = "Teats as in the layout."
{poses}
"""
GRID = "grid = { x_mm = [-60.0, 60.0], y_mm = [-30.0, 30.0], step_mm = [40.0, 60.0] }"
CARRY = 'mode = "carry"\nregistration = "first"\ncheck_every = 3\n'


@dataclass(frozen=True)
class Done:
    run: RunRecord
    page: str
    recording: Path

    @property
    def off_mm(self) -> np.ndarray:
        """How far each truth lies from the exact end, (n, 3)."""
        rows = [row for trial in self.run.counted for row in trial.truth]
        return np.array(
            [np.array([r["x_mm"], r["y_mm"], r["z_mm"]]) - json.loads(r["exact_mm"]) for r in rows]
        )

    @property
    def regions(self) -> list[np.ndarray]:
        return [
            np.array(json.loads(row["covariance_mm2"]))
            for trial in self.run.counted
            for row in trial.truth
        ]


def script_in(folder: Path, truth: str, poses: str = GRID) -> Path:
    path = folder / "carry.toml"
    path.write_text(HEAD.format(truth=truth, poses=poses), encoding="utf-8")
    return path


def rig_in(folder: Path, *, arm: str = "", emulation: str = "") -> Path:
    text = (RIGS / "emulated.toml").read_text(encoding="utf-8")
    assert "[arm]\n" in text
    (folder / "calibration.toml").write_text(
        (RIGS / "calibration.toml").read_text(encoding="utf-8"), encoding="utf-8"
    )
    path = folder / "rig.toml"
    path.write_text(
        text.replace("[arm]\n", f"[arm]\n{arm}\n") + f"\n[emulation]\n{emulation}\n",
        encoding="utf-8",
    )
    return path


def done(rig: Path, script: Path, folder: Path) -> Done:
    recording = folder / "recording"
    main(
        [
            "run",
            str(script),
            "--rig",
            str(rig),
            "--out",
            str(folder / "runs"),
            "--record",
            str(recording),
        ]
    )
    (run,) = (folder / "runs").iterdir()
    return Done(
        read_run(run), (run / "report" / "index.html").read_text(encoding="utf-8"), recording
    )
