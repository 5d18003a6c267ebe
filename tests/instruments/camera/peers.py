"""Independent GigE Vision cameras: the fake of Aravis as a process of its own, and the one that the
library has in this process.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from instruments.camera.genicam import load_aravis
from instruments.errors import DeviceError
from tests.instruments.bath.peers import absent, program

FAKE = "arv-fake-gv-camera-0.8"
ADDRESS = "127.0.0.1"


def need_aravis() -> None:
    """`absent` where the library or its binding is missing."""
    try:
        load_aravis()
    except DeviceError as error:
        absent(str(error))


@contextmanager
def gige_camera(*options: str) -> Iterator[str]:
    """A GigE Vision camera as another process; gives its serial number. One at a time on a machine:
    the protocol has one port.
    """
    need_aravis()
    path = program(FAKE)
    if sys.platform == "win32":
        pytest.skip("the fake camera is a program of Linux")
    import fcntl

    with open(path, "rb") as lock:  # noqa: PTH123 - a lock on the program itself: whoever runs it, waits for who ran it before
        fcntl.flock(lock, fcntl.LOCK_EX)
        process = subprocess.Popen(
            [path, "-i", ADDRESS, "-s", "TEATBENCH", *options],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            _wait_for_it(process)
            yield "TEATBENCH"
        finally:
            process.kill()
            process.wait()


def _wait_for_it(process: subprocess.Popen[bytes]) -> None:
    aravis = load_aravis()
    for _ in range(10):  # each look takes a second
        aravis.update_device_list()
        if any("TEATBENCH" in aravis.get_device_id(i) for i in range(aravis.get_n_devices())):
            return
        if process.poll() is not None:
            pytest.fail(
                f"{FAKE} ended with {process.returncode}: does another program hold UDP port 3956"
                f" of {ADDRESS}?"
            )
    pytest.fail(f"{FAKE} does not answer at {ADDRESS}")
