"""Faults and arms that a rig file names: put into the emulators at their time, refused in their
place when they can't be.
"""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path

import pytest

import bench
from bench.config import ConfigError
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import load_rig
from instruments.clock import RealClock, VirtualClock
from instruments.link import Link
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.unit import SHIPPED
from instruments.stage.driver import OwnStage
from tests.bench.operated_runs import shipped_rig


def with_emulation(folder: Path, *lines: str) -> Path:
    """A copy of the emulated rig whose emulation says ``lines``."""
    return shipped_rig(folder, emulation="\n".join(lines))


ARM, CAMERAS = 'instrument = "arm", name', 'instrument = "cameras", name'


def arm_of(twin: EmulatedRig) -> MicroScribe:
    return MicroScribe(Link(twin.urls["arm"], twin.world.clock, who="arm"), twin.world.clock)


@pytest.mark.slow
def test_faults_are_there_from_the_start_so_often_and_so_much(tmp_path: Path) -> None:
    faults = [
        '{ instrument = "arm", name = "echo after repeats", amount = 5 }',
        '{ instrument = "arm", name = "silent", times = 2 }',
    ]
    rig = load_rig(with_emulation(tmp_path, f"faults = [{', '.join(faults)}]"))
    with EmulatedRig(rig, VirtualClock(), seed=1) as twin:
        link = Link(twin.urls["arm"], twin.world.clock, who="host")
        answers = []
        for _ in range(8):
            link.write(b"\xc5IMMC")
            answers.append(link.receive(0.015))
        assert answers == [b""] * 6 + [b"IMMC"] * 2, "two unheard, and the fifth that is heard"
        link.close()


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (f'{ARM} = "power los"', 'the arm has no fault "power los"; did you mean "power loss"?'),
        ('instrument = "bath", name = "power loss"', "the bath has no fault"),
        ('instrument = "bath", name = "silence", times = 2', '"times" is for faults of the arm'),
        ('instrument = "bath", name = "silence", amount = 2.0', 'have: "late answer" (1.5 s)'),
        ('instrument = "arm", name = "silent", amount = 2.0', "has no amount 2"),
        ('instrument = "arm", name = "silent", at_s = -1.0', "greater than or equal to 0"),
        ('instrument = "camera", name = "dark"', "'camera' is not allowed"),
        (f'{CAMERAS} = "blak"', 'the cameras have no fault "blak"; did you mean "black"?'),
        (f'{CAMERAS} = "frozen", amount = 2.0', 'the fault "frozen" has no amount 2'),
        (f'{CAMERAS} = "flat-field event", camera = "left"', "only the thermal camera"),
        (f'{ARM} = "silent", camera = "left"', '"camera" is for faults of the cameras'),
        ('instrument = "arm", name = "silent", at = 1.0', 'unknown key; did you mean "at_s"'),
        ('instrument = "stage", name = "silent", amount = 1.0', '"lost step" (1 mm lost)'),
    ],
)
def test_a_fault_that_cannot_be_is_shown_in_its_place(
    tmp_path: Path, fault: str, message: str
) -> None:
    path = with_emulation(tmp_path, f"faults = [{{ {fault} }}]")
    line = len(path.read_text(encoding="utf-8").split("\n"))
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    assert message in str(caught.value)
    assert f"rig.toml:{line}: emulation.faults[1]" in str(caught.value)


def test_another_arm_by_its_file(tmp_path: Path) -> None:
    text = (SHIPPED / "40937.toml").read_text(encoding="utf-8")
    (tmp_path / "other.toml").write_text(text.replace('"40937"', '"50001"'), encoding="utf-8")
    rig = load_rig(with_emulation(tmp_path, 'arm_unit = "other.toml"'))
    with EmulatedRig(rig, VirtualClock(), seed=1) as twin:
        arm = arm_of(twin)
        assert arm.sign_on().serial_number == "50001"
        arm.close()


def test_an_arm_file_with_faults_is_shown_in_its_places(tmp_path: Path) -> None:
    text = (SHIPPED / "40937.toml").read_text(encoding="utf-8")
    wrong = text.replace("button_mask = 0x03", "button_mask = 0x3F0")
    wrong = wrong.replace("beta = 0x0003", "bta = 0x0003")
    (tmp_path / "other.toml").write_text(wrong, encoding="utf-8")
    path = with_emulation(tmp_path, 'arm_unit = "other.toml"')
    lines = text.split("\n")
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    for key, fault in {
        "beta": "parameters.bta: unknown key",
        "button_mask": "maxima.button_mask: input should be less than or equal to 127 (found 1008)",
    }.items():
        number = next(i for i, line in enumerate(lines, 1) if line.startswith(key))
        assert f"other.toml:{number}: {fault}" in str(caught.value)
    with pytest.raises(ConfigError, match=r"emulation\.arm_unit: no such file beside the rig file"):
        load_rig(with_emulation(tmp_path, 'arm_unit = "none.toml"'))


@pytest.mark.slow
@pytest.mark.skipif(
    not hasattr(os, "openpty"), reason="needs pseudo-terminals: Linux and macOS have them"
)
def test_serial_instruments_on_pseudo_terminals(tmp_path: Path) -> None:
    served, clock = bench.serve_rig(shipped_rig(tmp_path), pty=True, paced=True), RealClock()
    with served as rig, closing(clock):
        assert rig.urls["arm"].startswith("/dev/")
        assert rig.urls["bath"].startswith("tcp://127.0.0.1:")
        with closing(MicroScribe(Link(rig.urls["arm"], clock, who="arm"), clock)) as arm:
            assert arm.sign_on().serial_number == "40937"
        with closing(OwnStage(Link(rig.urls["stage"], clock, who="stage"), clock)) as stage:
            stage.connect()
