"""Baths of ASCII by a profile alone: three invented protocols, each answered by a device typed here for it,
and no Python beside the profile. Numbers of fixed width with sign and zeros, scaled whole numbers, check
sums by name, the part of a version that counts, and controllers without a register for run."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.bath.checksums import Checksum, checked, summed
from instruments.bath.driver import OwnBath
from instruments.bath.line_emulator import LineEmulator
from instruments.bath.profile import (
    AlarmCode,
    Capabilities,
    IdentityCheck,
    LineProfile,
    Model,
    NumberUnit,
    OrderFrom,
    RegisterProfile,
    load_profile,
)
from instruments.bath.rows import FIELDS, Kind, LineRow, Order, Row, Strict, Table
from instruments.clock import VirtualClock
from instruments.device_file import DeviceFileError
from instruments.errors import InstrumentError, LimitError, LinkError
from instruments.listener import Connection
from tests.instruments.bath.devices import LineDevice, calm_plant, driven

FIXED, SCALED, BYTES = (
    (Path(__file__).parent / "own" / f"{name}.toml").read_text(encoding="utf-8")
    for name in ("fixed", "scaled", "bytes")
)


class Device(LineDevice):
    """A controller at 20 degC of one of these protocols: ``said`` answers a line without its ends."""

    def __init__(self, said: Callable[[str], str | None], end: bytes = b"\r") -> None:
        self.said = said
        self.end = end
        self.told: list[str] = []

    def take(self, connection: Connection, line: bytes) -> None:
        self.told.append(line.decode("ascii"))
        if (answer := self.said(self.told[-1])) is not None:
            connection.send(answer.encode("ascii") + b"\r")


def fixed_device() -> Device:
    state = {"P": "+020.00", "K": "00"}
    hours = iter(range(100, 10_000))

    def said(line: str) -> str | None:
        assert line.startswith("#01"), line
        what = line[3:]
        if what.startswith("S"):
            assert re.fullmatch(r"S[+-]\d{3}\.\d\d", what), "a number has seven characters"
            state["P"] = what[1:]
            return "#01OK"
        if what in ("K20", "K21"):
            state["K"] = f"0{what[-1]}"
            return "#01OK"
        answers = {"R": "#01R+020.00", "P": f"#01P{state['P']}", "K?": f"#01K{state['K']}"}
        answers |= {"U": "#01U C", "V": f"#01V TC-9 up {next(hours)} h"}
        return answers.get(what, "#01E7")

    return Device(said)


def xor(text: str) -> str:
    value = 0
    for sign in text[1:]:
        value ^= ord(sign)
    return f"{text}{value:02X}"


def scaled_device(bad: set[str] | None = None) -> Device:
    state = {"S": "00500"}

    def said(line: str) -> str | None:
        if xor(line[:-2]) != line:
            return None
        what, value = line[1], line[2:-2]
        if what == "S" and value:
            assert len(value) == 5
            state["S"] = value
            return xor("ok")
        answer = {"T": "$T02000", "S": f"$S{state['S']}", "V": "$VBox 3"}[what]
        return xor(answer)[:-2] + "00" if what in (bad or set()) else xor(answer)

    return Device(said, b"\r\n")


def crc(text: str) -> str:
    """Modbus's check sum, low byte first, in hexadecimal digits."""
    value = 0xFFFF
    for sign in text.encode():
        value ^= sign
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return f"{text}{value & 0xFF:02X}{value >> 8:02X}"


def bytes_device(model: str) -> Device:
    state: dict[str, Any] = {"S": "20.0", "run": 0, "external": 0, "alarm": 0}

    def said(line: str) -> str | None:
        what = line[:-4]
        assert crc(what) == line
        if what.startswith("S") and what != "S":
            state["S"] = what[1:]
            return crc("+")
        if what in ("G0", "G1"):
            state["run"] = int(what[1])
            return crc("+")
        second = state["run"] + 2 * state["external"]
        answers = {"T": "20.0 C", "S": f"{state['S']} C", "M": model, "W": "-unknown"}
        answers |= {"Z": f"{state['alarm']} {second} 0 0 7", "X1": "31.0 C", "X2": "none"}
        return crc(answers.get(what, "-unknown"))

    device = Device(said)
    device.state = state  # type: ignore[attr-defined]
    return device


