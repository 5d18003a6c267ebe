"""The bench as its guardian sees it: a process that runs, is stopped or is being ended."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Literal

State = Literal["dying", "stopped", "alive"]

if sys.platform == "win32":
    import _winapi

    SYNCHRONIZE, PROCESS_TERMINATE = 0x0010_0000, 0x0001  # winnt.h
    ENDED_BY_GUARDIAN = 1  # its exit code

    class WatchedBench:
        """The process with this number. It is held, so that its number can't become another's; a
        venv's python.exe starts Python as its child, so that the bench is no guardian's parent.
        """

        def __init__(self, process: int) -> None:
            self._held = 0
            with suppress(OSError):  # it has ended: its pipe says so
                access = SYNCHRONIZE | PROCESS_TERMINATE
                self._held = _winapi.OpenProcess(access, False, process)

        def state(self) -> State:
            """``dying`` for one that has ended, even where its pipe is open."""
            waits = self._held and _winapi.WaitForSingleObject(self._held, 0)
            return "alive" if not self._held or waits else "dying"

        def end(self) -> bool:
            """End it; whether that was possible."""
            with suppress(OSError):
                if self._held:
                    _winapi.TerminateProcess(self._held, ENDED_BY_GUARDIAN)
                    return True
            return False

else:

    class WatchedBench:
        """The process with this number, which started this one."""

        def __init__(self, process: int) -> None:
            self._process = process

        def state(self) -> State:
            """What the system does with it; ``alive`` where there is no /proc.

            The system is ending it, or has, seconds before its pipe closes on a busy Linux, and a
            forked process may hold that pipe open for good.
            """
            status = Path(f"/proc/{self._process}/status")
            try:
                lines = status.read_text(encoding="ascii", errors="replace").splitlines()
            except OSError:
                return "dying" if Path("/proc/self/status").exists() else "alive"
            text = dict(line.split(":", 1) for line in lines)
            pending = int(text["SigPnd"], 16) | int(text["ShdPnd"], 16)
            if "VmRSS" not in text or pending & 1 << (signal.SIGKILL - 1):
                return "dying"
            return "stopped" if text["State"].split()[0] == "T" else "alive"

        def end(self) -> bool:
            """End it; whether that was possible."""
            # else it has ended meanwhile, and its number may be another's
            if self._process != os.getppid():
                return False
            with suppress(OSError):
                os.kill(self._process, signal.SIGKILL)
                return True
            return False
