"""Short runs on an emulated rig whose operator, stage and emulation are the test's choice, and whose
optical cameras have a quarter of the pixels along each axis.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bench.cli.main import main
from bench.record.reader import RunRecord, read_run
from bench.rig.loading import RIGS
from bench.run.events import Progress
from tests.bench.commands import words
from tests.bench.killed_runs import start
from tests.bench.small_cameras import write_calibration

SCRIPT = """
title = "Short"
detectors = ["thesis"]

[bath]
set_point_c = 33.0
window_s = 2.0
slope_k_per_min = 10.0
teat_slope_k_per_min = 10.0

[[requirements]]
kind = "bath_in_band"
name = "bath"
band_k = 0.5

[[trials]]
name = "place"
situation = "ideal"
layout = "table-5-1"
set_up = "Teats as in table 5.1."
poses = [{ x_mm = 12.0, y_mm = -8.0 }, { x_mm = -15.0, z_mm = 6.0, yaw_deg = 4.0 }, {}]
"""

ONE = SCRIPT.replace(
    "{ x_mm = 12.0, y_mm = -8.0 }, { x_mm = -15.0, z_mm = 6.0, yaw_deg = 4.0 }, {}", "{}"
)

RIG = """
name = "operated"
calibration = "calibration.toml"

[operator]
url = "{operator}"
{operator_more}

[arm]
url = "emulator:"
touches = {touches}
packets = 2
{check_point}

[bath]
url = "emulator:"
{bath}

{stage}

[cameras]
url = "emulator:"
settle_s = 0.1

[emulation]
bath_start_c = {start_c}
{emulation}
"""

BATH = 'profile = "julabo-presto"'
STAGE = '[stage]\nurl = "emulator:"'
CHECK_POINT = "check_point_mm = [-190.0, 120.0, 15.0]\ncheck_touches = 2"


def files(
    folder: Path,
    *,
    operator: str = "emulator:",
    operator_more: str = "",
    bath: str = BATH,
    start_c: float = 33.0,
    stage: str = "",
    touches: int = 1,
    check_point: str = "",
    emulation: str = "",
    script: str = SCRIPT,
    answers: str = "",
    whole: bool = False,
) -> list[str]:
    """Rig, script and answers in ``folder``; gives back the arguments of the command that runs
    them. ``whole``: with all pixels.
    """
    write_calibration(folder, whole=whole)
    (folder / "answers.txt").write_text(answers, encoding="utf-8")
    figures = {
        "operator": operator,
        "operator_more": operator_more,
        "bath": bath,
        "start_c": start_c,
        "stage": stage,
        "touches": touches,
        "check_point": check_point,
    }
    (folder / "rig.toml").write_text(RIG.format(**figures, emulation=emulation), encoding="utf-8")
    (folder / "script.toml").write_text(script, encoding="utf-8")
    places = (folder / name for name in ("script.toml", "rig.toml", "runs"))
    return words("run {} --rig {} --out {}", *places)


def run_of(folder: Path) -> RunRecord:
    """The one run in ``folder``."""
    (run,) = folder_with_runs(folder)
    return read_run(run)


def folder_with_runs(folder: Path) -> list[Path]:
    """The runs in ``folder``."""
    return [one for one in (folder / "runs").iterdir() if one.is_dir()]


def run(arguments: list[str], folder: Path) -> tuple[int, RunRecord]:
    """The command's exit code, and what it left: also a report, which takes most of its time."""
    return main(arguments), run_of(folder)


def record_of(folder: Path, progress: Progress | None = None, **more: Any) -> RunRecord:
    """What a run with these files leaves, without a report."""
    files(folder, **more)
    return read_run(start(folder, progress=progress)[0])


def shipped_rig(folder: Path, arm: str = "", emulation: str = "", *, whole: bool = False) -> Path:
    """The emulated rig as shipped, with more lines in two tables; ``whole``: with all pixels."""
    text = (RIGS / "emulated.toml").read_text(encoding="utf-8")
    assert "[arm]\n" in text
    assert "[emulation]" not in text
    write_calibration(folder, whole=whole)
    text = text.replace("[arm]\n", f"[arm]\n{arm}\n") + f"\n[emulation]\n{emulation}"
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    return folder / "rig.toml"


def texts(record: RunRecord, kind: str) -> list[str]:
    """Of the events of this kind, in their order."""
    return [event["text"] for event in record.events if event["kind"] == kind]
