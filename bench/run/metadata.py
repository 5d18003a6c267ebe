"""What a run writes down about its arm: where it stands on the table, and how it was verified, as
the rig's files say.

What a run writes down about itself before it starts: versions, machine, calibration, items under
test, the command.
"""

from __future__ import annotations

import hashlib
import json
import platform
import shlex
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from bench import __version__
from bench.record.writer import Store
from bench.results.verdicts import VERIFICATION_FACT
from bench.rig.arm_files import as_dict
from bench.rig.loading import LoadedRig
from detector.protocol import Detector
from instruments.clock import wall_time

FRAME_FACT = "arm frame"


def write_arm_facts(store: Store, rig: LoadedRig) -> None:
    """The rig's table frame and verification, where it names them, into the run's store."""
    if rig.frame is not None:
        frame = rig.frame
        figures = {"residual_mm": frame.residual_mm, "residuals_mm": frame.residuals_mm}
        where = {"om": frame.world_from_arm.om.tolist(), "T": frame.world_from_arm.T.tolist()}
        head = {
            "file": rig.rig.arm.frame,
            "made": frame.made.isoformat(),
            "serial_number": frame.serial_number,
        }
        store.fact(FRAME_FACT, {**head, **figures, **where})
    if rig.verification is not None:
        store.fact(VERIFICATION_FACT, as_dict(rig.verification))


LIBRARIES = ("numpy", "opencv-python-headless", "scipy", "pymodbus", "pyserial")


def write_facts(
    store: Store, facts: Mapping[str, Any], detectors: Sequence[Detector], calibration: Path
) -> None:
    """Everything that holds for the whole run, into its store."""
    everything = {
        **facts,
        "detectors": [detector.name for detector in detectors],
        "items": {detector.name: item(detector) for detector in detectors},
        "calibration_sha256": hashlib.sha256(calibration.read_bytes()).hexdigest(),
        "versions": versions(),
        "commit": commit(Path(__file__).resolve().parents[2] / ".git"),
        "command": shlex.join(["teatbench", *sys.argv[1:]]),
        "wall_started": wall_time().isoformat(timespec="seconds"),
    }
    with store.step():
        for key, value in everything.items():
            store.fact(key, value)


def item(detector: Detector) -> dict[str, str]:
    """The item under test: name, version, a hash over its configuration, and the configuration."""
    parameters = json.dumps(dict(detector.parameters), sort_keys=True, default=str)
    digest = hashlib.sha256(f"{detector.name} {detector.version} {parameters}".encode()).hexdigest()
    return {
        "name": detector.name,
        "version": detector.version,
        "configuration SHA-256": digest,
        "configuration": parameters,
    }


def commit(git: Path) -> str | None:
    """The commit that the bench's own working copy is at, without changes not committed; None where
    it runs from no copy.
    """
    try:
        head = (git / "HEAD").read_text(encoding="ascii").strip()
        if not head.startswith("ref: "):
            return head
        name = head.removeprefix("ref: ")
        if (git / name).is_file():
            return (git / name).read_text(encoding="ascii").strip()
        packed = (git / "packed-refs").read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    return next((line.split()[0] for line in packed if line.endswith(f" {name}")), None)


def versions() -> dict[str, str]:
    """Of the bench, of Python, of the machine and of the libraries that figures depend on."""
    found = {
        "teatbench": __version__,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
    }
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found
