"""A rig from Python, as docs/api.md has it; wrong steps."""

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar, cast

import cv2
import numpy as np
import pytest

import bench
from detector import Calibration, Detection, Frames, Outcome, registry
from instruments import LimitError
from tests.bench.operated_runs import shipped_rig
from tests.conftest import ROOT
from tests.instruments.interrupts import interrupts

pytestmark = pytest.mark.slow


def test_an_end_needs_a_place_and_a_number_and_safe_ends_the_watch() -> None:
    with bench.open_rig("emulated") as rig:
        rig.home()
        rig.set_up(bench.member("ideal", 3))
        with pytest.raises(LimitError, match=r"the place of the plate.*Call move\(\)"):
            rig.touch(1)
        rig.heat(33.0, wait=False)
        rig.wait(10.0)
        rig.safe(keep_arm=True)
        rig.wait(5.0)
        rig.move(3.0)
        for teat in (-1, 0, 5):
            with pytest.raises(LimitError, match=f"no teat {teat}: the phantom has 4, from 1"):
                rig.touch(teat)
        (end,), exact = rig.touch(4), rig.truth()[3]
        assert np.linalg.norm(np.subtract(end.xyz_mm, exact.xyz_mm)) < 2.0


def test_what_is_not_homed_or_was_left_says_what_to_do() -> None:
    with bench.open_rig("emulated") as rig:
        bath, stage = rig.bath, rig.stage
        for wrong in (lambda: rig.wait(np.nan), lambda: rig.set_up("ideal"), lambda: rig.move("x")):  # type: ignore[arg-type]
            with pytest.raises(bench.ConfigError, match=", not a"):
                wrong()
        with pytest.raises(bench.ConfigError, match="s is inf, not a number"):
            rig.wait(np.inf)
        for early in (rig.move, rig.touch):
            with pytest.raises(LimitError, match=r"it is not homed .*Call home\(\) first"):
                early()
        rig.home()
        drivers: tuple[Any, ...] = (stage, bath, rig.arm, rig.operator)
        calls = (("move_to", ("x", 1.0)), ("start", (None,)), ("read", (0,)), ("ask", ("x",)))
        for driver, (call, given) in zip(drivers, calls, strict=True):
            with pytest.raises(bench.ConfigError, match=", not "):
                getattr(driver, call)(*given)
        with pytest.raises(LimitError, match="x_mm = 500 is out of reach, -150 to 150"):
            rig.move(500.0)
        rig.capture()
        views = bench.watch_bath(bath, clock=rig.clock)
        assert [next(views).started for _ in range(2)] == [False, False]
    for act in (rig.home, rig.move, rig.capture, rig.touch, rig.safe, lambda: rig.heat(33.0)):
        with pytest.raises(LimitError, match=r"it was left, and is closed.*with block"):
            act()
    for name in ("read", "before_heating"):
        with pytest.raises(LimitError, match="it was left, and is closed"):
            getattr(bath, name)()
    with pytest.raises(LimitError, match="it was left, and is closed"):
        stage.position()


def test_ctrl_c_amid_any_step_leaves_a_rig_that_can_be_used() -> None:
    with bench.open_rig("emulated", ("bath",)) as rig, interrupts() as interrupt_in:
        for number in range(100):
            with pytest.raises(KeyboardInterrupt):  # noqa: PT012 - wherever it strikes
                interrupt_in(0.0005 + number % 37 * 0.00003)
                while True:
                    rig.bath.read()
        rig.heat(33.0, wait=False)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_what_was_done_is_said_and_nothing_too() -> None:
    said: list[str] = []
    with bench.open_rig("emulated", ("arm", "stage", "operator")) as rig:
        assert [rig.home(), rig.home()] == [("arm", "stage"), ()]
        assert rig.safe() == ("stage", "arm")
    with bench.open_rig("emulated", ("cameras",), warn=said.append) as rig:
        assert (rig.home(), rig.safe()) == ((), ())
    assert [text.partition(":")[0] for text in said] == ["nothing to home"]
    assert not bench.acknowledge("emulated")


