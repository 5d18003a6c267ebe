"""Detectors in processes of their own, of every manner, as short programs in Python."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from detector.calibration import Calibration
from detector.external import ExternalDetector, ProcessLimits
from detector.external.serve import Pictures
from detector.protocol import Detection, DetectionFailure
from detector.registry import GROUP
from tests.conftest import ROOT

Start = Callable[..., ExternalDetector]
PICTURES = Pictures(
    np.full((8, 9), 7, np.uint8),
    np.zeros((8, 9), np.uint8),
    None,
    np.full((3, 4), 305.15),
    np.array([[np.nan, 1076.3]]),
    np.array([[0, 10763]], np.uint16),
)

HEAD = """\
import json, os, subprocess, sys, time
def say(thing):
    print(json.dumps(thing), flush=True)
"""
NO_TEATS = 'say({"frame": asked["frame"], "teats": []})'


def answering(what: str, ready: str = 'say({"ready": True})') -> str:
    """A child that does ``what`` for each question, with ``asked`` the question."""
    body = "\n".join(f"    {line}" for line in what.splitlines())
    return f"{HEAD}\n{ready}\nfor line in sys.stdin:\n    asked = json.loads(line)\n{body}\n"


GOOD = answering('say({"frame": asked["frame"], "teats": [{"world_mm": [1, 2, 3]}], "hidden": 1})')


def child(folder: Path, program: str, **limits: float | None) -> ExternalDetector:
    """A detector that runs ``program``."""
    path = folder / "program.py"
    path.write_text(program, encoding="utf-8")
    command, allowed = [sys.executable, str(path)], ProcessLimits(**limits)  # type: ignore[arg-type]
    return ExternalDetector("mine", command, time.perf_counter, limits=allowed)


def installed(folder: Path, name: str, code: str, entry_points: str) -> str:
    """A package with detectors, installed into ``folder``; the PYTHONPATH that finds it."""
    info = folder / f"{name}-1.dist-info"
    info.mkdir()
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n"
    (folder / f"{name}.py").write_text(code, encoding="utf-8")
    (info / "METADATA").write_text(metadata, encoding="utf-8")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{entry_points}\n", encoding="utf-8")
    return os.pathsep.join([str(folder), str(ROOT)])


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    made: list[ExternalDetector] = []

    def begin(program: str, **limits: float | None) -> ExternalDetector:
        made.append(child(tmp_path, program, **limits))
        return made[-1]

    yield begin
    for detector in made:
        detector.close()


def failure(detector: ExternalDetector, calibration: Calibration) -> DetectionFailure:
    with pytest.raises(DetectionFailure) as caught:
        ask(detector, calibration)
    return caught.value


def ask(detector: ExternalDetector, calibration: Calibration) -> Detection:
    detector.prepare(PICTURES, calibration)
    return detector.detect(PICTURES, calibration)
