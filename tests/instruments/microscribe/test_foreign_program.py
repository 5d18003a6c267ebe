"""microcmm, a program of others for the MicroScribe, drives the emulated arm. Its protocol and its
kinematics are its authors' reading of the maker's kit and share no line with ours.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import threading
import time
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import serial

from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.unit import ArmIdentity
from tests.instruments.bath.peers import foreign
from tests.instruments.microscribe.rigs import POINT, UNIT, Hand, renamed
from tests.waiting import PATIENCE_S

RESOLUTION_MM = 0.3  # a step of each encoder, added up over the arm's reach


@pytest.fixture
def microcmm(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Its package asks for Python 3.12 and runs on 3.11. It waits as long as a busy machine needs."""
    program = foreign("microcmm", "--ignore-requires-python microcmm")
    patient = SimpleNamespace(monotonic=lambda: time.monotonic() / 30.0, sleep=time.sleep)
    monkeypatch.setattr(importlib.import_module("microcmm.hci"), "time", patient)
    return program


@pytest.mark.slow
@pytest.mark.parametrize(
    "unit", [UNIT, renamed(comment="Standard")], ids=["with-beta", "without-beta"]
)
def test_it_reads_where_the_tip_is_held(microcmm: Any, unit: ArmIdentity) -> None:
    """Without "Beta" in its words the arm has no such parameter."""
    if "Beta" not in unit.names.comment:
        unit = dataclasses.replace(unit, beta=0)
    with closing(RealClock()) as clock:
        hand = Hand(clock)
        arm = ArmEmulator(hand, clock, unit=unit, accuracy_mm=0.0, tremor_mm=0.0)
        with closing(Listener(arm, clock, lock=threading.RLock(), name="arm")) as listener:
            port = serial.serial_for_url(listener.url)
            host = microcmm.MicroScribe(port, allow_untested_models=True, timeout=PATIENCE_S)
            with host:
                assert host.info.serial_number == unit.names.serial_number
                assert host.info.comment == unit.names.comment
                assert host.maxes.max_encoder == list(unit.maxima.encoders)
                host.home()
                for point in POINT + np.array([[0, 0, 0], [60, 40, 90], [250, 30, -20]]):
                    hand.point = point
                    pose = host.pose()
                    assert np.hypot.reduce([pose.x, pose.y, pose.z] - point) < RESOLUTION_MM
                arm.buttons = 0b10
                packet = host.hci.sample(encoders=6, timer=True)
                assert packet.buttons == 0b10
                assert 0 <= packet.timer <= host.maxes.max_timer
                command = host.hci.start_motion(delay_ms=5)
                streamed = [host.hci.read_packet(command) for _ in range(3)]
                host.hci.end_motion()
                assert [one.encoders for one in streamed] == [packet.encoders] * 3
        assert arm.eeprom_attempts == 0


@pytest.mark.slow
def test_it_is_not_homed_until_it_is_told(microcmm: Any) -> None:
    """An arm that was signed on again still answers; its host has to say that it is on its peg."""
    with closing(RealClock()) as clock:
        arm = ArmEmulator(Hand(clock), clock, accuracy_mm=0.0, tremor_mm=0.0)
        with closing(Listener(arm, clock, lock=threading.RLock(), name="arm")) as listener:
            for _ in range(2):
                port = serial.serial_for_url(listener.url)
                with microcmm.MicroScribe(
                    port, allow_untested_models=True, timeout=PATIENCE_S
                ) as host:
                    with pytest.raises(Exception, match="not homed"):
                        host.pose()
                    host.assume_homed()
                    counts = host.hci.sample().encoders
                    assert counts == list(UNIT.home)
