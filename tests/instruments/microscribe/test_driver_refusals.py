"""What is refused at sign-on, each with its own error and with what to try."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from instruments.errors import LimitError, LinkError, ProtocolError
from instruments.microscribe.errors import (
    InterfaceBoxError,
    NoMicroScribeError,
    ParameterLengthError,
    SilentArmError,
    UnknownFormatError,
    UnstableUnitError,
)
from instruments.microscribe.protocol import State
from instruments.microscribe.unit import UNIT_40937
from tests.instruments.microscribe.driver_rig import Rig, renamed
from tests.instruments.microscribe.impostors import Ghost, Parrot, sign_on_to


def test_silence_at_sign_on(rig: Rig) -> None:
    rig.arm.faults.inject("silent")
    driver = rig.driver()
    with pytest.raises(
        SilentArmError,
        match=(
            r"nothing answers the sign-on \(asked C5 49 4D 4D 43, got nothing, after 3"
            r" s\).*switched on"
        ),
    ):
        driver.sign_on()
    assert rig.clock.now() == pytest.approx(3.0, abs=0.02)
    assert b"BEGIN" not in rig.ear.heard


@pytest.mark.parametrize(("answer_s", "waited"), [(0.12, "3 s"), (20.0, "20 s")])
def test_an_arm_that_has_echoed_is_waited_for_as_long_as_is_asked(
    answer_s: float, waited: str
) -> None:
    echoing = Parrot(lambda data: data if b"IMMC" in data else b"")
    with pytest.raises(SilentArmError, match=rf"then fell silent \(.*after {waited}\)"):
        sign_on_to(echoing, answer_s=answer_s)


def test_the_interface_box_is_refused(rig: Rig) -> None:
    rig.arm.faults.inject("IBOX")
    with pytest.raises(InterfaceBoxError, match="Immersion Interface Box"):
        rig.driver().sign_on()
    assert rig.ear.heard.endswith(b"BEGIN\xc5")
    assert rig.arm.state is State.FINDING_BAUD


def test_another_parameter_format_is_refused(make: Callable[..., Rig]) -> None:
    rig = make(renamed(format="Format DH1.0"))
    with pytest.raises(
        UnknownFormatError, match=r"not understood: 'Format DH1.0', not 'Format DH0.5'"
    ):
        rig.driver().sign_on()
    assert b"\xc0" not in rig.ear.heard
    assert rig.ear.heard.endswith(b"\xc5")


def test_a_parameter_block_of_another_length_is_refused(rig: Rig) -> None:
    rig.arm.faults.inject("parameter block of another length")
    with pytest.raises(ParameterLengthError, match="says it has 34 bytes; 36 are understood"):
        rig.driver().sign_on()
    assert rig.ear.heard.endswith(b"\xc5")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            bytes,
            NoMicroScribeError,
            r"not that of a MicroScribe \(asked 42 45 47 49 4E, got 42 45 47 49 4E\).*loop-back",
        ),
        (
            lambda _: b"ERROR\r\n",
            NoMicroScribeError,
            "something answers, but not as a MicroScribe.*plain text",
        ),
        (lambda _: b"\r\nGrbl 1.1h ['$' for help]\r\n", NoMicroScribeError, "GRBL board.*stage"),
        (lambda _: b"error:20\r\n", NoMicroScribeError, "motion controller"),
        (lambda _: bytes.fromhex("01 83 02 C0 F1"), NoMicroScribeError, "Modbus frames.*bath"),
        (lambda _: bytes.fromhex("F8 00 80 FC"), NoMicroScribeError, "baud rate right"),
        (lambda data: data if b"IMMC" in data else b"", SilentArmError, "echoed, then fell silent"),
        (
            lambda data: b"IMMC" if b"IMMC" in data else b"IMMCMSCR\0" if data == b"BEGIN" else b"",
            LinkError,
            "does not answer .asked C8",
        ),
        (
            lambda data: (
                b"IMMC" if b"IMMC" in data else b"MSCR\0" if data == b"BEGIN" else b"\xc9X\0"
            ),
            ProtocolError,
            "doesn't begin with C8 .asked C8, got C9 58 00",
        ),
    ],
    ids=[
        "loop-back",
        "text",
        "GRBL",
        "controller",
        "Modbus",
        "noise",
        "silent after the echo",
        "silent after a late echo",
        "wrong reply",
    ],
)
def test_what_is_no_arm_is_refused_with_a_guess(
    change: Callable[[bytes], bytes], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        sign_on_to(Parrot(change))


def test_nothing_is_known_before_sign_on(rig: Rig) -> None:
    driver = rig.driver()
    known: list[Callable[[], object]] = [
        lambda: driver.identity,
        lambda: driver.maxima,
        lambda: driver.parameters,
        lambda: driver.geometry,
    ]
    asks: list[Callable[[], object]] = [
        driver.poll,
        driver.read,
        driver.confirm_homed,
        driver.home,
        driver.record,
    ]
    asks += [lambda: driver.set_baud(9600), lambda: driver.wait_for_pedal(1.0)]
    for ask in known + asks:
        with pytest.raises(LimitError, match="Sign on first"):
            ask()
    assert rig.ear.heard == b""


def test_an_arm_that_never_says_the_same_twice_is_refused() -> None:
    replies, turn = UNIT_40937.replies(), iter(range(100))

    def answer(code: int) -> bytes:
        return (
            bytes([code]) + str(next(turn)).encode("ascii") + b"\0"
            if code == 0xCB
            else replies.get(code, b"")
        )

    with pytest.raises(UnstableUnitError, match=r"differently each of 3 times.*cable"):
        sign_on_to(Ghost(answer))
