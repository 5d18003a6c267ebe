"""`--record` goes on with the run: after any death the recording ends as that of a run that nobody
disturbed.
"""

from __future__ import annotations

import errno
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from bench.record.reader import read_run
from bench.rig.loading import load_rig
from bench.run.engine import Ending
from bench.run.recordings import RECORDED, Recorder
from bench.run.start import RunOptions, run_script
from bench.script.model import load_script
from bench.truth.carrying import CarriedTruth
from instruments.camera.recording import Recording, RecordingWriter
from tests.bench.killed_runs import Silent, killed_while, only_run, results, resume
from tests.bench.operated_runs import SCRIPT, STAGE, files

if sys.platform == "win32":
    pytest.skip("forks benches, and kills them", allow_module_level=True)

SECOND, THIRD = "002-place-2-1", "003-place-3-1"
TWO = SCRIPT.replace("}, {}]", "}]")
CARRY = SCRIPT.replace(
    "poses = [{ x_mm = 12.0, y_mm = -8.0 }, { x_mm = -15.0, z_mm = 6.0, yaw_deg = 4.0 }, {}]",
    "poses = [{ x_mm = 12.0, y_mm = -8.0 }, { x_mm = -15.0 }, {}]",
).replace(
    "[[requirements]]",
    '[truth]\nmode = "carry"\nregistration = "first"\ncheck_every = 1\n\n[[requirements]]',
    1,
)


def record(folder: Path, out: str, progress: Silent | None = None) -> Ending:
    """The script in ``folder``, recorded beside its run."""
    rig = load_rig(folder / "rig.toml")
    script = load_script(folder / "script.toml", rig.rig.limits.set_point_c)
    return run_script(
        rig, script, folder / out, progress or Silent(), RunOptions(record=recording(folder, out))
    )[1]


def recording(folder: Path, out: str) -> Path:
    return folder / f"recorded-{out}"


def content(path: Path) -> dict[str, bytes]:
    return {
        file.relative_to(path).as_posix(): file.read_bytes()
        for file in path.rglob("*")
        if file.is_file()
    }


def whole(folder: Path, script: str) -> Path:
    """Recorded without a disturbance, as ``whole``."""
    files(folder, stage=STAGE, script=script)
    assert record(folder, "whole") is Ending.FINISHED
    assert (
        len(Recording(recording(folder, "whole")).truth)
        == len(Recording(recording(folder, "whole")).frames)
        > 1
    )
    return folder


@pytest.fixture(scope="module")
def touched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return whole(tmp_path_factory.mktemp("touched"), TWO)


@pytest.fixture(scope="module")
def carried(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A truth that is carried waits for its check."""
    return whole(tmp_path_factory.mktemp("carried"), CARRY)


def equal_after_resuming(folder: Path, out: str) -> None:
    progress = Silent()
    assert resume(folder, out, progress)[1] is Ending.FINISHED
    assert not [text for text in progress.warned if "record" in text]
    assert results(only_run(folder, out)) == results(only_run(folder, "whole"))
    assert content(recording(folder, out)) == content(recording(folder, "whole"))


def killed_and_resumed(folder: Path, words: str, method: str, kind: type) -> None:
    out = f"{method}-{kind.__name__}"
    assert killed_while(words, method, kind, lambda: record(folder, out))
    assert content(recording(folder, out)) != content(recording(folder, "whole"))
    equal_after_resuming(folder, out)


@pytest.mark.parametrize(
    ("words", "method", "kind"),
    [
        (f"'{SECOND}'", "trial", Recorder),
        (f"'{SECOND}'", "add_truth", RecordingWriter),
        (f"making {SECOND}", "replace", Path),
    ],
    ids=["finished but not recorded", "frames without their truth", "frames half written"],
)
def test_killed_where_run_and_recording_are_apart(
    touched: Path, words: str, method: str, kind: type
) -> None:
    killed_and_resumed(touched, words, method, kind)


@pytest.mark.parametrize(
    ("words", "method", "kind"),
    [(f"'{SECOND}'", "stored", CarriedTruth), (f"'{THIRD}'", "settled", Recorder)],
    ids=["carried and not yet checked", "checked but not recorded"],
)
def test_killed_while_a_truth_waits_for_its_check(
    carried: Path, words: str, method: str, kind: type
) -> None:
    killed_and_resumed(carried, words, method, kind)


def test_a_recording_that_is_gone_is_made_anew_from_the_runs_folder(touched: Path) -> None:
    assert killed_while(f"'{SECOND}'", "trial", Recorder, lambda: record(touched, "gone"))
    shutil.rmtree(recording(touched, "gone"))
    equal_after_resuming(touched, "gone")


def test_frames_of_another_run_are_left_alone_and_the_run_goes_on_without(touched: Path) -> None:
    assert killed_while(f"'{SECOND}'", "trial", Recorder, lambda: record(touched, "another"))
    path, progress = recording(touched, "another"), Silent()
    shutil.rmtree(path)
    (path / "frames" / "001-another-1").mkdir(parents=True)
    (path / "frames" / "001-another-1" / "left.png").write_bytes(b"precious")
    assert resume(touched, "another", progress)[1] is Ending.FINISHED
    told = "has frames of another run, 001-another-1 for one. The run goes on without a recording."
    assert [told in text for text in progress.warned] == [True]
    assert content(path) == {"frames/001-another-1/left.png": b"precious"}


def test_a_recording_that_cannot_be_written_is_told_once_and_ends_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    files(tmp_path, script=TWO)
    monkeypatch.setattr(RecordingWriter, "add_truth", full)
    progress = Silent()
    assert record(tmp_path, "runs", progress) is Ending.FINISHED
    told = [text for text in progress.warned if "the recording in" in text]
    assert len(told) == 1
    assert "ends here: [Errno 28] No space left on device. The run goes on" in told[0]
    assert len(read_run(only_run(tmp_path, "runs")).trials) == 2
    assert len(Recording(recording(tmp_path, "runs")).frames) == 1


def test_where_it_is_recorded_is_in_the_record(touched: Path) -> None:
    assert read_run(only_run(touched, "whole")).facts[RECORDED] == str(
        recording(touched, "whole").resolve()
    )