def test_cameras_are_not_used_behind_their_with_block(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), np.full((48, 64), 90, np.uint8))
    for sources in ([], [f"files:{tmp_path}/*.png"]):
        with bench.open_cameras(sources) as cameras:
            assert isinstance(cameras, bench.OpenCameras)
            assert cameras.describe()["cameras"]
            look, whole = cameras.look, cameras.frame_set
        acts: tuple[Any, ...] = (cameras.describe, look, lambda: cameras.identity)
        for act in (*acts, *([whole.capture] if whole else [])):
            with pytest.raises(LimitError, match="closed at the end of its with block"):
                act()


class Blind:
    name, version = "blind", "1"
    parameters: ClassVar[dict[str, object]] = {}

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        return Detection(())


def test_a_detector_is_an_object_too_and_none_behind_its_with_block() -> None:
    (line, _), *_ = bench.detect_recording(ROOT / "tests" / "data" / "path_traced", [Blind()])
    assert (line["detector"], line["teats"]) == ("blind", [])
    nameless: Any = type("Mine", (), {"detect": Blind.detect})()
    with pytest.raises(bench.ConfigError, match="the detector Mine has no `name`"):
        list(bench.detect_recording(ROOT / "tests" / "data" / "path_traced", [nameless]))
    with bench.open_detector("fused") as fused:
        assert isinstance(fused, type(registry.create("fused")))
    with pytest.raises(LimitError, match=r"^detector: it was closed at the end"):
        cast(Any, fused).detect()


def test_a_rig_that_was_calibrated_anew_is_drawn_by_its_new_calibration(tmp_path: Path) -> None:
    small, whole = (
        bench.draw("ideal", 3, rig=shipped_rig(tmp_path, whole=whole)) for whole in (False, True)
    )
    rows = [shot.frames.left.shape[0] for shot in (small, whole)]
    assert [shot.calibration.left.image_size[1] for shot in (small, whole)] == rows
    assert rows[0] < rows[1]
    assert [end.xyz_mm for end in small.truth] == [end.xyz_mm for end in whole.truth]


def test_a_time_limit_ends_a_program_that_does_not_start(tmp_path: Path) -> None:
    (tmp_path / "late.py").write_text("import time; time.sleep(30)", encoding="utf-8")
    shot = bench.Shot(*(getattr(bench.draw("ideal", 3), one) for one in ("frames", "calibration")))
    command = f"exec:{sys.executable} {tmp_path / 'late.py'}"
    answer = bench.detect(command, shot, timeout_s=0.3)
    assert (answer.outcome, answer.seconds < 5.0) == (Outcome.TIMEOUT, True)
    with pytest.raises(bench.ConfigError, match=r"^truth: this shot has none"):
        bench.score(answer, shot)
    assert bench.score(answer, []).counts.visible == 0
    ready = """print('{"ready": true}', flush=True); import time; time.sleep(30)"""
    (tmp_path / "late.py").write_text(ready, encoding="utf-8")
    with bench.open_detector(command) as opened:
        answer = bench.detect(opened, shot, timeout_s=2.0)
    assert (answer.outcome, answer.seconds < 10.0) == (Outcome.TIMEOUT, True)


OPENS = "import bench\nwith bench.program(''), bench.open_rig('lab.toml', ('bath',)): print('open')"


def test_a_real_rig_that_is_open_is_nobody_elses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    other = [sys.executable, "-c", OPENS]
    with bench.serve_rig("emulated") as served:
        Path("lab.toml").write_text(served.rig_file(), encoding="utf-8")
        with bench.open_rig("lab.toml", ("bath",)):
            again = (
                lambda: bench.open_rig("lab.toml").__enter__(),
                lambda: bench.run_script("demo", "lab.toml"),
                lambda: bench.calibrate_stage("lab.toml"),
            )
            for opens in again:
                with pytest.raises(bench.RigInUseError, match=r"this process has it.*Leave the bl"):
                    opens()
            with bench.open_rig("lab.toml", ("cameras",)):  # which nobody else can have anyhow
                pass
            ended = subprocess.run(other, capture_output=True, text=True, check=False)
            assert ended.returncode == 3
            assert "teatbench: rig: another bench has it: pid " in ended.stderr
            assert "open_rig. Wait for it to end" in ended.stderr
        ended = subprocess.run(other, capture_output=True, text=True, check=False)
        assert ended.stdout == "open\n", ended.stderr
