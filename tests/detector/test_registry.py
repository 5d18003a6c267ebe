"""The table of detectors: cheap to list, exact about what is missing, with packages' own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from detector.calibration import Calibration
from detector.external.serve import Pictures
from detector.protocol import Context
from detector.registry import (
    GROUP,
    BrokenDetectorError,
    PluginDetector,
    UnknownDetectorError,
    available,
    broken,
    create,
)
from tests.detector.children import installed
from tests.waiting import PATIENCE_S

PACKAGE = """
import numpy
from detector.protocol import Detection
class Plain:
    def detect(self, frames, calibration):
        return Detection((), 4, "plain")
class Remembers(Plain):
    def detect_with(self, frames, calibration, context):
        return Detection((), 0, f"{context.hours_since_milking} h")
class Told(Plain):
    name, version, parameters = "whatever", "7", {"gain": 2}
    device, trained_on = "CUDA:0", {"ideal": [[0, 9]]}
ready = Told()
def made():
    return Told()
def fails():
    raise RuntimeError("no\\nlicence")
number = 5
class Leaves(Plain):
    def __init__(self):
        raise SystemExit("bye")
class Panics(Plain):
    def __init__(self):
        raise type("PanicException", (BaseException,), {})("index out of bounds")
class Speechless(Plain):
    def __init__(self):
        raise type("Speechless", (Exception,), {"__str__": lambda self: 1 / 0})()
class Odd(Plain):
    version = "1\\n2 \\ud800"
    parameters = {1: 2, "a": {3: 4, "b": numpy.eye(2)}, "c": {5}}
class Dreams(Plain):
    trained_on = ["ideal"]
class Round(Plain):
    parameters = {}
Round.parameters["me"] = Round.parameters
"""


@pytest.fixture
def plugs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, EntryPoint]:
    (tmp_path / "udders.py").write_text(PACKAGE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "udders", raising=False)
    values = "Plain Remembers Told ready made fails number Leaves Panics Speechless Odd Dreams Round nothing"
    return {value: EntryPoint(value.lower(), f"udders:{value}", GROUP) for value in values.split()}


def test_every_name_can_be_created_and_knows_itself() -> None:
    for name, description in available([]).items():
        assert create(name, []).name == name
        assert description
        assert "\n" not in description


def test_an_unknown_name_gets_the_nearest() -> None:
    with pytest.raises(UnknownDetectorError, match=r"did you mean 'thesis'\? There are: .*thesis"):
        create("tesis")
    with pytest.raises(UnknownDetectorError, match="no detector is called 'zzz'"):
        create("zzz")


def test_listing_loads_no_picture_library() -> None:
    heavy = "any(m in sys.modules for m in ('numpy', 'cv2', 'scipy'))"
    code = f"import sys; from detector.registry import available; available(); sys.exit({heavy})"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE_S)


NONE = np.zeros((1, 1), np.uint8)
PICTURES = Pictures(NONE, NONE)


@pytest.mark.parametrize("how", ["Told", "ready", "made"])
def test_what_packages_bring(plugs: dict[str, EntryPoint], rig: Calibration, how: str) -> None:
    detector = create(how.lower(), plugs.values())
    assert (detector.name, detector.version) == (how.lower(), "7")
    assert dict(detector.parameters) == {"gain": 2}
    assert isinstance(detector, PluginDetector)
    assert (detector.device, detector.trained_on) == ("CUDA:0", {"ideal": ((0, 9),)})
    assert detector.detect(PICTURES, rig).reason == "plain"


@pytest.mark.parametrize(("how", "says"), [("Plain", "plain"), ("Remembers", "7.5 h")])
def test_a_history_reaches_the_object_that_can_use_it(
    plugs: dict[str, EntryPoint], rig: Calibration, how: str, says: str
) -> None:
    detector = create(how.lower(), plugs.values())
    assert isinstance(detector, PluginDetector)
    assert detector.detect_with(PICTURES, rig, Context(7.5)).reason == says


def test_whatever_it_says_of_itself_can_be_kept_and_what_lacks_is_filled_in(
    plugs: dict[str, EntryPoint],
) -> None:
    """Names, versions and settings go into the record and into a hash."""
    plain = create("plain", plugs.values())
    assert (plain.name, plain.version, dict(plain.parameters)) == ("plain", "unknown", {})
    detector = create("odd", plugs.values())
    assert detector.version == "1 2 ?"
    assert detector.parameters == {"1": 2, "a": {"3": 4, "b": [[1.0, 0.0], [0.0, 1.0]]}, "c": "{5}"}
    json.dumps(detector.parameters, sort_keys=True)


@pytest.mark.parametrize(
    ("how", "note"),
    [
        ("fails", "RuntimeError: no licence"),
        ("number", "TypeError"),
        ("Leaves", "SystemExit: bye"),
        ("Panics", "PanicException: index out of bounds"),
        ("Speechless", "Speechless"),
        ("Dreams", 'ValueError: "trained_on" must be like'),
        ("Round", "ValueError: Circular reference"),
        ("nothing", "AttributeError"),
    ],
)
def test_a_broken_one_is_reported_by_name(
    plugs: dict[str, EntryPoint], how: str, note: str
) -> None:
    said = f"detector '{how.lower()}' of .*udders:{how}.* can't be loaded: .*{note}"
    with pytest.raises(BrokenDetectorError, match=said):
        create(how.lower(), plugs.values())
    assert note in broken(plugs.values())[how.lower()]
    assert "plain" not in broken(plugs.values())
    assert how.lower() in available(plugs.values())


def test_a_shipped_name_and_a_second_of_one_name_are_left_out(plugs: dict[str, EntryPoint]) -> None:
    shipped, second = (("thesis", "udders:Plain"), ("plain", "udders:Told"))
    given = [EntryPoint(*shipped, GROUP), plugs["Plain"], EntryPoint(*second, GROUP)]
    assert create("thesis", given).parameters["canny_sigma_px"] == 12.0
    assert create("plain", given).version == "unknown"
    assert "the name of one that ships" in broken(given)["thesis"]
    assert "a second detector of this name" in broken(given)["plain"]


def test_a_name_that_no_file_could_bear_is_left_out() -> None:
    given = [EntryPoint("../up", "udders:Plain", GROUP), EntryPoint("a:b", "udders:Plain", GROUP)]
    assert "../up" not in available(given)
    assert "no file could bear" in broken(given)["a:b"]
    with pytest.raises(UnknownDetectorError):
        create("../up", given)


@pytest.mark.slow
def test_an_installed_package_is_found_and_a_broken_one_reported(tmp_path: Path) -> None:
    path = installed(tmp_path, "udders", PACKAGE, "mine = udders:Plain\nbad = udders:fails")
    command, env = (
        [sys.executable, "-m", "bench.cli", "detectors"],
        {**os.environ, "PYTHONPATH": path},
    )
    done = subprocess.run(
        command, env=env, cwd=tmp_path, stdout=subprocess.PIPE, check=True, timeout=PATIENCE_S
    )
    lines = done.stdout.decode().splitlines()
    assert "mine: from udders 1 (udders:Plain)" in lines
    (fault,) = [line for line in lines if "BROKEN" in line]
    who = "detector 'bad' of udders 1 (udders:fails)"
    assert fault == f"bad: BROKEN: {who} can't be loaded: RuntimeError: no licence"
    assert any(line.startswith("thesis: ") for line in lines)