def profile_of(folder: Path, text: str) -> LineProfile:
    path = folder / "own.toml"
    path.write_text(text, encoding="utf-8")
    profile = load_profile(path)
    assert isinstance(profile, LineProfile)
    return profile


def bath_on(device: Device, profile: LineProfile) -> AbstractContextManager[OwnBath]:
    """A driver on a device under virtual time."""
    return driven(device, profile, VirtualClock())


def test_numbers_of_fixed_width_a_relay_and_a_version_that_counts_hours(tmp_path: Path) -> None:
    device = fixed_device()
    with bath_on(device, profile_of(tmp_path, FIXED)) as bath:
        assert bath.identity["version"] == "TC-9"
        bath.start(33.0)
        reading = bath.read()
        assert (reading.temp_c, reading.set_point_c, reading.running) == (20.0, 33.0, True)
        bath.set_point(-4.5)
        bath.safe()
        assert bath.read().running is False
    written = [line for line in device.told if line[3] in "SK" and line != "#01K?"]
    assert written == ["#01S+033.00", "#01K21", "#01S-004.50", "#01K20"]


def test_scaled_numbers_with_a_check_sum_and_a_set_point_for_standby(tmp_path: Path) -> None:
    device, profile = scaled_device(), profile_of(tmp_path, SCALED)
    with bath_on(device, profile) as bath:
        assert bath.read().running is False
        bath.start(33.25)
        assert (bath.read().running, bath.read().set_point_c) == (True, 33.25)
        bath.safe()
        assert (bath.read().running, bath.read().set_point_c) == (False, 5.0)
        with pytest.raises(LimitError, match="takes 6 to 36 degC"):
            bath.set_point(5.0)
    written = [line for line in device.told if line.startswith("$S") and len(line) > 4]
    assert written == [xor("$S03325"), xor("$S00500")]
    wrong = pytest.raises(LinkError, match="check sum of its answer is wrong")
    with wrong, bath_on(scaled_device({"V"}), profile):
        pass


@pytest.mark.parametrize(
    ("model", "external", "missing"),
    [
        ("TOP 3", 31.0, "power"),  # it answers "-unknown" to W
        ("MID 1", None, "power"),
        ("LOW 1", None, "external, power"),
    ],
)
def test_bytes_models_and_a_check_sum_of_16_bits(
    tmp_path: Path, model: str, external: float | None, missing: str
) -> None:
    device = bytes_device(model)
    with bath_on(device, profile_of(tmp_path, BYTES)) as bath:
        reading = bath.read()
        assert (reading.external_c, reading.power_percent, reading.alarm) == (external, None, 0)
        assert bath.identity["not offered by this model"] == missing
        with pytest.raises(LimitError, match="not offered by this model"):
            bath.get("power")
        with pytest.raises(LimitError, match=r"nothing tells .*its manual says nothing"):
            bath.start(33.0)
        bath.standby()  # needs no unit
        with pytest.raises(InstrumentError, match="they are not both degC"):
            bath.confirm_unit(68.0)
        bath.confirm_unit(20.2)
        bath.start(33.0)
        state = device.state  # type: ignore[attr-defined]
        state["alarm"] = 4
        assert bath.read().alarm == 4
        assert bath.profile.means(4, "level")
        state["external"] = 1
        with pytest.raises(InstrumentError, match="control_sensor = external where internal"):
            bath.read()
        with pytest.raises(InstrumentError, match=r"needs control_sensor = internal"):
            bath.set_point(30.0)
        bath.safe()
        assert state["run"] == 0


