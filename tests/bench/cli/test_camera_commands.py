"""`teatbench camera`: on the emulated rig, on MJPEG streams, and on a GigE Vision camera of another
program.
"""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from bench.cli.main import main
from instruments.camera.emulator import EmulatedCameras
from instruments.camera.recording import Recording
from instruments.camera.stream import StreamServer
from instruments.clock import RealClock
from tests.bench.rig.test_emulated_faults import with_emulation
from tests.bench.run.test_end_to_end import started
from tests.instruments.camera.peers import ADDRESS, gige_camera
from tests.instruments.camera.small_world import GalleryWorld

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def streams() -> Iterator[list[str]]:
    """Left, right and thermal as streams of this process."""
    with (
        closing(RealClock()) as clock,
        closing(StreamServer(EmulatedCameras(GalleryWorld(clock=clock)), clock)) as server,
    ):
        yield [f"opencv:{url}" for url in server.urls.values()]


def test_list_of_a_rig(capsys: Capture) -> None:
    assert main(["camera", "list", "emulated"]) == 0
    assert capsys.readouterr().out == "all  emulator:\n"
    assert main(["camera", "list", "lab.example"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in lines] == ["left", "right", "thermal"]
    assert lines[2].startswith("thermal  genicam:192.168.1.23 ")
    assert "kelvin_per_count=0.04" in lines[2]


def test_show_the_emulated_rig(capsys: Capture) -> None:
    assert main(["camera", "show", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["identity"]["left"] == "emulated 1360 x 1024"
    assert told["cameras"]["left"]["size_px"] == "1360 x 1024"
    assert 0.3 < told["cameras"]["left"]["edge_blur_px"] < 1.75
    assert told["faults"] == []


def test_show_tells_a_fault_and_exits_3(tmp_path: Path, capsys: Capture) -> None:
    rig = with_emulation(
        tmp_path, 'faults = [{ instrument = "cameras", name = "saturated", camera = "right" }]'
    )
    assert main(["camera", "show", str(rig)]) == 3
    captured = capsys.readouterr()
    assert "right: emulated 1360 x 1024" in captured.out
    assert "right camera: saturated: " in captured.err


def test_show_streams(streams: list[str], capsys: Capture) -> None:
    assert main(["camera", "show", *streams]) in (0, 3)  # 3: the three fell on two sides of a tick
    out = capsys.readouterr().out
    assert "thermal: http://127.0.0.1:" in out
    assert "640 x 480" in out


@pytest.mark.skipif(sys.platform == "win32", reason="sends a POSIX signal to a child")
def test_emulate_serves_its_cameras_too(capsys: Capture) -> None:
    with started(["emulate"]) as child:
        assert child.stdout is not None
        urls = dict(child.stdout.readline().split() for _ in range(6))
        assert list(urls)[3:] == ["left", "right", "thermal"]
        assert main(["camera", "show", urls["left"], "--json"]) == 0
        told = json.loads(capsys.readouterr().out)["cameras"]["single"]
        assert told["size_px"] == "1360 x 1024"
        assert told["brightest_dn"] > 100
        child.send_signal(signal.SIGINT)
        child.communicate(timeout=60)
        assert child.returncode == 0


def test_focus_of_one_stream(streams: list[str], capsys: Capture) -> None:
    assert main(["camera", "focus", streams[0], "--seconds", "0.5", "--every", "0.1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("single  0.")
    assert lines[-1].startswith("focus_px = { single = 0.")


def test_focus_sees_a_lens_go_out_of_focus(tmp_path: Path, capsys: Capture) -> None:
    fault = '{ instrument = "cameras", name = "out of focus", camera = "right", at_s = 1.0 }'
    rig = with_emulation(tmp_path, f"faults = [{fault}]")
    assert main(["camera", "focus", str(rig), "--seconds", "1.5", "--every", "0.5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    blurs = [float(line.split("right")[1].split()[0]) for line in lines[:3]]
    assert blurs[0] < 1.75
    assert blurs[2] > 3.0
    best = float(lines[-1].split("right = ")[1].split()[0].rstrip(","))
    assert best == pytest.approx(blurs[0], abs=0.06)


def test_grab_is_a_recording_that_is_added_to(tmp_path: Path, capsys: Capture) -> None:
    folder = tmp_path / "grabbed"
    assert main(["camera", "grab", "--out", str(folder), "--count", "2"]) == 0
    assert main(["camera", "grab", "--out", str(folder)]) == 0
    recording = Recording(folder)
    assert recording.frames == ("0000", "0001", "0002")
    assert recording.calibration_path.is_file()
    first, second = (recording.load(name) for name in recording.frames[:2])
    assert first.thermal_ck is not None
    assert not np.array_equal(first.left, second.left)
    assert main(["detect", str(folder)]) == 0
    assert "0002" in capsys.readouterr().out


def test_grab_takes_again_what_has_a_fault(tmp_path: Path, capsys: Capture) -> None:
    rig = with_emulation(
        tmp_path, 'faults = [{ instrument = "cameras", name = "half a frame", times = 1 }]'
    )
    assert main(["camera", "grab", str(rig), "--out", str(tmp_path / "grabbed")]) == 0
    assert "left camera: half a frame: 50 % of its rows" in capsys.readouterr().err
    assert Recording(tmp_path / "grabbed").load("0000").left[-1].any()


def test_grab_streams_without_a_rig(streams: list[str], tmp_path: Path, capsys: Capture) -> None:
    assert main(["camera", "grab", *streams, "--out", str(tmp_path / "grabbed")]) == 0
    assert "put calibration.toml into the folder" in capsys.readouterr().err
    frames = Recording(tmp_path / "grabbed").load("0000")
    assert frames.left.shape == (1024, 1360)
    assert frames.thermal is not None


def test_a_gige_vision_camera(tmp_path: Path, capsys: Capture) -> None:
    with gige_camera() as serial:
        assert main(["camera", "list"]) == 0
        assert (
            f"genicam:Aravis-Fake-{serial}  Aravis Fake {serial} GigEVision at {ADDRESS}"
            in capsys.readouterr().out
        )
        assert main(["camera", "show", f"genicam:{ADDRESS}"]) == 0
        assert f"single: Aravis Fake {serial} (512 x 512, Mono8)" in capsys.readouterr().out
        assert (
            main(["camera", "focus", f"genicam:{ADDRESS}", "--seconds", "0.3", "--every", "0.1"])
            == 0
        )
        capsys.readouterr()
        assert (
            main(
                [
                    "camera",
                    "grab",
                    f"genicam:{ADDRESS}",
                    "genicam:Fake_1",
                    "--out",
                    str(tmp_path / "grabbed"),
                ]
            )
            == 0
        )
    frames = Recording(tmp_path / "grabbed").load("0000")
    assert frames.left.shape == frames.right.shape == (512, 512)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["show", "nothing"], 2, 'no rig "nothing"'),
        (["show", "emulated", "lab.example"], 2, "one rig, or one to three cameras by URL"),
        (["show", "opencv:0", "opencv:1", "opencv:2", "opencv:3"], 2, "at most 3 cameras"),
        (["show", "opencv:a.avi", "socket:1"], 2, "not a camera; allowed"),
        (
            ["show", "opencv:/no/such/file.avi"],
            3,
            "single camera at /no/such/file.avi: can't be opened",
        ),
    ],
)
def test_what_cannot_be_is_said(
    arguments: list[str], code: int, message: str, capsys: Capture
) -> None:
    assert main(["camera", *arguments]) == code
    assert message in capsys.readouterr().err


def test_one_camera_makes_no_frame_set(streams: list[str], tmp_path: Path, capsys: Capture) -> None:
    assert main(["camera", "grab", streams[0], "--out", str(tmp_path / "grabbed")]) == 2
    assert "one camera alone makes no frame set" in capsys.readouterr().err
    assert not (tmp_path / "grabbed").exists()
