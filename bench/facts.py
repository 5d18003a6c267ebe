"""What a run writes down about itself before it starts: versions, machine, calibration, items under test, the command."""

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
from bench.store import Store
from detector.protocol import Detector
from instruments.clock import wall_time

LIBRARIES = ("numpy", "opencv-python-headless", "scipy", "pymodbus", "pyserial")


def write_facts(store: Store, facts: Mapping[str, Any], detectors: Sequence[Detector], calibration: Path) -> None:
    """Everything that holds for the whole run, into its store."""
    everything = {
        **facts,
        "detectors": [detector.name for detector in detectors],
        "items": {detector.name: item(detector) for detector in detectors},
        "calibration_sha256": hashlib.sha256(calibration.read_bytes()).hexdigest(),
        "versions": versions(),
        "command": shlex.join(["teatbench", *sys.argv[1:]]),
        "wall_started": wall_time().isoformat(timespec="seconds"),
    }
    for key, value in everything.items():
        store.fact(key, value)


def item(detector: Detector) -> dict[str, str]:
    """The item under test: name, version, a hash over its configuration, and the configuration."""
    parameters = json.dumps(dict(detector.parameters), sort_keys=True, default=str)
    digest = hashlib.sha256(f"{detector.name} {detector.version} {parameters}".encode()).hexdigest()
    return {"name": detector.name, "version": detector.version, "configuration SHA-256": digest, "configuration": parameters}


def versions() -> dict[str, str]:
    """Of the bench, of Python, of the machine and of the libraries that figures depend on."""
    found = {"teatbench": __version__, "python": platform.python_version(), "machine": f"{platform.system()} {platform.machine()}"}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found
