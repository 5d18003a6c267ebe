"""Each profile against a second file, typed from public sources and not from the profile; and the emulator
against it, apart. A row without a witness is named here, so that none comes without one unnoticed."""

from __future__ import annotations

import re
import threading
import tomllib
from contextlib import closing, suppress
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from instruments.bath.driver import OwnBath
from instruments.bath.line_emulator import LineEmulator
from instruments.bath.profile import LineProfile, RegisterProfile, load_profile, profile_names
from instruments.bath.rows import LineRow, Quantity, Row
from instruments.bath.witness import WITNESSES, Witness, device_of, witness_of
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, InstrumentError, ProtocolError
from instruments.listener import Listener
from tests.instruments.bath.devices import REGISTER_FAMILIES, Stand, Watched, calm_plant
from tests.instruments.bath.test_line_baths import LINE_FAMILIES

TRANSCRIPTS = Path(__file__).with_name("transcripts")

# rows of a profile that no source beside its own tells of
WITHOUT_WITNESS: dict[str, set[str]] = {
    "eurotherm-2400": set(),
    "eurotherm-3200": set(),
    "julabo-presto": set(),
    # read on the PRESTO's pages only, and INFERRED in the profile
    "julabo-magio": {"cooling_limit", "heating_limit", "pump_control", "pump_stage"}
    | {"low_warning", "high_warning", "cooling_gradient", "heating_gradient"}
    | {"set_point_low", "set_point_high"},
    "omega-cn7": set(),
    "watlow-pm-map1": {"alarm1_state"},  # INFERRED
    "watlow-pm-map2": set(),
    "haake": set(),
    "huber-pb": set(),
    "julabo-ascii": {"warning"},  # texts of status that the manual's page alone has
    "lauda-ascii": set(),
    "polyscience": {"control_sensor"},  # INFERRED
    "thermo-arctic": set(),
}


def family_of(name: str) -> tuple[RegisterProfile, Witness]:
    profile = load_profile(name)
    assert isinstance(profile, RegisterProfile)
    witness = witness_of(profile.family)
    assert witness
    assert witness.family == profile.family
    return profile, witness


def place(row: Row, order: str) -> tuple[object, ...]:
    """What has to be the same on both sides."""
    words = row.order or (order if row.words > 1 else "")
    return row.table, row.address, row.type, words, row.scale, row.unit


def disagreements(name: str) -> list[str]:
    """What profile and witness say of one row that is not the same."""
    profile, witness = family_of(name)
    found = []
    for seen in witness.rows:
        row = profile.find(seen.name)
        if row is None:
            continue
        ours, theirs = place(row, profile.order), place(seen, witness.order)
        if ours != theirs:
            found.append(f"{row.name}: ours {ours}, theirs {theirs}")
        for label, code in row.codes.items():
            if seen.codes and seen.codes.get(label, code) != code:
                found.append(f"{row.name}: {label} is {code}, theirs {seen.codes[label]}")
        if row.access != "r" and seen.access == "r":
            found.append(f"{row.name}: we write it, theirs is read-only")
    return found


def test_every_profile_has_a_witness() -> None:
    assert {*WITHOUT_WITNESS} == {*profile_names()}
    assert {path.stem for path in WITNESSES.glob("*.toml")} == {*REGISTER_FAMILIES}
    assert {path.stem for path in TRANSCRIPTS.glob("*.toml")} == {*LINE_FAMILIES}


def test_only_the_familys_own_witness_is_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tomllib, "loads", parsed := Mock(wraps=tomllib.loads))
    witness_of.cache_clear()
    assert witness_of("JULABO PRESTO")
    assert witness_of("JULABO") is None
    assert parsed.call_count == 1


@pytest.mark.parametrize("name", REGISTER_FAMILIES)
def test_profile_and_witness_agree_row_by_row(name: str) -> None:
    profile, witness = family_of(name)
    assert disagreements(name) == []
    told = {row.name for row in witness.rows}
    alone = [row for row in profile.rows if row.name not in told]
    assert {row.name for row in alone} == WITHOUT_WITNESS[name]
    assert {row.evidence for row in alone} <= {"INFERRED"}
    cited = {key for row in witness.rows for key in re.split(r", ", row.source)}
    assert cited <= {*witness.sources}
    if codes := witness.order_codes:
        assert profile.order_from
        assert codes == profile.order_from.codes


@pytest.mark.parametrize("name", ["eurotherm-2400", "eurotherm-3200", "omega-cn7"])
def test_alarms_of_profile_and_witness_agree(name: str) -> None:
    profile, witness = family_of(name)
    assert {one.code: one.cause for one in profile.alarms} == {
        one.code: one.cause for one in witness.alarms
    }


