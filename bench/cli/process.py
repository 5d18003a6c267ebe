"""A command as a process: Ctrl-C has its sentence also while it all loads, and no thread or library
of others keeps it or changes its exit code.
"""

import os
import signal
import sys
import threading
import time

THREADS_S = 5.0  # how long threads of others' drivers and detectors may outlive a command


def main() -> int:
    """Run the command of this process; gives back its exit code."""
    code, words = 3, b"teatbench: interrupted: nothing was begun.\n"  # of CODES, which loads slowly

    def end(*_: object) -> None:
        os.write(2, words)
        os._exit(code)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end)
    from bench.cli.main import main as run

    words = b"teatbench: interrupted.\n"
    try:
        code, words = run(), b""
    except SystemExit as ended:  # argparse's
        code, words = int(ended.code or 0), b""
    except Exception:  # no stream takes words any more
        words = b""
    # what another's library ends the process with, at exit, is no verdict
    leave, verdict = os._exit, code
    os._exit = lambda status: leave(verdict)  # noqa: ARG005
    main_thread = threading.main_thread()
    if left := [one for one in threading.enumerate() if not (one.daemon or one is main_thread)]:
        threading.Thread(target=_wait_no_longer, args=(left, code), daemon=True).start()
    return code


def _wait_no_longer(left: list[threading.Thread], code: int) -> None:
    """Python waits at its end for each thread, also for one that never ends."""
    time.sleep(THREADS_S)
    if names := ", ".join(one.name for one in left if one.is_alive()):
        sys.stdout.flush()
        left_by = "a driver, a detector or a server"
        words = f"teatbench: ended beside what {left_by} left running: {names}.\n"
        os.write(2, words.encode())
        os._exit(code)