def test_no_emulator_answers_by_the_profile_that_the_driver_reads(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no emulator answers as a INVENTED; there are julabo"):
        LineEmulator(calm_plant(), profile_of(tmp_path, FIXED), VirtualClock())


@pytest.mark.parametrize(
    ("text", "old", "new", "message"),
    [
        (FIXED, 'form = "+000.00"', 'form = "+3.2"', "is no width of a number"),
        (FIXED, "mask = 2\n", 'mask = 2\nshows = { standby = ["x"] }\n', "not of its words"),
        (FIXED, "[-5.0, 36.0]", "[5.0, 36.0]\noptional = true", "can't do without it"),
        (SCALED, 'checksum = "xor"', 'checksum = "md5"', "input should be"),
        (SCALED, "standby = 0, started = 1", "standby = 0, started = 2", "shows 0 or 1"),
        (BYTES, 'offers = ["external"]', 'offers = ["extern"]', "there is no row 'extern'"),
        (BYTES, 'lacks = ["power"]', 'lacks = ["run"]', "can't do without the row 'run'"),
        (BYTES, 'shows = ["TOP <text>"]\n', "", "either 'shows' or 'unanswered' is needed"),
        (BYTES, 'external = { ask = "X2" }', "external = { asks = 1 }", "rows.asks"),
        (BYTES, '"internal" }', '"inner" }', "that can show 'inner'"),
        (BYTES, "number_unit = { note", 'number_unit = { rows = ["unit"], note', "no row 'unit'"),
    ],
)
def test_what_is_wrong_with_a_profile_is_told(
    tmp_path: Path, text: str, old: str, new: str, message: str
) -> None:
    assert old in text
    with pytest.raises(DeviceFileError, match=message):
        profile_of(tmp_path, text.replace(old, new, 1))


def row(form: str, scale: float = 1.0) -> LineRow:
    told = {"name": "x", "ask": "?", "tell": "S<number>", "form": form, "scale": scale}
    return LineRow.model_validate(
        told | {"range": (-999.0, 999.0), "access": "rw", "evidence": "CERTAIN"}
    )


@pytest.mark.parametrize(
    ("form", "scale", "value", "command"),
    [
        ("+000.00", 1.0, 33.0, "S+033.00"),
        ("+000.00", 1.0, -5.5, "S-005.50"),
        ("+000.00", 1.0, -0.001, "S+000.00"),
        ("000.0", 1.0, 7.25, "S007.2"),
        ("000.0", 1.0, -7.25, "S-007.2"),
        ("00000", 0.01, 33.0, "S03300"),
        ("+0000", 0.1, -4.0, "S-0040"),
        ("", 1.0, 33.0, "S33.00"),
        ("+000,0", 1.0, 33.0, "S+033,0"),
    ],
)
def test_numbers_by_their_form(form: str, scale: float, value: float, command: str) -> None:
    assert row(form, scale).command(value) == command


@pytest.mark.parametrize(
    ("reply", "line", "value"),
    [
        ("T=<number> C", "T= -5.5 C", -5.5),
        ("T=<number> C", "T=-  5.5 C", -5.5),
        ("T=<number> C", "T=021,30 C", 21.3),
        ("#01R<number>", "#01R+020.50", 20.5),
        ("<number>", "00033", 33.0),
    ],
)
def test_numbers_as_controllers_write_them(reply: str, line: str, value: float) -> None:
    assert row("").model_copy(update={"reply": reply}).decode(line) == value


@pytest.mark.parametrize(
    ("reply", "line", "text"),
    [
        ("<text>", "JULABO FP50", "JULABO FP50"),
        ("VERSION <text>", "VERSION OUR BATH 3.1", "OUR BATH 3.1"),
        ("V <text> SN <word>", "V OUR BATH SN 77", "77"),
        ("<text> rev <text>", "BATH rev 3", "BATH rev 3"),
        ("#01V <word> up <number> h", "#01V TC-9 up 310 h", "TC-9"),
    ],
)
def test_the_part_of_a_text_that_counts(reply: str, line: str, text: str) -> None:
    told = {"name": "version", "ask": "V", "reply": reply, "evidence": "CERTAIN"}
    assert LineRow.model_validate(told).text(line) == text


def test_a_number_that_is_too_wide_is_not_sent() -> None:
    with pytest.raises(ValueError, match="does not fit into"):
        row("00.0").command(100.0)


@given(value=st.floats(-999.0, 999.0), form=st.sampled_from(["+000.00", "0000.0", "000.000"]))
def test_what_is_sent_is_read_back_within_its_last_place(value: float, form: str) -> None:
    one = row(form)
    sent = one.command(value)[1:]
    assert one.decode(sent) == pytest.approx(one.sent(value), abs=1e-9)
    assert abs(one.sent(value) - value) <= 0.5 * 10.0**-one.places + 1e-9
    assert len(sent.lstrip("+-")) == len(form.lstrip("+"))


@pytest.mark.parametrize(
    ("name", "line", "digits"),
    [
        ("xor", "GPGLL,5057.970,N,00146.110,E,142451,A", "27"),  # NMEA 0183's example
        ("lrc", "\x01\x03\x00\x00\x00\x01", "FB"),  # Modbus over serial line, 2.5.2.2's sum
        ("crc16", "123456789", "374B"),  # CRC-16/MODBUS checks as 4B37, sent low byte first
        ("sum", "123456789", "DD"),  # 477 modulo 256
    ],
)
def test_check_sums_by_published_examples(name: Checksum, line: str, digits: str) -> None:
    assert summed(line, name) == line + digits
    assert checked(line + digits, name) == line
    assert checked(line + digits.lower(), name) == line
    assert checked(line[:-1] + "~" + digits, name) is None
    assert checked(digits, name) is None


# ---- docs/add-a-bath.md

PAGE = Path(__file__).parents[3] / "docs" / "add-a-bath.md"


def test_the_page_explains_every_key_and_every_type_of_rows() -> None:
    page = PAGE.read_text(encoding="utf-8")
    models: list[type[Strict]] = [LineProfile, RegisterProfile, LineRow, Row, Capabilities]
    models += [IdentityCheck, AlarmCode, Model, NumberUnit, OrderFrom]
    keys = {key for model in models for key in model.model_fields}
    words = {*re.findall(r"[A-Za-z_0-9]+", " ".join(re.findall(r"`[^`]+`|```.*?```", page, re.S)))}
    assert sorted(keys - words) == []
    for kind in (Kind, Table, Order, Checksum):
        named = {value for value in get_args(kind) if value in page}
        assert named >= {*get_args(kind)} - {"BADC", "DCBA"}
    assert all(field in page for field in FIELDS)


def test_the_pages_profiles_are_whole(tmp_path: Path) -> None:
    page = PAGE.read_text(encoding="utf-8")
    blocks = re.findall(r"```toml\n(.*?)```", page, re.S)
    lines = next(block for block in blocks if 'kind = "line"' in block)
    registers = next(block for block in blocks if "functions" in block)
    models = next(block for block in blocks if "[[models]]" in block)
    assert profile_of(tmp_path, lines).row("run").values == {"standby": 0, "started": 1}
    path = tmp_path / "modbus.toml"
    path.write_text(registers, encoding="utf-8")
    assert load_profile(path).number_unit.rows == ("unit",)
    more = "".join(
        f'[[rows]]\nname = "{name}"\nask = "x"\nunit = "%"\nevidence = "FIELD"\n'
        for name in ("power", "external", "cut_out")
    )
    whole = profile_of(tmp_path, lines + more + models)
    model = whole.of_model(whole.models[0])
    assert (model.row("power").ask, model.find("cut_out")) == ("in_pv_02", None)
