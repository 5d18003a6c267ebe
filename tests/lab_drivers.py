"""The package of docs/drivers.md, and one whose bath breaks its promises, installed into a folder."""

from __future__ import annotations

import importlib
import os
import re
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest

from bench.rig.loading import find_rig, load_rig
from tests.bench.small_cameras import write_calibration
from tests.conftest import ROOT

PAGE = ROOT / "docs" / "drivers.md"

# in the process that BROKEN_IN names it does what ``mode`` says; in another it works
KETTLE = """
import os
import threading

import numpy as np

import bench
from instruments import ArmPoint, MakersCalibration, MakersLens
from lab_drivers import Eyes, EyesEmulator, Probe, ProbeEmulator, Tank, TankEmulator

OVER = threading.Event()  # ends what hangs


class Kettle(Tank):
    def __init__(self, clock, url, mode=""):
        self.mode = mode if os.environ.get("BROKEN_IN", str(os.getpid())) == str(os.getpid()) else ""
        super().__init__(clock, url)

    def standby(self):
        if self.mode == "stays on":
            return
        if self.mode == "standby raises":
            raise RuntimeError("no licence")
        if self.mode == "standby hangs":
            OVER.wait(60.0)
        super().standby()


class Robot(Probe):
    touches = True

    def read(self):
        (tip_mm, axis), moving = self.ask("read"), self.ask("moves")
        return ArmPoint(np.array(tip_mm), np.array(axis), moving)

    def touch(self, point_mm, axis):
        self.ask("touch", *point_mm.tolist())

    def stop(self):
        self.ask("stop")


class RobotEmulator(ProbeEmulator):
    until_s = 0.0

    def moves(self):
        return not self.is_safe()

    def touch(self, *point_mm):
        self.until_s = self.clock.now() + 60.0

    def stop(self):
        self.until_s = 0.0

    def is_safe(self):
        return self.clock.now() >= self.until_s


class Calibrated(Eyes):
    def makers_calibration(self):
        found = bench.load_rig("calibrated.toml").calibration
        way = found.right_from_left
        left = MakersLens(found.left.image_size, found.left.matrix, found.left.kc)
        right = MakersLens(found.right.image_size, found.right.matrix, found.right.kc, way.R, way.T)
        return MakersCalibration({"left": left, "right": right}, {"stereo T1": 0.02})
"""
POINTS = """
[teatbench.baths]
kettle = kettle:Kettle
[teatbench.emulators.baths]
kettle = kettle:TankEmulator
[teatbench.cameras]
calibrated = kettle:Calibrated
[teatbench.emulators.cameras]
calibrated = kettle:EyesEmulator
"""


def blocks(language: str) -> list[str]:
    """The page's code, in order."""
    text = PAGE.read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def installed(folder: Path) -> Path:
    """Both packages as pip installs them; their folder belongs on the path."""
    project = tomllib.loads(blocks("toml")[0])["project"]
    groups = (
        f"[{group}]\n" + "\n".join(f"{name} = {place}" for name, place in points.items())
        for group, points in project["entry-points"].items()
    )
    _install(
        folder, project["name"], "lab_drivers", "\n\n".join(blocks("python")), "\n".join(groups)
    )
    _install(folder, "kettle", "kettle", KETTLE, POINTS)
    return folder


def _install(folder: Path, name: str, module: str, code: str, points: str) -> None:
    info = folder / f"{module}-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / f"{module}.py").write_text(code, encoding="utf-8")
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n"
    (info / "METADATA").write_text(metadata, encoding="utf-8")
    (info / "entry_points.txt").write_text(points, encoding="utf-8")


@contextmanager
def importable(folder: Path) -> Iterator[Path]:
    """Both packages, in this process and in those that it starts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(installed(folder)))
        patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(folder)]))  # of the guardian
        importlib.invalidate_caches()
        try:
            yield folder
        finally:
            for name in ("lab_drivers", "kettle"):
                sys.modules.pop(name, None)


@contextmanager
def world_of_few_pixels(folder: Path) -> Iterator[None]:
    """Drivers are checked in a world whose cameras have few pixels: most of a check of a camera is
    drawing.
    """
    rig = replace(load_rig(find_rig(None)), calibration_path=write_calibration(folder))
    with patch("bench.rig.opening.load_rig", lambda _: rig):
        yield
