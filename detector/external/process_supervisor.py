"""Runs a command and ends it, with all that it started, when the other end of a pipe closes (Linux,
macOS).

Run by path with the pipe's number, a limit in MiB (0: none) and the command; ends as the command
did (128 + signal). The command has its own process group; on Linux orphans are adopted and
allocation is limited (RLIMIT_DATA). Standard library and fast imports only: it runs at each start
of a detector.
"""

from __future__ import annotations

import os
import select
import signal
import sys

LOOK_S = 0.05
_PR_SET_CHILD_SUBREAPER = 36  # prctl(2)


def main(arguments: list[str]) -> int:
    """Run ``arguments[2:]`` until its end, or until the pipe ``arguments[0]`` closes."""
    pipe, limit_mib, command = int(arguments[0]), int(arguments[1]), arguments[2:]
    os.set_inheritable(pipe, False)
    if sys.platform == "linux":
        import ctypes
        import resource

        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)  # adopt orphans
        if limit_mib:  # of allocation: threads and garbage collectors reserve far more addresses
            most = resource.getrlimit(resource.RLIMIT_DATA)[1]
            limit = limit_mib << 20
            limit = limit if most == resource.RLIM_INFINITY else min(limit, most)
            resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    try:
        child = os.posix_spawnp(command[0], command, os.environ, setpgroup=0)
    except OSError as error:
        os.write(2, f"{command[0]} can't be started: {error.strerror}\n".encode())
        return 127
    # the command's streams are its own: the bench sees their end when the command closes them
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    code = None
    while code is None and not select.select([pipe], [], [], LOOK_S)[0]:
        code = _reap(child)
    _end_all(child)
    return 128 + signal.SIGKILL if code is None else code if code >= 0 else 128 - code


def descendants(process: int, mark: bytes = b"") -> list[int]:
    """All processes below this one by /proc; with ``mark`` also those of its session or with that
    mark in their environment, whose parent may be gone.
    """
    living = _living()
    found: list[int] = []
    level = {process}
    if mark:
        level |= {
            pid
            for pid, (_, session) in living.items()
            if session == process or mark in _environment(pid)
        }
        found += sorted(level & living.keys())
    while level := {pid for pid, (parent, _) in living.items() if parent in level} - set(found):
        found += sorted(level)
    return found


def _environment(process: int) -> bytes:
    try:
        with open(f"/proc/{process}/environ", "rb") as file:  # noqa: PTH123 - as below
            return file.read()
    except OSError:  # it has just ended, or is another user's
        return b""


def _living() -> dict[int, tuple[int, int]]:
    """Process -> its parent and its session, of all that live."""
    found: dict[int, tuple[int, int]] = {}
    for name in os.listdir("/proc") if os.path.isdir("/proc") else ():  # noqa: PTH112, PTH208 - pathlib takes 20 ms to import
        if name.isdecimal():
            try:
                with open(f"/proc/{name}/stat", "rb") as file:  # noqa: PTH123 - the same
                    # after the name in brackets, which may hold anything: state, parent, group,
                    # session
                    state, parent, _, session = file.read().rpartition(b")")[2].split()[:4]
            except OSError:  # it has just ended
                continue
            if state != b"Z":
                found[int(name)] = int(parent), int(session)
    return found


def _reap(child: int) -> int | None:
    """Reap ended processes; the exit code of ``child``, negative for a signal, if it has ended."""
    code = None
    try:
        while (found := os.waitpid(-1, os.WNOHANG))[0]:
            if found[0] == child:
                code = os.waitstatus_to_exitcode(found[1])
    except ChildProcessError:  # none is left
        pass
    return code


def _end_all(child: int) -> None:
    try:  # noqa: SIM105 - contextlib is slow to import
        os.killpg(child, signal.SIGKILL)
    # no process is left in it; macOS says the latter where only the dead are
    except (ProcessLookupError, PermissionError):
        pass
    while left := descendants(os.getpid()):
        for process in left:
            try:
                os.kill(process, signal.SIGKILL)
            except ProcessLookupError:
                continue
        select.select([], [], [], 0.005)
        _reap(child)
    try:  # ended ones too: the process that inherits them may never reap them
        while True:
            os.waitpid(-1, 0)
    except ChildProcessError:
        return


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
