"""Each family's behaviour on the wire, by bytes typed from the fact sheet (section 1): addresses, areas,
codes, refusals, silence; and what holds for all families."""

from __future__ import annotations

import struct
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.instruments.bath.devices import EUROTHERMS, NO_PUMP, OMEGA, WATLOWS, Asked

eurotherm = pytest.mark.parametrize("profile", EUROTHERMS)


# ---- Eurotherm: 1.1


@eurotherm
def test_eurotherm_bytes(profile: str) -> None:
    Asked(profile).talk("""
        03 8002 0002 > 03 04 41 A0 00 00  # PV in the IEEE area, high word first
        04 8002 0002 > 04 04 41 A0 00 00  # 3 and 4 are the same
        03 0001 0001 > 03 02 00 C8        # PV as an integer, one decimal
        03 00C7 0001 > 03 02 00 01        # standby
        06 00C7 0000 > 06 00 C7 00 00     # normal
        03 8002 0001 > 83 02              # half a pair
        03 8003 0002 > 83 02              # from an odd address
        06 8004 4204 > 86 02              # function 6 on a pair
        10 8004 0001 02 4204 > 90 02
        06 00C7 0003 > 86 03              # a mode that is none
        06 0001 0000 > 86 02              # the process value can't be written
        2B 0E 01 00 >                     # an unsupported function gets no reply
        17 0000 0001 0002 0001 02 0001 >
        0F 0000 0001 01 01 >
        08 0000 1234 > 08 00 00 12 34     # loopback
        08 0001 1234 > 88 03              # with another sub-function
    """)


@eurotherm
def test_eurotherm_has_each_quantity_in_both_areas(profile: str) -> None:
    Asked(profile).talk("""
        10 8004 0002 04 4207 0000 > 10 80 04 00 02  # the target set point: 33.75
        03 0002 0001 > 03 02 01 52                  # the same as an integer: 33.8
        06 0002 014A > 06 00 02 01 4A               # 33.0
        03 8004 0002 > 03 04 42 04 00 00
        03 818E 0002 > 03 04 00 01 80 00            # 199: one word, padded
    """)


@eurotherm
def test_eurotherm_confirms_a_lone_register_that_it_discards(profile: str) -> None:
    controller = Asked(profile)
    before = controller.word(0x1234)  # not configured: undefined, and no exception
    controller.talk("10 1234 0001 02 0007 > 10 12 34 00 01")
    assert controller.word(0x1234) == before != 7
    controller.talk("06 1234 0007 > 86 02\n10 1234 0002 04 0007 0007 > 90 02")


@eurotherm
def test_eurotherm_knows_exceptions_2_and_3_only(profile: str) -> None:
    controller = Asked(profile)
    controller.emulator.fault("busy")
    controller.talk("03 8002 0002 >")


@eurotherm
def test_eurotherm_status_word(profile: str) -> None:
    controller = Asked(profile)
    assert controller.word(75) & 0x0020 == 0
    controller.break_for(1.0, "sensor break")
    assert controller.word(75) & 0x0020 == 0x0020  # bit 5
    assert controller.float(0x8002) == 20.0  # undocumented, and so the worst: the last value
    # the fast status byte is the lower half
    assert int(controller.ask("07")[3:], 16) & 0x20 == 0x20


@eurotherm
def test_eurotherm_is_silent_for_5_s_when_it_resets_and_goes_on(profile: str) -> None:
    controller = Asked(profile)
    controller.talk("10 8004 0002 04 4204 0000\n06 00C7 0000")
    controller.break_for(4.7, "controller reset")
    controller.talk("03 8002 0002 >")
    controller.clock.sleep(0.2)
    assert controller.float(0x8004) == 33.0
    assert controller.plant.running


@eurotherm
def test_eurotherm_follows_the_remote_set_point_where_it_is_set_so(profile: str) -> None:
    controller = Asked(profile)
    # local, parameter 2: 33; remote, parameter 26: 31; 276: which of them
    controller.talk("10 8004 0002 04 4204 0000\n10 8034 0002 04 41F8 0000")
    for choice, aim_c in (("", 33.0), ("06 0114 0001", 31.0), ("06 0114 0000", 33.0)):
        if choice:
            controller.talk(choice)
        assert controller.plant.set_point_c == aim_c
        assert controller.float(0x8004) == 33.0


@eurotherm
def test_eurotherm_ramp_output_limit_and_rate(profile: str) -> None:
    controller = Asked(profile)
    controller.talk("""
        10 803C 0002 04 4220 0000  # parameter 30: 40 %
        10 8046 0002 04 3F80 0000  # parameter 35: 1 K/min
        10 8004 0002 04 4204 0000
        06 00C7 0000
    """)
    controller.clock.sleep(180.0)
    assert controller.float(0x800A) == pytest.approx(23.0, abs=0.1)  # parameter 5, after the ramp
    controller.ask("10 8046 0002 04 0000 0000")
    controller.clock.sleep(30.0)
    assert controller.float(0x8008) == pytest.approx(40.0)  # parameter 4
    if profile == "eurotherm-3200":
        # parameter 103: 40 % of 1.8 K/min
        assert controller.float(0x80CE) == pytest.approx(0.4 * 1.8, abs=0.3)


# ---- Watlow: 1.3


