"""`teatbench stage …` and `teatbench camera …` on emulated ones and another program's camera."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.cli.alone import focus_line, next_look, step
from bench.record.recording import Recording
from bench.rig.loading import find_rig, load_rig
from instruments.camera.frame import FrameError, FrameFault
from instruments.clock import VirtualClock
from instruments.stage.emulator.board import StageEmulator, StageFault
from instruments.stage.emulator.store import GRBL_HAL, MARLIN
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.commands import Said, served, teatbench
from tests.bench.rig.test_emulated_faults import with_emulation
from tests.instruments.camera.peers import ADDRESS, gige_camera

FAST = (
    {24: 6000, 25: 60000, 26: 1}
    | {110 + axis: 60000 for axis in range(3)}
    | {120 + axis: 20000 for axis in range(3)}
)


@dataclass
class Served:
    emulator: StageEmulator
    at: list[str]


@pytest.fixture
def stage() -> Iterator[Served]:
    """``at`` are the arguments that lead to it. Its axes are quick, so that real time is short."""
    settings = FAST | {113: 60000, 123: 20000}
    with served(
        lambda clock: StageEmulator(clock, dialect=GRBL_HAL, axes=4, settings=settings)
    ) as (emulator, url):
        yield Served(emulator, ["--port", url, "--axes", "XYZA"])


@pytest.mark.slow
def test_status_says_everything_with_units(stage: Served, said: Said) -> None:
    text = json.loads(said(0, "stage status {} --json", stage.at).out)
    assert text.pop("schema_version") == 1
    known = {"dialect": "grblHAL", "version": "1.1f", "state": "Alarm", "homed": False}
    assert text | known == text
    assert text["pins"] == "none active"
    stage.emulator.inject(StageFault.PROBE_CLOSED)
    assert json.loads(said(0, "stage status {} --json", stage.at).out)["pins"] == "probe"
    assert text["travel_x_mm"] == [-300.0, 0.0]
    assert text["travel_a_deg"] == [-360.0, 0.0]
    assert {"x_mm", "y_mm", "z_mm", "a_deg", "soft_limits", "hard_limits", "homing"} <= text.keys()
    assert [
        line.split(": ")[0] for line in said(0, "stage status {}", stage.at).out.strip().split("\n")
    ] == list(text)


@pytest.mark.weekly
def test_a_marlin_by_its_dialect(said: Said) -> None:
    with served(lambda clock: StageEmulator(clock, dialect=MARLIN, settings=FAST)) as (_, url):
        at = ["--port", url, "--dialect", "marlin"]
        assert "moved: X 20.000 mm, Y 30.500 mm" in said(0, "stage move {} 20 30.5", at).out
    assert "go with --port" in said(2, "stage home --rig emulated --dialect marlin").err


@pytest.mark.slow
def test_home_move_and_jog(stage: Served, said: Said) -> None:
    expected = "homed: X -1.000 mm, Y -1.000 mm, Z -1.000 mm, A -1.000 deg\n"
    assert said(0, "stage home {}", stage.at).out == expected
    assert said(0, "stage move {} -20 -30.5 --z -5 --a -90 --feed 60000", stage.at).out.endswith(
        "moved: X -20.000 mm, Y -30.500 mm, Z -5.000 mm, A -90.000 deg\n"
    )
    assert stage.emulator.position_mm() == pytest.approx([-20, -30.5, -5, -90])
    why = said(2, "stage jog {} X2", stage.at).err
    assert "X = 1.000 mm is outside the travel" in why
    assert said(0, "stage jog {} X-5 x-2y-1.5 A-10", stage.at).out.endswith(
        "moved: X -8.000 mm, Y -2.500 mm, Z -1.000 mm, A -11.000 deg\n"
    )


@pytest.mark.slow
def test_a_fault_ends_at_a_stand_with_what_to_do(stage: Served, said: Said) -> None:
    stage.emulator.inject(StageFault.NO_SWITCH)
    assert "alarm 9: homing found no switch" in said(3, "stage home {}", stage.at).err
    stage.emulator.cure(StageFault.NO_SWITCH)
    assert said(0, "stage recover {}", stage.at).out.startswith(
        "restarted, in state Alarm; its position is unknown"
    )
    assert teatbench("stage home {}", stage.at) == 0


def test_ways_to_go() -> None:
    assert step("X-5") == {"x_mm": -5.0}
    assert step("x.5Y+2A10.25") == {"x_mm": 0.5, "y_mm": 2.0, "a_deg": 10.25}
    for wrong in ("", "X", "5", "X5X6", "X5 Y6", "B5", "X5;", "X1e3"):
        with pytest.raises(ValueError, match="is no way to go"):
            step(wrong)


def test_list_of_a_rig(said: Said) -> None:
    assert said(0, "camera list emulated").out == "all  emulator:\n"
    lines = said(0, "camera list lab.example").out.splitlines()
    assert [line.split("  ")[0] for line in lines] == ["left", "right", "thermal", "depth"]
    assert lines[2].startswith("thermal  genicam:192.168.1.23 ")
    assert "kelvin_per_count=0.04" in lines[2]


@pytest.mark.slow
def test_show_tells_a_fault_and_exits_3(tmp_path: Path, said: Said) -> None:
    rig = with_emulation(
        tmp_path, 'faults = [{ instrument = "cameras", name = "saturated", camera = "right" }]'
    )
    captured = said(3, "camera show {}", rig)
    assert "right: emulated 340 x 256" in captured.out
    assert "right camera: saturated: " in captured.err
    text = json.loads(said(3, "camera show {} --json", rig).out)
    assert text["identity"]["left"] == "emulated 340 x 256"
    assert text["cameras"]["left"]["size_px"] == "340 x 256"
    assert 0.3 < text["cameras"]["left"]["edge_blur_px"] < 1.75
    assert "right camera: saturated: " in text["faults"][0]


@pytest.mark.slow
def test_focus_sees_a_lens_go_out_of_focus(tmp_path: Path, said: Said) -> None:
    fault = '{ instrument = "cameras", name = "out of focus", camera = "right", at_s = 1.0 }'
    rig = with_emulation(tmp_path, f"faults = [{fault}]")
    lines = said(0, "camera focus {} --seconds 1.5 --every 0.5", rig).out.splitlines()
    blurs = [float(line.split("right")[1].split()[0]) for line in lines[:3]]
    assert blurs[0] < 1.75
    assert blurs[2] > 3.0
    best = float(lines[-1].split("right = ")[1].split()[0].rstrip(","))
    assert best == pytest.approx(blurs[0], abs=0.06)


@pytest.mark.parametrize(
    ("best", "expected"),
    [
        ({"single": 0.0}, {"left": 0.01}),
        ({"single": 1.234}, {"left": 1.23}),
        ({"left": 0.7, "right": 0.004, "thermal": 12.0}, None),
    ],
)
def test_what_focus_prints_is_a_line_of_a_rig_file(
    tmp_path: Path, best: dict[str, float], expected: dict[str, float] | None
) -> None:
    text = find_rig("lab.example").read_text(encoding="utf-8")
    old = next(line for line in text.splitlines() if line.startswith("focus_px"))
    text = text.replace(old, focus_line(best))
    rig = tmp_path / "rig.toml"
    rig.write_text(text, encoding="utf-8")
    shutil.copy(find_rig("emulated").with_name("calibration.toml"), tmp_path)
    taken = load_rig(rig).rig.cameras.checks.focus_px.model_dump(exclude_none=True)
    assert taken == (expected or {"left": 0.7, "right": 0.01, "thermal": 12.0})


def test_a_live_look_does_not_end_for_frames_that_did_not_come(
    capsys: pytest.CaptureFixture[str],
) -> None:
    clock, pictures = VirtualClock(), {"single": np.zeros((4, 4), np.uint8)}
    fault = FrameError(FrameFault.DROPPED, "single", "single camera", "status CLEARED")
    outcomes: list[Exception] = [fault] * 30

    def look() -> dict[str, np.ndarray]:
        if outcomes:
            raise outcomes.pop()
        return pictures

    alone: Any = SimpleNamespace(look=look)
    assert next_look(alone, clock, math.inf, 0.2) is pictures
    assert capsys.readouterr().err.count("status CLEARED") == 30
    outcomes += [fault] * 30
    with pytest.raises(FrameError, match="status CLEARED"):
        next_look(alone, clock, clock.now() + 2.0, 0.2)


@pytest.mark.slow
def test_grab_is_a_recording_that_is_added_to(tmp_path: Path, said: Said) -> None:
    folder, rig = tmp_path / "grabbed", write_small_rig(tmp_path)
    assert teatbench("camera grab {} --out {} --count 2", rig, folder) == 0
    assert teatbench("camera grab {} --out {}", rig, folder) == 0
    recording = Recording(folder)
    assert recording.frames == ("0000", "0001", "0002")
    assert recording.calibration_path.is_file()
    first, second = (recording.load(name) for name in recording.frames[:2])
    assert first.thermal_ck is not None
    assert not np.array_equal(first.left, second.left)
    assert "0002" in said(0, "detect {}", folder).out
    kept = recording.calibration_path.read_bytes()  # what its frames are of
    assert "has another calibration" in said(2, "scene record --out {} --seeds 1", folder).err
    assert (
        "has another calibration"
        in said(2, "scene boards chessboard-9x6-40 --poses 1 --out {}", folder).err
    )
    assert recording.calibration_path.read_bytes() == kept


@pytest.mark.slow
def test_grab_takes_again_what_has_a_fault(tmp_path: Path, said: Said) -> None:
    rig = with_emulation(
        tmp_path, 'faults = [{ instrument = "cameras", name = "half a frame", times = 1 }]'
    )
    why = said(0, "camera grab {} --out {}", rig, tmp_path / "grabbed").err
    assert "left camera: half a frame: 50 % of its rows" in why
    assert Recording(tmp_path / "grabbed").load("0000").left[-1].any()


@pytest.mark.slow
def test_a_gige_vision_camera(
    tmp_path: Path, said: Said, capsys: pytest.CaptureFixture[str]
) -> None:
    with gige_camera() as serial:
        expected = f"genicam:Aravis-Fake-{serial}  Aravis Fake {serial} GigEVision at {ADDRESS}"
        assert expected in said(0, "camera list").out
        shown = said(0, "camera show {}", f"genicam:{ADDRESS}").out
        assert f"single: Aravis Fake {serial} (512 x 512, Mono8)" in shown
        focused = said(0, "camera focus {} --seconds 0.3 --every 0.1", f"genicam:{ADDRESS}").out
        assert "single" in focused
        grab = "camera grab {} genicam:Fake_1 --out {}"
        capsys.readouterr()
        # no trigger is common to both: on a busy machine they expose further apart than is allowed
        while code := teatbench(grab, f"genicam:{ADDRESS}", tmp_path / "grabbed"):
            why = capsys.readouterr().err
            assert (code, "after the first of its set, limit 0.05 s" in why) == (3, True), why
        assert "put calibration.toml into the folder" in capsys.readouterr().err
        alone = said(2, "camera grab {} --out {}", f"genicam:{ADDRESS}", tmp_path / "one").err
        assert "one camera alone makes no frame set" in alone
    assert not (tmp_path / "one").exists()
    frames = Recording(tmp_path / "grabbed").load("0000")
    assert frames.left.shape == frames.right.shape == (512, 512)
