"""The emulated arm: byte for byte, its mechanics, its faults by name, and arms from files."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.clock import VirtualClock
from instruments.device_file import DeviceFileError
from instruments.errors import LinkError
from instruments.microscribe.configuration import StreamRequest
from instruments.microscribe.emulator import (
    ArmEmulator,
    EncoderSample,
    KinematicError,
    Mechanics,
    Stream,
    workspace,
)
from instruments.microscribe.faults import Faults
from instruments.microscribe.kinematics import COUNT_MODULUS, OutOfReachError
from instruments.microscribe.protocol import PacketDecoder, State
from instruments.microscribe.unit import SHIPPED, load_unit, shipped_unit
from tests.instruments.microscribe.rigs import AT_REST, POINT, REPLIES, UNIT, UP, Hand, Host, Rig

ARM = UNIT.geometry()
HOME_RAD = ARM.angles(UNIT.home)[0]


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("03", AT_REST),
        ("83", AT_REST),
        ("01", "81 00 6C 4F 30 5E 35 54 20 02 18 79"),
        ("02", "82 00 6C 4F 30 5E 35 54 20 02 18 79 41 60 00 00"),
        ("00", "80 00"),
        ("07", "87 00 00 00 00 6C 4F 30 5E 35 54 20 02 18 79 41 60"),
        *((f"{code:02X}", reply.hex(" ").upper()) for code, reply in REPLIES.items()),
        ("C2", "C2"),
        ("C4 10", "C4"),
        ("C4 55", ""),
        ("D2 41", "D2 41"),
        ("C1", ""),
        ("13", ""),
        ("C5", "C5"),
        ("C5 03", "C5"),
        ("03 03", f"{AT_REST} {AT_REST}"),
    ],
)
def test_golden_answers_whole_and_byte_by_byte(host: Host, asked: str, answer: str) -> None:
    assert host.ask(asked) == answer
    if not asked.startswith("C5"):
        pieces = [host.ask(byte, 0.001) for byte in asked.split()]
        assert " ".join(piece for piece in pieces if piece) == answer


def test_a_time_stamp_counts_ticks_of_the_clock(host: Host) -> None:
    host.clock.sleep(10.0 - host.clock.now())
    ticks = PacketDecoder().feed(bytes.fromhex(host.ask("23")))[0].ticks
    assert ticks == int(10.0 / 0.001111)
    host.clock.sleep(18.3)
    later = PacketDecoder().feed(bytes.fromhex(host.ask("23")))[0].ticks
    assert later is not None
    assert later < 9001 + 200  # wrapped at about 18 s


@pytest.mark.parametrize(
    ("words", "answer", "after", "eeprom_attempts"),
    [
        ("BEGIN", "C2 C5", State.FINDING_BAUD, 0),
        (
            "IMMC",
            "C9 4D 53 43 52 00" + " CD 46 6F 72 6D 61 74 20 44 48 30 2E 35 00" * 2,
            State.SESSION,
            1,
        ),
        ("B", "C2", State.SESSION, 0),
    ],
)
def test_words_in_a_live_session_are_commands_and_homing_off_the_peg_ruins_positions(
    fresh: Host, words: str, answer: str, after: State, eeprom_attempts: int
) -> None:
    host = fresh
    host.arm.faults.inject("old session alive", 1)
    host.plug_in_again()
    assert host.ask("03") == AT_REST
    host.hand.point = POINT
    assert host.counts() != UNIT.home
    assert host.ask(words.encode().hex()) == answer
    assert (host.arm.state, host.arm.eeprom_attempts) == (after, eeprom_attempts)
    if words == "B":  # the hand trembles
        assert np.abs(np.subtract(host.counts()[:5], UNIT.home[:5])).max() <= 3


def test_the_letter_o_swallows_24_bytes(host: Host) -> None:
    assert host.ask("4F " + "03 " * 24) == "CF"  # a stream by differences, and nothing differs
    assert host.ask("03") == AT_REST
    assert host.ask("4F 00 00 02 " + "01 " * 23 + "03") == f"CF {AT_REST}"  # 26 with seven encoders


@pytest.mark.slow
@given(st.lists(st.binary(min_size=1, max_size=40), max_size=6))
def test_whatever_it_receives_it_can_be_signed_on_again(noise: list[bytes]) -> None:
    with contextlib.closing(Host()) as host:
        for data in noise:
            host.ask(data.hex(), 0.001)
        host.ask("C5 " * 28)  # an unfinished stream command swallows 26 bytes
        host.session()
        assert len(host.counts()) == 6


# Streams


def stream(
    delay_ms: int, *, command: str = "03", mask: int = 0, deltas: tuple[int, ...] = (0,) * 6
) -> str:
    """The stream command, typed field by field as the sheet has it."""
    return (
        f"CF {delay_ms:04X} {command} {mask:02X} "
        + "00 " * 8
        + " ".join(f"{delta:04X}" for delta in deltas)
    )


@pytest.mark.parametrize(
    ("command", "rate_hz"),
    [("03", 822.9), ("01", 960.0), ("23", 720.0), ("00", 5760.0)],
    ids=["six encoders", "five", "time stamps", "buttons alone"],
)
def test_without_delay_a_stream_is_as_fast_as_115200_baud(
    host: Host, command: str, rate_hz: float
) -> None:
    got = len(host.packets(stream(0, command=command), 0.25))
    assert got == pytest.approx(rate_hz / 4, abs=1)


def test_by_differences_a_joint_or_a_pedal_sends_when_it_changes(host: Host) -> None:
    assert host.ask(stream(0, deltas=(20, 0, 0, 0, 0, 0)), 0.5) == "CF"
    for point in (POINT, POINT + 50.0):
        host.hand.point = point
        assert len(host.packets("", 0.01)) == 1
    host.hand.point = None
    assert host.ask(stream(0, mask=0x01), 0.5).endswith("CF")
    seen = []
    for buttons in (1, 1, 0, 2, 3, 2, 0):
        host.arm.buttons = buttons
        seen += [packet.buttons & 1 for packet in host.packets("", 0.01)]
    assert seen == [1, 0, 1, 0]


def test_a_slow_drift_is_measured_from_the_last_packet() -> None:
    drift = [EncoderSample(0, (count % 16384,)) for count in range(16380, 16414)]
    running = Stream(StreamRequest(0, 3, encoder_deltas=(5, 0, 0, 0, 0, 0)), drift[0])
    fired = [look.counts[0] for look in drift[1:] if running.fires(look)]
    assert fired == [1, 6, 11, 16, 21, 26], "counts go round at 16384"


def test_the_marker_comes_back_in_its_place_and_any_command_ends_a_stream(host: Host) -> None:
    assert host.ask(stream(10), 0.025) == f"CF {AT_REST} {AT_REST}"
    assert host.ask("D2 55", 0.025) == f"D2 55 {AT_REST} {AT_REST}"
    host.ask("C9", 0.0)
    assert host.arm.state is State.SESSION
    assert host.ask("", 1.0) == ""


def test_a_stream_goes_on_for_the_next_host(host: Host) -> None:
    host.ask(stream(10))
    host.plug_in_again()
    assert host.ask("", 0.105) == " ".join([AT_REST] * 10), (
        "the arm doesn't notice who is plugged in"
    )
    assert host.ask("03") == AT_REST
    assert host.ask("", 0.1) == ""


# Mechanics


def mechanics(
    hand: Hand, *, seed: int = 1, accuracy_mm: float = 0.0, tremor_mm: float = 0.0
) -> Mechanics:
    return Mechanics(ARM, UNIT.home, hand, seed=seed, accuracy_mm=accuracy_mm, tremor_mm=tremor_mm)


@pytest.fixture
def grip() -> Hand:
    return Hand(VirtualClock(), POINT)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_error_is_a_smooth_function_of_the_pose_of_the_size_asked_for(
    grip: Hand, seed: int
) -> None:
    error = KinematicError(ARM, HOME_RAD, seed=seed, accuracy_mm=0.23)
    poses = workspace(ARM, HOME_RAD, np.random.default_rng(99))
    here, near = error.at(poses), error.at(poses + 0.005)  # about 3 mm at the tip
    # a shift of all would be another frame
    assert np.linalg.norm(here.mean(axis=0)) < 0.02
    sizes = np.linalg.norm(here, axis=1)
    assert sizes.mean() == pytest.approx(0.23, rel=0.04)
    assert sizes.max() < 1.0
    assert np.linalg.norm(here - near, axis=1).max() < 0.01
    arm = mechanics(grip, seed=seed, accuracy_mm=0.23)
    assert arm.counts(1) == arm.counts(500)
    tip = ARM.forward(arm.solve(POINT, UP).counts)[0][0]
    expected = error.at(ARM.angles(mechanics(grip).solve(POINT, UP).counts))[0]
    np.testing.assert_allclose(tip - POINT, expected, atol=1e-6)


def test_the_tremor_has_the_size_asked_for_and_is_new_with_each_packet(grip: Hand) -> None:
    arm = mechanics(grip, tremor_mm=0.05)
    off = np.concatenate([arm.tremor(block) for block in range(3)])
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) == pytest.approx(0.05, rel=0.05)
    assert np.linalg.norm(off.mean(axis=0)) < 0.005
    pose = arm.solve(POINT, UP)
    for packet in (1, 2, 1023, 1024, 3):
        shaken = pose.counts + pose.counts_per_mm @ off[packet]
        assert arm.counts(packet) == (np.rint(shaken) % COUNT_MODULUS).tolist()
        np.testing.assert_allclose(ARM.forward(shaken)[0][0] - POINT, off[packet], atol=1e-3)
    assert arm.counts(7) == mechanics(grip, tremor_mm=0.05).counts(7)
    assert (arm.tremor(0) != mechanics(grip, seed=2, tremor_mm=0.05).tremor(0)).any()


def test_what_the_arm_cannot_reach_is_reported_beforehand(fresh: Host) -> None:
    fresh.arm.check_reach(POINT, UP)
    with pytest.raises(OutOfReachError, match="out of reach"):
        fresh.arm.check_reach(POINT * 5, UP)


# Faults

REST = bytes.fromhex(AT_REST)


@pytest.mark.parametrize(
    ("fault", "hit"),
    [
        ("bit 7 in payload", lambda got: sum(byte >> 7 for byte in got) == 2 and len(got) == 14),
        ("lost byte", lambda got: len(got) == 13),
        (
            "flipped bit",
            lambda got: sum((a ^ b).bit_count() for a, b in zip(got, REST, strict=True)) == 1,
        ),
        ("garbage between packets", lambda got: got[5:] == REST),
        ("silent", lambda got: not got),
    ],
)
def test_a_bad_cable(host: Host, fault: str, hit: Callable[[bytes], bool]) -> None:
    host.arm.faults.inject(fault, 2)
    assert [hit(bytes.fromhex(host.ask("03"))) for _ in range(2)] == [True, True]
    assert host.ask("03") == AT_REST


def test_a_fault_may_spare_the_first_answers(host: Host) -> None:
    host.arm.faults.inject("bit 7 in payload", 2, after=3)
    whole = [host.ask("03") == AT_REST for _ in range(7)]
    assert whole == [True] * 3 + [False] * 2 + [True] * 2


def test_letters_that_start_an_eeprom_write_are_noticed(host: Host) -> None:
    for number, letter in enumerate(["43", "47", "C3", "C7", "D0", "D1", "50", "51"], 1):
        assert host.ask(letter) == ""
        assert host.arm.eeprom_attempts == number
        assert host.ask("03") == AT_REST


def test_an_echo_only_after_repeats(fresh: Host) -> None:
    fresh.arm.faults.inject("echo after repeats", amount=4)
    assert [fresh.ask("C5 49 4D 4D 43") for _ in range(3)] == [""] * 3
    fresh.session()
    assert fresh.ask("C5") == "C5"
    assert fresh.ask("49 4D 4D 43" * 3) == "", "again so many in the next sign-on"
    fresh.arm.faults.clear("echo after repeats")
    assert fresh.ask("C5 49 4D 4D 43") == "49 4D 4D 43"


def test_power_goes_and_comes_back_with_the_home_counts_wherever_the_stylus_is(host: Host) -> None:
    host.arm.faults.inject("power loss")
    assert [host.ask("03"), host.ask("C5 49 4D 4D 43")] == ["", ""]
    host.hand.point = POINT
    host.arm.faults.clear("power loss")
    assert host.ask("03") == "", "the session is gone"
    host.session()
    assert np.abs(np.subtract(host.counts()[:5], UNIT.home[:5])).max() <= 3


def test_an_arm_that_was_not_homed_gives_plausible_wrong_counts(host: Host) -> None:
    host.arm.faults.inject("never homed")
    off = np.abs(np.subtract(host.counts(), UNIT.home))
    assert (off >= 500).all()
    assert (off <= 1000).all()
    host.arm.power_cycle()
    host.session()
    assert host.counts() != UNIT.home, "nor at the next power-up, while the fault is on"
    host.arm.faults.clear("never homed")
    assert host.ask("C2") == "C2"
    assert host.counts() == UNIT.home, "homed on the peg"


def test_a_pedal_bounces_for_a_while(host: Host) -> None:
    host.arm.faults.inject("pedal bounce", 2)
    for pressed in (1, 0):
        host.arm.buttons = pressed
        seen = []
        for _ in range(20):
            seen.append(host.packets("00", 0.0)[0].buttons)
            host.clock.sleep(0.0009)
        assert {*seen} == {0, 1}
        host.clock.sleep(0.01)
        assert {host.packets("00", 0.0)[0].buttons for _ in range(20)} == {pressed}
    host.arm.buttons = 1
    assert {host.packets("00", 0.0)[0].buttons for _ in range(20)} == {1}, "only twice"


def test_a_slow_adapter_holds_every_answer_back_and_keeps_their_order(host: Host) -> None:
    host.arm.faults.inject("slow adapter")
    start = host.clock.now()
    host.link.write(b"\x03\xc9")
    assert host.link.read(20, 1.0).hex(" ").upper() == f"{AT_REST} C9 4D 53 43 52 00"
    assert host.clock.now() - start == pytest.approx(0.016)
    host.link.write(b"\xc9")
    host.arm.faults.clear("slow adapter")
    host.link.write(b"\xca")
    assert host.link.read(10, 1.0) == b"\xc9MSCR\0\xcaDX\0"


def test_the_cable_breaks_at_a_given_byte(host: Host) -> None:
    for passes in (0, 5, 14, 20):
        host.arm.faults.inject("disconnect", amount=passes)
        got = b""
        with pytest.raises(LinkError, match="hung up"):  # noqa: PT012 - until it breaks
            for _ in range(3):
                host.link.write(b"\x03")
                got += host.link.read(min(14, passes - len(got)), 0.05)
                host.link.drain(0.01)
        assert got == (REST * 2)[:passes]
        host.plug_in_again()
        assert host.ask("03") == AT_REST, "the arm kept its session, and the fault is over"


def test_the_same_seed_gives_the_same_damage() -> None:
    def garbled(seed: int) -> list[bytes]:
        faults = Faults(seed)
        faults.inject("flipped bit")
        faults.inject("garbage between packets")
        return [faults.damage(bytes(14)) for _ in range(5)]

    assert garbled(1) == garbled(1) != garbled(2)


@pytest.mark.parametrize(
    ("fault", "amount", "why"),
    [
        ("sick", None, r'no fault "sick" \(there are: silent, flipped bit'),
        ("silent", 3.0, r'"silent" has no amount 3.*slow adapter" \(0.016'),
        ("slow adapter", -0.1, r'"slow adapter" has no amount -0.1.*slow adapter" \(0.016'),
    ],
)
def test_a_fault_or_an_amount_that_is_none_is_refused(
    fault: str, amount: float | None, why: str
) -> None:
    with pytest.raises(ValueError, match=why):
        Faults(0).inject(fault, amount=amount)


# Arms by file

# Made up: six encoders of other resolutions, longer links, and no "Beta".
SIX = """
[names]
product = "MicroScribeX6"
product_id = "MSCR"
model = "LX"
serial_number = "60001"
comment = "Standard"
format = "Format DH0.5"
version = "HCI 2.1"

