"""A running child process under limits: lines out and in, memory watched, and its end. Threads read
its standard output and error within bounds, so no child can block the bench or fill its memory.
"""

from __future__ import annotations

import contextlib
import math
import os
import queue
import secrets
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, cast

from detector.external import process_supervisor
from detector.external.lines import shown

# what programs need to start; no passwords
ENVIRONMENT = (
    *("PATH", "HOME", "USER", "LOGNAME", "LANG", "LANGUAGE", "LC_ALL", "LC_CTYPE", "LC_NUMERIC"),
    *("LC_MESSAGES", "TZ", "TMPDIR", "TEMP", "TMP", "SYSTEMROOT", "SYSTEMDRIVE", "WINDIR"),
    *("COMSPEC", "PATHEXT", "USERPROFILE", "APPDATA", "LOCALAPPDATA", "PROGRAMDATA"),
    *("PROGRAMFILES", "NUMBER_OF_PROCESSORS", "PROCESSOR_ARCHITECTURE"),
)
# lines are UTF-8; a Python on Windows would read them as the system's own encoding
UTF8 = {"PYTHONUTF8": "1"}
# by which it and all that it started are known, whatever became of the processes between
MARK = "TEATBENCH_DETECTOR"
# times the memory allowed, a process: numpy's threads alone allocate 40 MiB each and never touch
# most of it
HARD_LIMIT = 4.0
LONGEST_LINE = 1 << 20
KEPT_STDERR = 1 << 14
_LOOKS_S = 0.02, 0.25  # between two looks at its memory, by how much is left
_MIB_A_S = 2048.0  # a process on one core touches new memory as fast as that
_END_S = 5.0
_UNASKED_LINES = 100
_MIB = 1 << 20


class ChildFault(Exception):  # noqa: N818 - the child's fault
    """The child is of no more use; the message is a sentence that begins with a verb."""


class ChildSilent(ChildFault):
    """Nothing came within the time."""


class Child:
    """A started command. ``passed``: variables beside those of `ENVIRONMENT`. Raises OSError."""

    def __init__(
        self,
        command: Sequence[str],
        folder: Path | None,
        memory_mib: float | None,
        stopwatch: Callable[[], float],
        passed: Sequence[str] = (),
    ) -> None:
        self._memory_mib, self._stopwatch = memory_mib, stopwatch
        self._mark = secrets.token_hex(16)
        hard_mib = 0 if memory_mib is None else math.ceil(HARD_LIMIT * memory_mib)
        known = {n: os.environ[n] for n in (*ENVIRONMENT, *passed) if n in os.environ}
        env = {**UTF8, **known, MARK: self._mark}
        self._process, self._supervisor_pipe = _spawn(command, folder, env, hard_mib)
        self._in = cast(IO[bytes], self._process.stdin)
        self._lines, self._stderr = _Lines(), _StderrTail()
        self._readers = []
        for name, *how in (
            ("answers", self._process.stdout, self._lines.take),
            ("errors", self._process.stderr, self._stderr.take),
        ):
            reader = threading.Thread(None, _read, f"detector's {name}", how, daemon=True)
            self._readers.append(reader)
            reader.start()

    def ask(self, line: bytes) -> None:
        """Send a line. Raises ChildFault where the child has closed its input."""
        try:
            self._in.write(line)
            self._in.flush()
        except OSError:
            raise ChildFault(self._ending()) from None

    def line(self, limit_s: float) -> bytes:
        """Its next line. Raises ChildSilent after ``limit_s``, ChildFault at end, flood, memory."""
        deadline_s, look_s = self._stopwatch() + limit_s, _LOOKS_S[0]
        while True:
            left_s = deadline_s - self._stopwatch()
            if left_s <= 0:
                raise ChildSilent(self._lines.unfinished and f", stuck{self._lines.unfinished}")
            try:
                line = self._lines.whole.get(timeout=min(left_s, look_s))
            except queue.Empty:
                look_s = self.check_limits()
                continue
            if line is None:
                raise ChildFault(self._lines.problem or self._ending())
            return line

    def check_limits(self) -> float:
        """Seconds in which it can't take what is left of its memory. Raises ChildFault for too much
        memory, or where its supervisor is gone.
        """
        code = self._process.poll()
        # it ends as its command does, and that is no signal's number
        if code is not None and code < 0:
            raise ChildFault(f"has lost its supervisor, which was ended by signal {-code}")
        used_mib = resident_mib(self._process.pid)
        if self._memory_mib is not None and used_mib is not None and used_mib > self._memory_mib:
            allowed = f"{self._memory_mib:g} MiB are allowed"
            raise ChildFault(f"took {used_mib:.0f} MiB of memory, {allowed}")
        if self._memory_mib is None or used_mib is None:
            return _LOOKS_S[1]
        return min(max((self._memory_mib - used_mib) / _MIB_A_S, _LOOKS_S[0]), _LOOKS_S[1])

    def stderr(self) -> str:
        """What came on its standard error since this was last asked."""
        return self._stderr.taken_out()

    def end(self, grace_s: float = 0.0) -> None:
        """End it with all that it started, at once or ``grace_s`` after its input was closed; may
        be repeated. What it wrote to standard error can still be asked for.
        """
        if grace_s > 0:
            with contextlib.suppress(OSError):  # what was never sent can't be sent now
                self._in.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(grace_s)
        if self._supervisor_pipe is not None:
            os.close(self._supervisor_pipe)
            self._supervisor_pipe = None
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_END_S)
        # what the supervisor has left, was ended before it could end, or never knew
        until_s = self._stopwatch() + _END_S
        while sys.platform == "linux" and self._stopwatch() < until_s:
            left = process_supervisor.descendants(self._process.pid, self._mark.encode())
            if not left:
                break
            for pid in left:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.kill(pid, signal.SIGKILL)
            select.select([], [], [], 0.005)
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        with contextlib.suppress(OSError):  # what was never sent can't be sent now
            self._in.close()
        pipes = self._process.stdout, self._process.stderr
        for reader, pipe in zip(self._readers, pipes, strict=True):
            reader.join(_END_S)
            # else some process that got away holds the other end: its number must not be given to
            # another file
            if pipe and not reader.is_alive():
                pipe.close()

    def _ending(self) -> str:
        """How it ended; it has closed its output."""
        try:
            code = self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            return "closed its output"
        after = self._lines.unfinished
        if code > 128 and sys.platform != "win32":
            return f"was ended by signal {code - 128}{after}"
        return f"ended with exit code {code}{after}"