def test_watlow_speaks_fahrenheit_until_it_is_set() -> None:
    controller = Asked(WATLOWS[0])
    controller.emulator.fault("fahrenheit")
    assert controller.float(360, low_first=True) == pytest.approx(68.0)
    assert controller.word(2490) == 30
    controller.ask("06 09BA 000F")
    assert controller.float(360, low_first=True) == 20.0
    assert controller.word(2490) == 15


def test_watlows_display_has_a_unit_of_its_own() -> None:
    """Map 2: 2308 is the display's, and Modbus is degF as shipped (Communications p. 13)."""
    controller = Asked(WATLOWS[1])
    controller.emulator.fault("fahrenheit")
    assert controller.word(2308) == 15
    assert controller.float(360, low_first=True) == pytest.approx(68.0)
    controller.ask("06 0904 001E")
    controller.ask("06 0904 000F")
    assert controller.float(360, low_first=True) == pytest.approx(68.0)


@pytest.mark.parametrize("profile", WATLOWS)
def test_watlow_word_order_and_input_error(profile: str) -> None:
    controller = Asked(profile)
    assert controller.word(362) == 61
    controller.break_for(1.0, "word order")
    assert controller.float(360) == 20.0
    controller.break_for(1.0, "sensor break")
    assert controller.word(362) == 65


# ---- Omega: 1.4


def test_omega_bytes() -> None:
    Asked(OMEGA).talk("""
        03 1000 0001 > 03 02 00 C8     # 20.0
        06 1001 014A > 06 10 01 01 4A  # set point 33.0
        02 0814 0001 > 02 01 00        # stopped
        05 0814 FF00 > 05 08 14 FF 00  # run
        02 0814 0001 > 02 01 01
        05 0814 0001 > 85 03
        01 0814 0001 > 81 01           # 2, 3, 5 and 6 only
        04 1000 0001 > 84 01
        10 1001 0001 02 014A > 90 01
        03 2000 0001 > 83 02
    """)


def test_omega_runs_by_its_coil_and_shows_an_error_code_for_a_broken_sensor() -> None:
    controller = Asked(OMEGA)
    controller.talk("06 1001 014A\n05 0814 FF00")
    assert controller.plant.running
    controller.clock.sleep(60.0)
    controller.ask("03 1000 0001")
    assert controller.word(0x1012) == 1000  # 100 %, in tenths
    controller.break_for(1.0, "sensor break")
    assert controller.word(0x1000) == 0x8003
    controller.emulator.fault("wrong length")
    controller.talk("02 0814 0001 > 02 00\n05 0814 0000")
    assert not controller.plant.running


# ---- JULABO: 1.2


@pytest.mark.parametrize("profile", ["julabo-magio", "julabo-presto"])
def test_julabo_exchanges_registers(profile: str) -> None:
    controller = Asked(profile)
    controller.talk("""
        17 0000 0004 0000 0004 08 0001 0000 4204 0000 > 17 08 00 01 00 00 42 04 00 00
        17 0000 0004 0000 0001 02 0007 > 97 03
        03 0003 0001 > 03 02 00 00
        0F 0000 0001 01 01 > 8F 01
    """)
    assert controller.plant.running


def test_julabo_heats_with_a_power_of_its_own_when_that_is_digital() -> None:
    controller = Asked("julabo-presto")
    controller.talk("06 0000 0001\n06 0004 001E\n06 0001 0001")  # started; 30 %; digital
    controller.clock.sleep(1.0)
    controller.talk("04 000E 0001 > 04 02 00 1E\n06 0004 0000")
    controller.clock.sleep(1.0)
    controller.talk("04 000E 0001 > 04 02 00 00")


@pytest.mark.parametrize("code", range(4))
def test_julabo_turns_every_register_but_the_one_that_tells_the_order(code: int) -> None:
    """20.0 is 41A0 0000: no swap, little, big swapped, little
    swapped, as section 1.2 numbers them.
    """
    controller = Asked("julabo-presto")
    controller.ask(f"06 005D {code:04X}")
    assert controller.word(93) == code
    turned = ["41 A0 00 00", "00 00 A0 41", "A0 41 00 00", "00 00 41 A0"][code]
    controller.talk(f"04 000A 0002 > 04 04 {turned}")


def test_julabo_forgets_the_start_command_in_a_reset() -> None:
    controller = Asked("julabo-presto")
    controller.ask("10 0000 0004 08 0001 0000 4204 0000")
    controller.break_for(2.0, "controller reset")
    controller.talk("03 0000 0004 > 03 08 00 00 00 00 41 A0 00 00")
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


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["julabo-presto", *NO_PUMP])
@given(
    pdu=st.binary(min_size=1, max_size=40)
    | st.builds(
        partial(struct.pack, ">BHH"),
        st.integers(1, 24),
        st.integers(0, 0xFFFF),
        st.integers(0, 260),
    )
)
def test_any_request_gets_one_whole_answer_or_none(profile: str, pdu: bytes) -> None:
    answer = bytes.fromhex(Asked(profile).ask(pdu.hex()))  # `ask` looks at unit and check sum
    assert not answer or answer[0] & 0x7F == pdu[0] & 0x7F
    if profile in EUROTHERMS and answer and answer[0] & 0x80:
        assert answer[1] in (2, 3)
