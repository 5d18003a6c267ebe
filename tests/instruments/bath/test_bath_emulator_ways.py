"""JULABO's ways on the wire, by bytes typed from the fact sheet (section 1.2), and what holds for
all families.
"""

from __future__ import annotations

import itertools
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.instruments.bath.asked import EUROTHERMS, OMEGA, WATLOWS, Asked, request_of

# ---- JULABO: 1.2


@pytest.mark.parametrize("profile", ["julabo-magio", "julabo-presto"])
def test_julabo_exchanges_registers(profile: str) -> None:
    controller = Asked(profile)
    assert (
        controller.ask("17 0000 0004 0000 0004 08 0001 0000 4204 0000")
        == "17 08 00 01 00 00 42 04 00 00"
    )
    assert controller.plant.running
    assert controller.ask("17 0000 0004 0000 0001 02 0007") == "97 03"
    assert controller.ask("03 0003 0001") == "03 02 00 00"
    assert controller.ask("0F 0000 0001 01 01") == "8F 01"


def test_julabo_heats_with_a_power_of_its_own_when_that_is_digital() -> None:
    controller = Asked("julabo-presto")
    controller.ask("06 0000 0001")
    controller.ask("06 0004 001E")  # 30 %
    controller.ask("06 0001 0001")  # digital
    controller.clock.sleep(1.0)
    assert controller.ask("04 000E 0001") == "04 02 00 1E"
    controller.ask("06 0004 0000")
    controller.clock.sleep(1.0)
    assert controller.ask("04 000E 0001") == "04 02 00 00"


@pytest.mark.parametrize("code", range(4))
def test_julabo_turns_every_register_but_the_one_that_tells_the_order(code: int) -> None:
    """20.0 is 41A0 0000: no swap, little, big swapped, little
    swapped, as section 1.2 numbers them.
    """
    controller = Asked("julabo-presto")
    controller.ask(f"06 005D {code:04X}")
    assert controller.word(93) == code
    assert (
        controller.ask("04 000A 0002")
        == "04 04 " + ["41 A0 00 00", "00 00 A0 41", "A0 41 00 00", "00 00 41 A0"][code]
    )


def test_julabo_forgets_the_start_command_in_a_reset() -> None:
    controller = Asked("julabo-presto")
    controller.ask("10 0000 0004 08 0001 0000 4204 0000")
    controller.emulator.fault("controller reset")
    controller.clock.sleep(2.0)
    assert controller.ask("03 0000 0004") == "03 08 00 00 00 00 41 A0 00 00"
    assert not controller.plant.running


# ---- all of them


@pytest.mark.parametrize(
    ("profile", "place", "code"),
    [
        ("eurotherm-3200", 273, 1),
        (WATLOWS[0], 1880, 54),
        (WATLOWS[1], 2362, 54),
        (OMEGA, 0x1005, 2),
    ],
)
def test_a_controller_switched_to_manual_holds_its_output(
    profile: str, place: int, code: int
) -> None:
    controller = Asked(profile)
    controller.plant.run(33.0)
    controller.clock.sleep(60.0)
    controller.word(place)  # whoever looks moves the plant on
    controller.emulator.fault("manual mode")
    controller.plant.set_point_c = 5.0
    controller.clock.sleep(60.0)
    assert controller.word(place) == code
    assert controller.plant.power_percent == 100.0
    assert "manual mode" in controller.emulator.faults
    controller.emulator.fault("manual mode", on=False)
    controller.clock.sleep(1.0)
    assert controller.word(place) != code
    assert controller.plant.power_percent == 0.0


@pytest.mark.parametrize("profile", ["julabo-presto", *EUROTHERMS, *WATLOWS, OMEGA])
@settings(max_examples=60)
@given(
    pdu=st.binary(min_size=1, max_size=40)
    | st.builds(request_of, st.integers(1, 24), st.integers(0, 0xFFFF), st.integers(0, 260))
)
def test_any_request_gets_one_whole_answer_or_none(profile: str, pdu: bytes) -> None:
    answer = bytes.fromhex(Asked(profile).ask(pdu.hex()))  # `ask` looks at unit and check sum
    assert not answer or answer[0] & 0x7F == pdu[0] & 0x7F
    if profile in EUROTHERMS and answer and answer[0] & 0x80:
        assert answer[1] in (2, 3)


def test_every_register_pair_of_a_reading_is_whole() -> None:
    """What is asked in one request is of one moment: both words of a float, whatever time does."""
    controller = Asked("julabo-presto")
    controller.ask("10 0000 0004 08 0001 0000 4204 0000")
    for _ in range(20):
        controller.clock.sleep(7.3)
        words = bytes.fromhex(controller.ask("04 000A 0002")[6:])
        assert struct.unpack(">f", words)[0] == pytest.approx(controller.plant.pv_c, abs=1e-6)


@pytest.mark.parametrize(
    ("profile", "turns"),
    [
        ("julabo-presto", True),
        ("julabo-magio", True),
        *((name, False) for name in (*EUROTHERMS, *WATLOWS, OMEGA)),
    ],
)
def test_only_a_circulator_turns_a_pump(profile: str, turns: bool) -> None:
    plant = Asked(profile).plant
    assert not plant.pump_on
    plant.run(33.0)
    assert plant.pump_on == turns


@pytest.mark.parametrize("profile", [*EUROTHERMS, *WATLOWS, OMEGA])
def test_a_controller_does_not_see_the_float_switch_but_the_heater_is_cut(profile: str) -> None:
    controller = Asked(profile)
    controller.plant.run(33.0)
    controller.emulator.fault("low level")
    levels = []
    for _ in itertools.repeat(None, 40):
        controller.plant.advance_to(controller.plant.t_s + 10.0)
        levels.append((controller.plant.power_percent > 0.0, controller.plant.heat_w))
    assert levels[-1] == (True, 0.0)
    assert controller.plant.loop_broken
    controller.emulator.fault("low level", on=False)
    controller.plant.advance_to(controller.plant.t_s + 10.0)
    assert controller.plant.heat_w > 0.0