def resident_mib(process: int) -> float | None:
    """Resident memory of all processes below, MiB, shared pages each time; None without /proc."""
    if not Path("/proc/self/statm").is_file():
        return None
    pages = 0
    for pid in process_supervisor.descendants(process):
        with contextlib.suppress(OSError):  # it has just ended
            pages += int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / _MIB


class _Lines:
    """Whole lines out of bytes; None is the end. Stops reading a child that floods."""

    def __init__(self) -> None:
        self.whole: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self.problem = ""
        self._rest = b""

    @property
    def unfinished(self) -> str:
        """A clause about a line that was begun and not ended; empty where there is none."""
        return f' in the middle of a line that begins "{shown(self._rest)}"' if self._rest else ""

    def take(self, data: bytes) -> bool:
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST_LINE or any(len(line) > LONGEST_LINE for line in lines):
            self.problem = f"wrote a line of more than {LONGEST_LINE} bytes"
        elif self.whole.qsize() + len(lines) > _UNASKED_LINES:
            self.problem = f"wrote more than {_UNASKED_LINES} lines without being asked"
        if not self.problem:
            for line in lines:
                self.whole.put(line)
        if self.problem or not data:
            self.whole.put(None)
        return bool(data) and not self.problem


class _StderrTail:
    """The end of what came on standard error."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._data, self._lost = b"", 0

    def take(self, data: bytes) -> bool:
        with self._lock:
            whole = self._data + data
            self._data = whole[-KEPT_STDERR:]
            self._lost += len(whole) - len(self._data)
        return bool(data)

    def taken_out(self) -> str:
        with self._lock:
            text = self._data.decode("utf-8", errors="replace").strip()
            text = f"({self._lost} bytes before this are left out)\n{text}" if self._lost else text
            self._data, self._lost = b"", 0
        return text


def _read(pipe: IO[bytes], take: Callable[[bytes], bool]) -> None:
    """Give ``take`` the bytes as they come, and b"" at the end."""
    while True:
        try:
            data = os.read(pipe.fileno(), 1 << 16)
        except (OSError, ValueError):  # closed from our side
            data = b""
        if not take(data):
            return


def _spawn(
    command: Sequence[str], folder: Path | None, env: Mapping[str, str], hard_mib: int
) -> tuple[subprocess.Popen[bytes], int | None]:
    """The process in a session of its own, and its supervisor's pipe; None on Windows."""
    settings: dict[str, Any] = {"cwd": folder, "env": env}
    settings |= dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    if os.name != "posix":
        names = "CREATE_NEW_PROCESS_GROUP", "CREATE_NO_WINDOW"
        detached = sum(getattr(subprocess, name, 0) for name in names)
        return subprocess.Popen(command, creationflags=detached, **settings), None  # noqa: S603
    read_end, write_end = os.pipe()
    python = [sys.executable, "-I", "-S", str(Path(process_supervisor.__file__))]
    supervised = [*python, str(read_end), str(hard_mib), *command]
    settings |= {"pass_fds": (read_end,), "start_new_session": True}
    try:
        return subprocess.Popen(supervised, **settings), write_end  # noqa: S603
    except OSError:
        os.close(write_end)
        raise
    finally:
        os.close(read_end)
