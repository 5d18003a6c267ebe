"""The USB adapter's latency timer: how long it holds bytes back, and how to make it stop.

An FTDI chip waits 16 ms by default for more bytes, which is longer than the pause of a sign-on and costs as much a poll
(../shared/instruments/microscribe.md, Link). Linux shows and sets the time under /sys; elsewhere there is nothing to see. It
may not know the link.
"""

from __future__ import annotations

from pathlib import Path

SYSFS = Path("/sys")
WANTED_MS = 1


def latency_warning(port: str, sysfs: Path = SYSFS) -> str | None:
    """What to do about a slow adapter behind ``port``, as "/dev/ttyUSB0" or a link to it; None when all is well or not known."""
    if "://" in port or not port.startswith("/"):
        return None
    name = Path(port).resolve().name
    timer = sysfs / "bus" / "usb-serial" / "devices" / name / "latency_timer"
    try:
        latency_ms = int(timer.read_text(encoding="ascii"))
    except (OSError, ValueError):  # no USB adapter, one without a timer, or no Linux: nothing is known, so nothing to say
        return None
    if latency_ms <= WANTED_MS:
        return None
    return (
        f"the USB adapter {name} holds bytes back for {latency_ms} ms, which every poll waits for. "
        f"Set it with: echo {WANTED_MS} | sudo tee {timer.as_posix()} (until it is plugged in again), or stream instead of polling"
    )
