"""Commands as a person writes them: words, and ``{}`` for each value, which may be several; and the
example of a real rig, with its instruments elsewhere.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NamedTuple, TypeVar

import pytest

from bench.cli.commands import COMMANDS, exit_codes
from bench.cli.main import main
from bench.rig.loading import RIGS
from instruments.clock import RealClock
from instruments.listener import Device, Listener
from tests.bench.small_cameras import write_calibration


def words(text: str, *values: object) -> list[str]:
    """The words of ``text``; each ``{}`` is the next of ``values``, or all in it for a sequence."""
    found: list[str] = []
    following = iter(values)
    for word in text.split():
        value = next(following) if word == "{}" else word
        found += map(str, value) if isinstance(value, list | tuple) else [str(value)]
    return found


def teatbench(text: str, *values: object) -> int:
    """Run a command in this process; gives back its exit code."""
    return main(words(text, *values))


class Output(NamedTuple):
    """What a command wrote."""

    out: str
    err: str


class Said:
    """Runs a command that must end with ``code``, without a traceback; gives back what it wrote."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, code: int, text: str, *values: object) -> Output:
        self._capsys.readouterr()
        try:
            found: int | str | None = teatbench(text, *values)
        except SystemExit as ended:  # argparse's
            found = ended.code
        written = Output(*self._capsys.readouterr())
        assert found == code, written.err
        if named := [name for name in COMMANDS if text.startswith(name)]:
            assert str(code) in exit_codes(max(named, key=len)), "its help doesn't name this code"
        assert "Traceback" not in written.err
        return written


NO_CAMERA = {'"opencv:0"  ': '"opencv:none1.avi"  '}


def lab_rig(folder: Path, changes: Mapping[str, str]) -> Path:
    """The example of a real rig in ``folder``, with ``changes`` in its text, small pictures."""
    text = (RIGS / "lab.example.toml").read_text(encoding="utf-8")
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (folder / "lab.toml").write_text(text, encoding="utf-8")
    write_calibration(folder, thermal=True)
    return folder / "lab.toml"


D = TypeVar("D", bound=Device)


@contextmanager
def served(make: Callable[[RealClock], D]) -> Iterator[tuple[D, str]]:
    """A device of this process in real time, and the URL that it answers at."""
    with closing(RealClock()) as clock:
        device = make(clock)
        with closing(Listener(device, clock, lock=threading.RLock(), name="device")) as listener:
            yield device, listener.url


@contextmanager
def full(most: int) -> Iterator[None]:
    """The system refuses each write as on a full disk, once a file has ``most`` bytes: pytest's own
    of a test's outcome too, where they go to a file, so a test is over before that.
    """
    resource = pytest.importorskip("resource", reason="Windows limits no file's size")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


class Person:
    """Standard input and output of a command, and who sits there: each prompt is answered when it
    stands there, by its line or by what comes first. ``text`` is all that was written.
    """

    encoding = "utf-8"

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        *answers: str | tuple[str, str | Callable[[], object]],
    ) -> None:
        self.text = ""
        self._answers = [one if isinstance(one, tuple) else (one, "") for one in answers]
        self._at = 0
        for name in ("stdin", "stdout"):
            monkeypatch.setattr(sys, name, self)

    def isatty(self) -> bool:
        return True

    def flush(self) -> None: ...

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def readline(self) -> str | None:
        """None while the prompt isn't there; "" once there is nothing more to say."""
        if not self._answers:
            return ""
        words, answer = self._answers[0]
        place = self.text.find(words, self._at)
        if place < 0 or "a = abort" not in self.text[place:]:
            return None
        del self._answers[0]
        self._at = len(self.text)
        if callable(answer):
            answer()
            answer = ""
        return f"{answer}\n"
