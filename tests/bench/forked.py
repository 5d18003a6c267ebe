"""`teatbench` in a process of its own that is forked from one which has loaded the bench, so that
it starts in milliseconds instead of seconds, and is `bare`.

Windows can't fork: there it is started as usual. The start itself is what `tests/bench/cli/test_cli.py`
and `tests/test_run_py.py` test.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from subprocess import DEVNULL, PIPE, STDOUT, TimeoutExpired
from typing import IO, Any

from tests.conftest import ROOT

# modules by name: the server imports them, the tests need not
PRELOADED = [
    "bench.cli.run", "bench.cli.rig", "bench.cli.calibrate", "bench.cli.arm", "bench.cli.dry_run",
    "bench.report.page", "bench.run.start", "detector.fused.detector", "detector.thesis.detector",
    "matplotlib.backends.backend_svg", "uvicorn", "bench.console.app", "tests.bench.marked_bench",
]  # fmt: skip


def context() -> Any:
    """How processes are forked from the server, which is started with the first of them."""
    forking = multiprocessing.get_context("forkserver")  # type: ignore[attr-defined, unused-ignore]
    forking.set_forkserver_preload(PRELOADED)
    return forking


def as_in_a_shell() -> None:
    """Signals do what they do to a command that a shell has started."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        usual = signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL
        signal.signal(getattr(signal, name), usual)


def take(streams: Sequence[Connection]) -> None:
    """Make these the process's standard input, output and error."""
    for number, stream in enumerate(streams):
        os.dup2(stream.fileno(), number)
    for stream in streams:
        stream.close()
    lines = 1 if os.isatty(1) else -1
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 - the process's own
    sys.stdout = open(1, "w", lines, encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", 1, encoding="utf-8", closefd=False)  # noqa: SIM115


def _child(
    streams: Sequence[Connection],
    arguments: Sequence[str],
    cwd: str,
    environment: Mapping[str, str],
    terminal: bool,
) -> None:
    gc.freeze()  # what the server has loaded stays
    if terminal:
        os.setsid()
    take(streams)
    if terminal:
        import fcntl
        import termios

        fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    as_in_a_shell()
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = ["teatbench", *arguments]

    from bench.cli.main import main
    from tests.undrawn import bare

    with bare():
        sys.exit(main(arguments))


class Forked:
    """A command that runs: of `subprocess.Popen[str]` what the tests use."""

    def __init__(
        self,
        arguments: Sequence[str],
        stdin: int,
        stdout: int,
        stderr: int,
        cwd: Path,
        environment: Mapping[str, str],
        terminal: bool,
    ) -> None:
        self.stdin: IO[str] | None = None
        self.stdout: IO[str] | None = None
        self.stderr: IO[str] | None = None
        theirs: list[int] = []
        for name, asked in (("stdin", stdin), ("stdout", stdout), ("stderr", stderr)):
            if asked == PIPE:
                ends = os.pipe()
                far, near = ends if name == "stdin" else ends[::-1]
                setattr(
                    self, name, os.fdopen(near, "w" if name == "stdin" else "r", encoding="utf-8")
                )
                theirs.append(far)
            elif asked == DEVNULL:
                theirs.append(os.open(os.devnull, os.O_RDWR))
            else:
                theirs.append(os.dup(theirs[-1] if asked == STDOUT else asked))
        streams = [Connection(end) for end in theirs]
        self._process = context().Process(
            target=_child,
            args=(streams, arguments, str(cwd), dict(environment), terminal),
            daemon=True,
        )
        self._process.start()
        for stream in streams:
            stream.close()
        self.pid: int = self._process.pid

    @property
    def returncode(self) -> int | None:
        return self.poll()

    def poll(self) -> int | None:
        """Its exit code, or None while it runs."""
        code: int | None = self._process.exitcode
        return code

    def wait(self, timeout: float | None = None) -> int:
        """Its exit code, once it has ended."""
        self._process.join(timeout)
        code = self.poll()
        if code is None:
            raise TimeoutExpired("teatbench", timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        """As `kill`, by any signal."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """What it still writes, by standard output and error, up to its end."""
        import threading

        found = {"stdout": "", "stderr": ""}

        def read(name: str, stream: IO[str]) -> None:
            found[name] = stream.read()

        open_streams = [(name, getattr(self, name)) for name in found if getattr(self, name)]
        readers = [threading.Thread(target=read, args=one, daemon=True) for one in open_streams]
        for reader in readers:
            reader.start()
        self.wait(timeout)
        for reader in readers:
            reader.join(timeout)
        self.close()
        return found["stdout"], found["stderr"]

    def close(self) -> None:
        """This side's ends of its pipes."""
        for stream in (self.stdin, self.stdout, self.stderr):
            if stream is not None:
                with suppress(BrokenPipeError):
                    stream.close()

    def __enter__(self) -> Forked:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
        self.wait()


Running = Forked | subprocess.Popen[str]


def begin(
    arguments: Sequence[object],
    *,
    stdin: int = DEVNULL,
    stdout: int = PIPE,
    stderr: int = STDOUT,
    cwd: Path = ROOT,
    environment: Mapping[str, str] | None = None,
    terminal: bool = False,
) -> Running:
    """`teatbench` with these arguments. A stream is a file's descriptor or one of `subprocess`'s
    constants; with `terminal` standard input becomes its controlling terminal.
    """
    words = [str(one) for one in arguments]
    given = dict(os.environ if environment is None else environment)
    if hasattr(os, "fork"):
        return Forked(words, stdin, stdout, stderr, cwd, given, terminal)
    return subprocess.Popen(
        [sys.executable, "-m", "bench.cli", *words],
        stdin=stdin,
        stdout=stdout,
        stderr=stderr,
        encoding="utf-8",
        cwd=cwd,
        env={**given, "PYTHONPATH": str(ROOT)},
    )
