"""A bench that dies or hangs, and one that ends well, beside its guardian: what the record and the
report say of it afterwards.

Kills in every step are `test_guardian_kills`; serial ports and pumps `test_guardian_serial`.
"""

from __future__ import annotations

import sys
import time
from datetime import datetime
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.record.reader import read_run
from tests.bench.real_rig import RealRig, real_rig
from tests.bench.safety.guards import (
    HANG_S,
    STANDBY_S,
    STOPPED_S,
    Measured,
    guardian_record,
    guardians_of,
    standby_after,
)
from tests.plain_text import plain_text

if sys.platform == "win32":
    pytest.skip("sends POSIX signals to the bench", allow_module_level=True)

from tests.bench.marked_bench import MARK, MarkedBench, marked_bench
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

SEEN_LATE_S = 5.0  # so much later than it was said a busy machine may show us that it hangs


def heating(rig: RealRig, running: MarkedBench) -> None:
    running.wait_for("on its peg")
    running.enter()
    running.until(lambda: rig.twin.world.plant.running, "heated")


def reported(rig: RealRig, capsys: pytest.CaptureFixture[str]) -> tuple[str, str]:
    """What `teatbench report` says of the run: on the terminal, and on the page."""
    assert main(["report", str(rig.run_folder())]) == 3
    page = rig.run_folder() / "report" / "index.html"
    return " ".join(capsys.readouterr().out.split()), plain_text(page)


def test_a_bench_that_is_stopped_is_taken_for_dead_within_seconds(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], measured: Measured
) -> None:
    with real_rig(tmp_path / "rig", recording, window_s=60.0) as rig:
        with marked_bench(rig, "none") as running:
            heating(rig, running)
            time.sleep(1.5)
            running.signal("SIGSTOP")
            seconds = standby_after(rig.twin.world.plant)
            guardian_record(rig.run_folder())
            running.signal("SIGCONT")
            running.process.join(PATIENCE_S)
            assert running.process.exitcode == 3
        measured("SIGSTOP while settling", seconds)
        assert seconds < STOPPED_S + STANDBY_S
        run = read_run(rig.run_folder())
        assert run.guardian is not None
        last, noticed = (
            datetime.fromisoformat(run.guardian[name])
            for name in ("wall_last_sign", "wall_noticed")
        )
        assert (noticed - last).total_seconds() >= STOPPED_S
        assert (run.guardian["cause"], run.guardian["standby"]) == ("hung", True)
        assert run.ending == "faulted", "once it goes on, it finds its guardian gone"
        assert run.facts["trip"]["rule"] in ("guardian lost", "changed at the controller"), (
            "or the bath not as it left it"
        )
        assert "The bench hung (its process is stopped)" in reported(rig, capsys)[1]


def test_a_main_thread_that_hangs_while_the_others_live_is_taken_for_dead_after_ten_seconds(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], measured: Measured
) -> None:
    """In a move, which may take ten minutes, as the homing before it: what counts is the silence."""
    with real_rig(tmp_path / "rig", recording, stage=True, quick=False) as rig:
        with marked_bench(rig, "hanging") as running:
            running.wait_for("on its peg")
            running.enter()
            running.wait_for(f"{MARK}hanging")
            seconds = standby_after(rig.twin.world.plant)
            guardian_record(rig.run_folder())
        measured("main thread hangs while moving", seconds)
        assert HANG_S - SEEN_LATE_S < seconds < HANG_S + STANDBY_S
        text = read_run(rig.run_folder()).guardian
        assert text is not None
        assert (text["cause"], text["standby"]) == ("hung", True)
        why = "the main thread hangs: moving the stage, and no sign of life for 10 s"
        assert text["why"] == why
        for said in reported(rig, capsys):
            assert (
                f"The bench hung ({why}); its last sign of life was at {text['wall_last_sign']}"
                in said
            )
            assert f"the guardian had the bath in standby at {text['wall_safe']}" in said


def test_a_frozen_guardian_ends_the_run_with_the_bath_in_standby(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """So that no death of the bench can follow that nobody would act on."""
    with (
        real_rig(tmp_path / "rig", recording, window_s=600.0) as rig,
        marked_bench(rig, "none") as running,
    ):
        heating(rig, running)
        (guardian,) = guardians_of(running.process.pid)
        guardian.suspend()
        try:
            standby_after(rig.twin.world.plant)
            running.process.join(PATIENCE_S)
            assert running.process.exitcode == 3
        finally:
            guardian.resume()
        assert not rig.twin.world.plant.running
        run = read_run(rig.run_folder())
        assert (run.ending, run.facts["trip"]["rule"]) == ("faulted", "guardian lost")
        assert run.facts["trip"]["why"] == "it has not answered for 3 s"
        assert run.guardian is None, "it had nothing to do"
        assert "interlock guardian lost: it has not answered for 3 s" in reported(rig, capsys)[1]
