"""What supervises a detector's processes: memory watched, and an end for all of them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from detector.calibration import Calibration
from detector.external.process import resident_mib
from detector.protocol import DetectionFailure
from tests.conftest import ROOT
from tests.detector.children import GOOD, HEAD, NO_TEATS, Start, answering, ask, failure, start
from tests.waiting import alive, within

pytestmark = pytest.mark.slow

__all__ = ["start"]
linux = pytest.mark.skipif(
    sys.platform != "linux", reason="only Linux tells a process's memory and all its descendants"
)


@linux
def test_memory_is_watched_during_and_after_a_call(start: Start, rig: Calibration) -> None:
    hoard = "kept = bytearray(os.urandom(1)) * (200 << 20)\n"
    during = start(answering(hoard + "time.sleep(60)"), memory_mib=120.0)
    assert "MiB of memory, 120 MiB are allowed" in str(failure(during, rig))
    after = start(answering(f"{NO_TEATS}\n{hoard}"), memory_mib=120.0)
    ask(after, rig)
    with pytest.raises(DetectionFailure, match="MiB of memory"):
        within(after.check, "it has taken too much")
    ask(after, rig)
    assert after.start_up_s is not None, "it was started again"
    used = resident_mib(os.getppid())
    assert used is not None
    assert used > 1


def kept_in(folder: Path) -> list[int]:
    """The processes that a program wrote down."""
    return [int(pid) for pid in (folder / "pids").read_text(encoding="ascii").split()]


GRANDCHILD = """
spec = dict(start_new_session=True, stdin=subprocess.DEVNULL)
grandchild = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"], **spec)
with open(%r, "w") as file: file.write(f"{os.getpid()} {grandchild.pid}")
"""


@linux
@pytest.mark.parametrize("ending", ["close", "crash", "timeout"])
def test_a_grandchild_ends_too(start: Start, rig: Calibration, tmp_path: Path, ending: str) -> None:
    deed = {"close": NO_TEATS, "crash": "sys.exit(1)", "timeout": "time.sleep(60)"}[ending]
    ready = GRANDCHILD % str(tmp_path / "pids") + 'say({"ready": True})'
    detector = start(answering(deed, ready), answer_s=0.5)
    if ending == "close":
        ask(detector, rig)
    else:
        failure(detector, rig)
    pids = kept_in(tmp_path)
    assert all(map(alive, pids)) == (ending == "close")
    detector.close()
    detector.close()
    assert not any(map(alive, pids))


ESCAPE = """
import signal
spec = dict(start_new_session=True, stdin=subprocess.DEVNULL)
sleeper = [sys.executable, "-c", "import time; time.sleep(600)"]
of_own_session = subprocess.Popen(sleeper, **spec)
without_a_mark = subprocess.Popen(sleeper, env={}, stdin=subprocess.DEVNULL)
orphaned = subprocess.run(
    [sys.executable, "-c", f"import subprocess; print(subprocess.Popen({sleeper!r}, **{spec!r}, stdout=subprocess.DEVNULL).pid)"],
    stdout=subprocess.PIPE, check=True,
).stdout
with open(%r, "w") as file: file.write(f"{os.getpid()} {of_own_session.pid} {without_a_mark.pid} {int(orphaned)}")
os.kill(os.getppid(), signal.SIGKILL)
"""


@linux
@pytest.mark.parametrize("goes_on", [True, False], ids=["answers on", "falls silent"])
def test_a_killed_supervisor(start: Start, rig: Calibration, tmp_path: Path, goes_on: bool) -> None:
    then = NO_TEATS if goes_on else "time.sleep(600)"
    detector = start(answering(f"{ESCAPE % str(tmp_path / 'pids')}{then}"), answer_s=600.0)
    note = "has lost its supervisor, which was ended by signal 9"

    def meet() -> None:
        ask(detector, rig)  # its answer may come before its loss is noticed, or not
        within(detector.check, "it is lost")

    with pytest.raises(DetectionFailure, match=note):
        meet()
    pids = kept_in(tmp_path)
    assert len(pids) == 4
    within(lambda: not any(map(alive, pids)), "all have ended")


@linux
def test_the_system_refuses_far_more_memory_than_allowed(start: Start, rig: Calibration) -> None:
    """Memory that was never touched is not resident, so that only the hard limit can see it."""
    what = """import mmap
try:
    kept = mmap.mmap(-1, %d, flags=mmap.MAP_PRIVATE)
    said = "given"
except OSError:
    said = "refused"
say({"frame": asked["frame"], "teats": [], "reason": said})"""
    below, above = (answering(what % (times * 100 << 20)) for times in (3, 5))
    assert ask(start(below, memory_mib=100.0), rig).reason == "given"
    assert ask(start(above, memory_mib=100.0), rig).reason == "refused"


@linux
def test_nothing_outlives_a_bench_that_is_killed(tmp_path: Path) -> None:
    ready = GRANDCHILD % str(tmp_path / "pids") + 'say({"ready": True})\ntime.sleep(600)'
    (tmp_path / "program.py").write_text(HEAD + ready, encoding="utf-8")
    bench = f"""
import sys, time
from pathlib import Path
from detector.external import ExternalDetector
from detector.external.process import Child
child = Child([sys.executable, {str(tmp_path / "program.py")!r}], None, None, time.perf_counter)
child.line(60.0)
print("up", flush=True)
time.sleep(600)
"""
    command = [sys.executable, "-c", bench]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"up\n"
        pids = kept_in(tmp_path)
        assert all(map(alive, pids))
        process.kill()
    within(lambda: not any(map(alive, pids)), "all have ended")


def test_it_may_put_its_things_in_order(start: Start, rig: Calibration, tmp_path: Path) -> None:
    detector = start(f'{GOOD}\nopen({str(tmp_path / "tidy")!r}, "w").write("yes")')
    ask(detector, rig)
    detector.close()
    assert (tmp_path / "tidy").read_text(encoding="ascii") == "yes"


def test_one_that_does_not_go_is_made_to(start: Start, rig: Calibration) -> None:
    detector = start(GOOD + "\ntime.sleep(600)")
    ask(detector, rig)
    detector.close()
    assert detector.said() == ""


def test_closing_removes_the_pictures(start: Start, rig: Calibration, tmp_path: Path) -> None:
    place = tmp_path / "where"
    detector = start(answering(f'open({str(place)!r}, "w").write(asked["left"])\n{NO_TEATS}'))
    ask(detector, rig)
    left = Path(place.read_text(encoding="utf-8"))
    assert left.is_file()
    detector.close()
    assert not left.parent.exists()