@pytest.mark.parametrize("name", REGISTER_FAMILIES)
def test_the_emulator_is_laid_out_by_the_witness(name: str) -> None:
    """A profile with one row moved by a register is noticed by the emulator's answers."""
    profile, witness = family_of(name)
    device = device_of(profile)
    for seen in witness.rows:
        row = device.row(seen.name)
        assert (row.table, row.address, row.type) == (seen.table, seen.address, seen.type)
    at = next(at for at, row in enumerate(profile.rows) if row.name == "temperature")
    right = profile.rows[at]
    moved = right.model_copy(update={"address": right.address + 1})
    wrong = profile.model_copy(
        update={"rows": (*profile.rows[:at], moved, *profile.rows[at + 1 :])}
    )
    clock = VirtualClock()
    emulator = Watched(calm_plant(), wrong, clock)
    with closing(Listener(emulator, clock, lock=threading.RLock(), name="bath")) as listener:
        scheme = "tcp" if emulator.framing == "tcp" else "rtu+tcp"
        emulator.plant.set_point_c = 25.0
        url = f"{scheme}://127.0.0.1:{listener.port}"
        with suppress(InstrumentError), closing(OwnBath(url, wrong, clock)) as bath:
            assert bath.read().temp_c != pytest.approx(20.0, abs=0.5)
            assert name == "omega-cn7"  # its set point is at the next register
    assert emulator.writes() == []


@pytest.mark.parametrize("name", ["julabo-presto", "julabo-magio"])
def test_a_safety_sensor_one_register_too_high_is_refused_and_never_shown(name: str) -> None:
    """As it was: 16 and 20 where the maker's page has 15 and 19."""
    profile, _ = family_of(name)
    rows = [
        row.model_copy(update={"address": row.address + 1})
        if row.name in ("safety", "cut_out", "pump_pressure")
        else row
        for row in profile.rows
    ]
    with Stand(profile=profile.model_copy(update={"rows": tuple(rows)})) as stand:
        # the MAGIO's register 17 is not there
        why = "its safety can't be" if name == "julabo-presto" else "no register at this address"
        with pytest.raises((ProtocolError, DeviceError), match=why) as caught:
            stand.bath()
        assert "In degF" not in str(caught.value), "its temperature makes sense"
        assert "e+" not in str(caught.value)
        bath = stand.bath(identify=False)
        tried = {one.row: one for one in bath.try_rows()}
        assert not tried["safety"].sensible
        assert not any("e+" in one.said or "e-" in one.said for one in tried.values())
        assert tried["temperature"].sensible


# ---- lines of ASCII


def transcript(name: str) -> dict[str, Any]:
    return tomllib.loads((TRANSCRIPTS / f"{name}.toml").read_text(encoding="utf-8"))


def rows_of(name: str) -> tuple[LineProfile, dict[str, Any]]:
    """The profile's rows as the transcript's model has them, and the transcript's."""
    profile, told = load_profile(name), transcript(name)
    assert isinstance(profile, LineProfile)
    fitting = (model for model in profile.models if model.fits(told["mark"]))
    return profile.of_model(next(fitting, None)), told


def meant(row: Quantity, value: float | str) -> float:
    return float(row.codes[value]) if isinstance(value, str) else float(value)


@pytest.mark.parametrize("name", LINE_FAMILIES)
def test_the_drivers_rows_read_and_write_as_the_transcript_has_it(name: str) -> None:
    profile, told = rows_of(name)
    rows = {row.name for row in profile.rows}
    assert rows - {*told["rows"], *told["none"]} == WITHOUT_WITNESS[name]
    alarms = sum({alarm.code for alarm in profile.alarms})
    for key, seen in told["rows"].items():
        row = profile.row(key)
        assert isinstance(row, LineRow)
        assert row.ask.lower() == seen["ask"].lower()
        for reply, value in seen["shows"]:
            assert re.fullmatch(seen["form"], reply) or key == "set_point", (reply, key)
            got = row.decode(reply)
            got = float(int(got) & alarms) if row.alarm == "bits" else got
            assert got == pytest.approx(meant(row, value), nan_ok=True), (key, reply)
        for value, command in seen.get("tell", []):
            assert row.command(meant(row, value)).lower() == command.lower()
        for code, text in seen.get("texts", []):
            assert text in profile.alarm_text(code)
            assert profile.means(code, "level") == ("low level" in text)
        assert {*re.split(r", ", seen["source"])} <= {*told["sources"]}


@pytest.mark.parametrize("name", LINE_FAMILIES)
def test_the_emulator_answers_as_the_transcript_has_it(name: str) -> None:
    profile, told = rows_of(name)
    panel = LineEmulator(calm_plant(), profile, VirtualClock()).panel
    for key, seen in told["rows"].items():
        said = panel.answer(seen["ask"])
        assert said is not None, f"{name}: silent at {seen['ask']}"
        assert re.fullmatch(seen["form"], said), (key, said)
        for _, command in seen.get("tell", []):
            panel.answer(command)
    assert panel.plant.running is False, "the last command of run is its standby"