[maxima]
button_mask = 1
timer = 0x3FFF
analogs = [0, 0, 0, 0, 0, 0, 0, 0]
analog_low_bits = 0
encoders = [0x3FFF, 0x3FFF, 0x3FFF, 0x1FFF, 0x1FFF, 0x0FFF]

[parameters]
alpha = [0, 16384, 0, 16384, -16384, -16384]
a = [0, 1200, 13000, 600, -400, 400]
d = [9000, -900, 0, 11000, 300, -5500]

[peg]
counts = [0, 6238, 13736, 8196, 6386, 100]
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "arm.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_what_ships() -> None:
    assert [path.stem for path in SHIPPED.glob("*.toml")] == ["40937"]
    assert shipped_unit("40937") == UNIT
    why = "no arm ships under the serial number 1; there is 40937"
    with pytest.raises(FileNotFoundError, match=why):
        shipped_unit("1")


def test_an_arm_of_six_encoders_is_read_where_the_hand_holds_it(
    tmp_path: Path, make: Callable[..., Rig]
) -> None:
    unit = load_unit(written(tmp_path, SIX))
    with contextlib.closing(Host(unit)) as host:
        host.session()
        assert host.ask("CB") == "CB 36 30 30 30 31 00"
        assert host.ask("C6").endswith("3F FF 3F FF 3F FF 1F FF 1F FF 0F FF")
        assert host.ask("D3") == "", "without Beta"
        assert host.counts() == (0, 6238, 13736, 8196, 6386, 100)
        host.arm.buttons = 3
        assert host.ask("00") == "80 01", "one pedal"
    rig = make(unit, accuracy_mm=0.0)
    driver = rig.signed_on()
    for point in ((-200.0, 260.0, 150.0), (300.0, 100.0, 200.0)):
        rig.hand.point = np.array(point)
        reading = driver.read(16)
        assert np.linalg.norm(reading.tip_mm - point) < 0.2
        assert reading.axis @ UP > 0.9995


