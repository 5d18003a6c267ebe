"""The job behind ``teatbench run`` for a sensitivity script: a run folder with what was used, and the report. Opens no instrument."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from bench.config import ConfigError, read_text
from bench.planning.offsets import LoadedOffsets, Outcome, is_offset_script, load_offsets, outcomes
from bench.rig import LoadedRig, read_calibration
from bench.store import SCRIPT, new_run_folder, write_synced
from bench.summary.offsets import offset_page, offset_verdict
from instruments.clock import wall_time
from reports.page import Verdict
from reports.render import write_report

CALIBRATION, REPORT = "calibration.toml", "report"


def is_offset_run(folder: Path) -> bool:
    """Whether ``folder`` is that of a sensitivity script's run."""
    return (folder / SCRIPT).is_file() and is_offset_script(folder / SCRIPT)


def run_offsets(rig: LoadedRig, path: Path, out: Path) -> Path:
    """Run the script at ``path`` on the rig's calibration; gives back the run's folder. Raises ConfigError."""
    loaded = load_offsets(path)
    outcomes(loaded, rig.calibration)  # what can't be computed is told before there is a folder
    files = {SCRIPT: loaded.text, "rig.toml": rig.text, CALIBRATION: read_text(rig.calibration_path)}
    if loaded.script.layout.endswith(".toml"):
        files[loaded.script.layout] = read_text(path.parent / loaded.script.layout)
    try:
        folder = new_run_folder(out, path.name.removesuffix(".toml"), wall_time())
        folder.mkdir(parents=True)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise ConfigError.plain(f"a run can't be kept in {out}: {error.strerror or error}. Name another folder with --out.") from error
    return folder


def report_offsets(folder: Path) -> tuple[Path, LoadedOffsets, tuple[Outcome, ...], Verdict]:
    """(Re)compute and (re)write the report of such a run; gives back the page's path. Raises ConfigError."""
    loaded = load_offsets(folder / SCRIPT)
    found = outcomes(loaded, read_calibration(folder / CALIBRATION))
    digest = hashlib.sha256((folder / CALIBRATION).read_bytes()).hexdigest()
    path = write_report(offset_page(loaded, found, digest), folder / REPORT)
    verdict = offset_verdict(loaded, found)
    write_synced(folder / REPORT / "run.json", _json(loaded, found, verdict, digest).encode())
    return path, loaded, found, verdict


def _json(loaded: LoadedOffsets, found: Sequence[Outcome], verdict: Verdict, calibration_sha256: str) -> str:
    rows = [
        {
            **one.offset.model_dump(),
            "directions": len(one.errors_mm),
            "least_mm": float(one.distances_mm.min()),
            "median_mm": one.median_mm,
            "most_mm": one.worst_mm,
            "most_along_axes_mm": one.most_mm.tolist(),
        }
        for one in found
    ]
    whole = {"title": loaded.script.title, "verdict": verdict, "limit_mm": loaded.script.limit_mm, "calibration_sha256": calibration_sha256}
    return json.dumps({**whole, "offsets": rows}, indent=1)
