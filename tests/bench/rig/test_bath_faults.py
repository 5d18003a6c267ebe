"""Faults of the emulated bath, named in the rig file, seen through the driver: what it says, and that
it works again afterwards. That no fault makes a wrong value is tests/instruments/bath/test_any_order.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import load_rig
from instruments.bath.driver import OwnBath
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, InstrumentError, LinkError, ProtocolError
from tests.bench.test_config import rig_with

AT_S, FOR_S = 60.0, 30.0
FAULT = """
[emulation]
bath_start_c = 33.0
faults = [{{ instrument = "bath", name = "{name}", at_s = {at_s}, for_s = {for_s}{more} }}]
"""

# What `read` says while it lasts: an error and its words.
SAYS: list[tuple[str, str, str, type[InstrumentError], str]] = [
    ("late answer", ", amount = 6.0", "julabo-presto", LinkError, "no answer"),
    ("busy", "", "watlow-pm-map2", DeviceError, "refused: it is busy"),
    ("word order", "", "julabo-presto", ProtocolError, "its order of bytes has changed"),
    ("sensor break", "", "omega-cn7", DeviceError, "it has no temperature .*sensor"),
]


@contextmanager
def running(
    folder: Path, profile: str, name: str, more: str
) -> Iterator[tuple[EmulatedRig, OwnBath]]:
    """A bath that holds 33 degC, shortly before its fault comes."""
    path = rig_with(folder, {'profile = "julabo-presto"': f'profile = "{profile}"'})
    text = path.read_text(encoding="utf-8")
    path.write_text(
        text + FAULT.format(name=name, at_s=AT_S, for_s=FOR_S, more=more), encoding="utf-8"
    )
    rig, clock = load_rig(path), VirtualClock()
    with (
        EmulatedRig(rig, clock, seed=1) as twin,
        closing(OwnBath(twin.urls["bath"], rig.profile, clock, unit_confirmed=True)) as bath,
    ):
        bath.start(33.0)
        clock.sleep(AT_S - 1.0 - clock.now())
        assert bath.read().temp_c == pytest.approx(33.0, abs=0.15)
        assert twin.bath.faults == frozenset()
        clock.sleep(AT_S + 0.1 - clock.now())
        yield twin, bath


def true_c(twin: EmulatedRig) -> float:
    twin.world.plant.advance_to(twin.world.clock.now())
    return twin.world.plant.pv_c


@pytest.mark.slow
@pytest.mark.parametrize(("name", "more", "profile", "error", "words"), SAYS)
def test_what_the_driver_says(
    tmp_path: Path,
    name: str,
    more: str,
    profile: str,
    error: type[InstrumentError],
    words: str,
) -> None:
    with running(tmp_path, profile, name, more) as (twin, bath):
        clock = twin.world.clock
        with pytest.raises(error, match=words):
            bath.read()
        assert twin.bath.faults == {name}
        clock.sleep(AT_S + FOR_S + 12.0 - clock.now())
        assert twin.bath.faults == frozenset()
        if name == "sensor break":
            twin.world.plant.acknowledge()
        try:
            reading = bath.read()
        except InstrumentError:  # the first may still tell of what was broken
            reading = bath.read()
        assert reading.temp_c == pytest.approx(true_c(twin), abs=0.051)
        bath.safe()
        assert not twin.world.plant.running
