"""Rigs and hosts. Whatever a test does, no arm on a rig has received a byte that writes, or letters
without an end before them.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator

import pytest

from instruments.microscribe.unit import ArmIdentity
from tests.instruments.microscribe.rigs import UNIT, Host, Rig


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    yield
    assert not [thread.name for thread in threading.enumerate() if thread.name.endswith("emulator")]


@pytest.fixture
def make() -> Iterator[Callable[..., Rig]]:
    rigs: list[Rig] = []

    def build(unit: ArmIdentity = UNIT, **options: float) -> Rig:
        rigs.append(Rig(unit, **options))
        return rigs[-1]

    yield build
    for rig in rigs:
        rig.close()
        assert not {b for b in (0xC3, 0xC7, 0xD0, 0xD1) if bytes([b]) in rig.ear.heard}
        assert rig.ear.heard.count(b"IMMC") == rig.ear.heard.count(b"\xc5IMMC")
        assert rig.arm.eeprom_attempts == 0


@pytest.fixture
def rig(make: Callable[..., Rig]) -> Rig:
    return make()


@pytest.fixture
def fresh() -> Iterator[Host]:
    """Before any session."""
    with contextlib.closing(Host(tremor_mm=0.0)) as host:
        yield host


@pytest.fixture
def host(fresh: Host) -> Host:
    fresh.session()
    return fresh
