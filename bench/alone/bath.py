"""One bath without a rig file: opened by its port and the name of its family, read, set, and put into standby."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bench.config import ConfigError, did_you_mean
from instruments.bath.driver import Bath
from instruments.bath.profile import Profile, ProfileError, load_profile, profile_names
from instruments.capture import NO_CAPTURE, Captures
from instruments.clock import RealClock
from instruments.errors import InstrumentError


def profile_of(name: str) -> Profile:
    """A shipped profile by its name, or one of the user's own by its path. Raises ConfigError."""
    known = profile_names()
    if not name.endswith(".toml") and name not in known:
        near, there = did_you_mean(name, known) or ".", ", ".join(known)
        raise ConfigError.plain(f'no profile "{name}"{near} Shipped: {there}; or the path of a .toml file.')
    try:
        return load_profile(Path(name) if name.endswith(".toml") else name)
    except ProfileError as error:
        raise ConfigError.plain(str(error)) from error


@contextmanager
def open_bath(
    url: str, profile: Profile, *, allow_inferred: bool = False, identify: bool = True, capture: Captures = NO_CAPTURE
) -> Iterator[tuple[Bath, RealClock]]:
    """The bath at ``url`` in real time, and its clock. Raises InstrumentError."""
    clock = RealClock()
    try:
        tap = capture.tap("bath", clock)
        bath = Bath(url, profile, clock, allow_inferred=allow_inferred, identify=identify, tap=tap)
        try:
            yield bath, clock
        finally:
            bath.close()
    finally:
        clock.close()


def described(bath: Bath) -> dict[str, object]:
    """Everything that one look tells: plain text, numbers and None; units are in the names."""
    reading = bath.read()
    run = bath.profile.row("run")
    return {
        **bath.identity,
        "temp_c": reading.temp_c,
        "set_point_c": bath.get("set_point"),
        "run": run.label(bath.get("run")),
        "output_percent": reading.power_percent,
        "external_c": reading.external_c,
        "safety_c": reading.safety_c,
        "alarm": reading.alarm,
        "alarm_text": bath.profile.alarm_text(reading.alarm) if reading.alarm else "none",
        "warning": reading.warning,
        "remote": reading.remote,
        "pump": bath.pump,
        "comms_loss": bath.profile.comms_loss,
    }


def is_started(bath: Bath) -> bool:
    """Whether the controller is told to work, as it tells itself."""
    return bath.get("run") == bath.profile.row("run").values["started"]


def set_point(bath: Bath, wanted_c: float) -> str:
    """Change the set point and nothing else; what the bath says after it. Raises LimitError outside the profile's range."""
    bath.set_point(wanted_c)
    state = "it is heating or cooling to it now" if is_started(bath) else "the bath is in standby"
    return f"set point {bath.get('set_point'):.2f} degC; {state}"


def standby(bath: Bath) -> str:
    """Heater off, whatever the controller is; what the bath says after it. Raises InstrumentError where it can't be reached."""
    bath.safe()
    try:
        return f"in standby at {bath.read().temp_c:.2f} degC"
    except InstrumentError as error:  # what matters is done; an alarm or a broken sensor doesn't undo it
        return f"in standby; no temperature: {error}"