def test_all_faults_of_a_file_at_once(tmp_path: Path) -> None:
    text = SIX
    for old, new in {
        '"60001"': '"6000é"',
        "button_mask = 1": "button_mask = 200",
        "0x1FFF, 0x0FFF]": "0x1FFF, 0x4000]",
        "d = [9000, -900, 0, 11000, 300, -5500]": "dd = 1",
        "6386, 100]": "6386]",
    }.items():
        assert old in text
        text = text.replace(old, new)
    with pytest.raises(DeviceFileError) as caught:
        load_unit(written(tmp_path, text))
    assert [keys for keys, _ in caught.value.faults] == [
        ("names", "serial_number"), ("maxima", "button_mask"), ("maxima", "encoders", 5),
        ("parameters", "d"), ("parameters", "dd"), ("peg", "counts"),
    ]  # fmt: skip
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "arm.toml"))
    for part in (
        "names.serial_number: '6000é' is no name for an arm: ASCII",
        "maxima.button_mask: input should be less than or equal to 127 (found 200)",
        "parameters.d: field required;",
        "parameters.dd: unknown key (found 1)",
    ):
        assert part in message


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[names]", "[names", "not TOML: "),
        ("d = [9000", "beta = 3\nd = [9000", 'beta has no meaning without "Beta" in names.comment'),
        (
            "[0x3FFF, 0x3FFF, 0x3FFF, 0x1FFF, 0x1FFF, 0x0FFF]",
            "[0x3FFF, 0x3FFF, 0, 0, 0, 0]",
            "can't be moved in three dimensions",
        ),
        ("counts = [0,", 'counts = ["0",', "peg.counts.0: input should be a valid integer"),
    ],
)
def test_a_file_that_describes_no_arm(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in SIX
    with pytest.raises(DeviceFileError, match=r"arm\.toml: ") as caught:
        load_unit(written(tmp_path, SIX.replace(old, new)))
    assert message in str(caught.value)


def test_an_arm_below_its_table_cannot_be_emulated(tmp_path: Path) -> None:
    text = SIX.replace("d = [9000", "d = [-32768")
    with pytest.raises(ValueError, match="never comes above the table"):
        ArmEmulator(Hand(VirtualClock()), VirtualClock(), unit=load_unit(written(tmp_path, text)))
