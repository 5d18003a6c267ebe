"""A file is whole, or as it was, whoever writes it; a disk that is full leaves nothing beside it."""

from __future__ import annotations

import errno
import os
import re
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path, PurePosixPath, PureWindowsPath
from types import SimpleNamespace

import numpy as np
import pytest

from bench.cli.arguments import refuse_existing
from bench.config import ConfigError
from bench.files import write_synced
from bench.record.recording import RecordingWriter
from bench.record.writer import Store
from bench.rig.hand_over import write_note
from bench.run.estimate import no_room
from bench.run.live import Live
from instruments.camera.frame import FrameSet
from reports.render import write_whole
from textfiles.whole import nearest_there, refuse_no_name, replace_whole, sync

GREY = np.zeros((48, 64), np.uint8)
WRITERS: dict[str, Callable[[Path], object]] = {
    "any file": lambda path: replace_whole(path, b"new", synced=True),
    "a record's": lambda path: write_synced(path, b"new"),
    "a page": lambda path: write_whole(path, "new"),
    "a guardian's note": lambda path: write_note(path, {"new": True}),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_on_a_full_disk_it_is_as_it_was(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    monkeypatch.setattr("sys.platform", "linux")  # where it is fsync that syncs
    (path := tmp_path / "a file").write_text("old", encoding="utf-8")
    goes_on = kind == "a guardian's note"
    with nullcontext() if goes_on else pytest.raises(OSError, match=re.escape(repr(str(path)))):
        WRITERS[kind](path)
    assert [one.name for one in tmp_path.iterdir()] == ["a file"]
    assert path.read_text(encoding="utf-8") == "old"
    monkeypatch.undo()
    WRITERS[kind](path)
    assert "new" in path.read_text(encoding="utf-8")


def test_who_reads_a_file_on_windows_keeps_nobody_from_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows refuses both for a moment; elsewhere a refusal is one for good."""
    (path := tmp_path / "a file").write_text("old", encoding="utf-8")
    replace, asked = Path.replace, list[Path]()

    def busy(part: Path, target: Path) -> Path:
        asked.append(part)
        if len(asked) < 4:
            raise PermissionError(errno.EACCES, "Access is denied")
        return replace(part, target)

    monkeypatch.setattr(Path, "replace", busy)
    monkeypatch.setattr("textfiles.whole.ON_WINDOWS", False)
    with pytest.raises(PermissionError):
        replace_whole(path, b"new")
    assert [one.name for one in tmp_path.iterdir()] == ["a file"]
    monkeypatch.setattr("textfiles.whole.ON_WINDOWS", True)
    replace_whole(path, b"new")
    assert path.read_text(encoding="utf-8") == "new"
    monkeypatch.setattr("textfiles.whole.AGAIN_S", 0.0)
    asked.clear()
    with pytest.raises(PermissionError, match="open in another program") as refused:
        replace_whole(path, b"newer")
    assert refused.value.filename == str(path)


class Waited:
    """A clock that only waiting moves on."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.mark.parametrize(
    ("write", "at_most_s"),
    [
        (lambda path: write_note(path, {"new": True}), 0.25),
        (lambda path: Live(path.parent).frames(FrameSet(GREY, GREY)), 0.0),
    ],
    ids=["a guardian's note", "a running run's picture"],
)
def test_neither_a_guardian_nor_a_run_waits_for_a_program_that_keeps_its_file_open(
    write: Callable[[Path], object],
    at_most_s: float,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waited = Waited()

    def open_elsewhere(*_: object) -> Path:
        raise PermissionError(errno.EACCES, "Access is denied")

    monkeypatch.setattr(Path, "replace", open_elsewhere)
    monkeypatch.setattr("textfiles.whole.ON_WINDOWS", True)
    monkeypatch.setattr("textfiles.whole.time", waited)
    write(tmp_path / "note.json")
    assert waited.now_s <= at_most_s


@pytest.mark.parametrize(
    "name", ["CON", "nul", "aux.toml", "Com1 .txt", "ab:c", "x/LPT\u00b9/y", "C:/x:1"]
)
def test_the_name_of_a_device_or_a_stream_of_windows_is_no_files(name: str) -> None:
    refuse_no_name(PurePosixPath(name))
    with pytest.raises(OSError, match=r"no file or folder can have the name .* on Windows"):
        refuse_no_name(PureWindowsPath(name))


@pytest.mark.parametrize(
    "name", ["C:x", "C:/console/common", "//srv/share/a.toml", "COM10", "aux-1"]
)
def test_other_names_of_windows_are(name: str) -> None:
    refuse_no_name(PureWindowsPath(name))


def test_of_a_drive_that_is_not_there_nothing_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Q:\\runs of a stick that was pulled."""
    assert nearest_there(tmp_path / "a" / "b") == tmp_path.resolve()
    monkeypatch.setattr(Path, "exists", lambda _: False)
    with pytest.raises(FileNotFoundError, match="there is no"):
        nearest_there(tmp_path / "a")
    with pytest.raises(
        ConfigError, match=r"runs: can't be written: there is no .*Name another place"
    ):
        no_room(1.0, Path("runs"))
    with pytest.raises(ConfigError, match=r"--out x\.toml: it can't be written: there is no"):
        refuse_existing(Path("x.toml"), replace=True, makes_folder=True)


def new_run(path: Path) -> None:
    Store.create(path, {"script.toml": ""}).close()


def new_frame(path: Path) -> None:
    RecordingWriter(path).add("one", FrameSet(GREY, GREY), [])


@pytest.mark.parametrize("make", [new_run, new_frame])
def test_who_looks_through_a_new_folder_on_windows_keeps_it_from_nobody(
    make: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a scanner for viruses does."""
    asked = Counter[str]()

    def busy(name: str) -> Callable[[Path, Path], Path]:
        moved: Callable[[Path, Path], Path] = getattr(Path, name)

        def move(part: Path, target: Path) -> Path:
            asked["folders"] += part.is_dir()
            if part.is_dir() and asked["folders"] < 3:
                raise PermissionError(errno.EACCES, "Access is denied")
            return moved(part, target)

        return move

    for name in ("rename", "replace"):
        monkeypatch.setattr(Path, name, busy(name))
    monkeypatch.setattr("textfiles.whole.ON_WINDOWS", True)
    make(tmp_path / "new")
    assert asked["folders"] == 3
    assert [one.name for one in tmp_path.iterdir()] == ["new"]


def test_macos_syncs_otherwise_where_a_folder_of_the_network_refuses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refused(_: int, what: int) -> None:
        raise OSError(errno.ENOTSUP, "Operation not supported")

    synced = list[int]()
    monkeypatch.setitem(sys.modules, "fcntl", SimpleNamespace(F_FULLFSYNC=51, fcntl=refused))
    monkeypatch.setattr("sys.platform", "darwin")
    monkeypatch.setattr(os, "fsync", synced.append)
    sync(7)
    assert synced == [7]
