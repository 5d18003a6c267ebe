"""Models within a family, the unit of the numbers on the wire, and the sensor that controls: what is read,
and what is not written before it is known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from instruments.bath.driver import OwnBath
from instruments.bath.line_dialects import Julabo
from instruments.bath.line_emulator import LineEmulator
from instruments.bath.profile import LineProfile, load_profile, profile_names
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, LimitError, ProtocolError
from tests.instruments.bath.devices import (
    REGISTER_FAMILIES,
    Stand,
    calm_plant,
    driven,
    load_register_profile,
)
from tests.instruments.bath.far_end import bath_on, shown_by
from tests.instruments.bath.test_bath_profile import (
    BROWSED,
    EUROTHERM_MEMORY,
    OMEGA_MEMORY,
    WATLOW_MEMORY,
)
from tests.instruments.bath.test_line_baths import (
    JULABO_REPLIES,
    LAUDA_REPLIES,
    LINE_FAMILIES,
    POLYSCIENCE,
    Typed,
    emulated,
    julabo,
    served,
)

# ---- models


def test_a_julabo_without_in_pv_04_is_read() -> None:
    """The case: -08 INVALID COMMAND to it, all else right."""
    typed = julabo(in_pv_04="-08 INVALID COMMAND")
    with served(typed) as (_, bath):
        assert bath.read().safety_c == 21.5
        assert "cut_out" in bath.identity["not offered by this model"]
        with pytest.raises(LimitError, match="'cut_out' is not offered by this model"):
            bath.get("cut_out")


@pytest.mark.parametrize("version", ["JULABO FP50_MH Ver. 5.0", "JULABO FP50-HE VER 2.1"])
def test_a_fp50_has_power_and_external_sensor_the_other_way_round(version: str) -> None:
    """The case: 26.00 and 5."""
    typed = julabo(version=version, in_pv_01="26.00", in_pv_02="5")
    with served(typed) as (_, bath):
        reading = bath.read()
        assert (reading.external_c, reading.power_percent) == (26.0, 5.0)


@pytest.mark.parametrize("version", ["JULABO ABC 1", "JULABO FP50-HL VER 4", "JULABO FP50-SL 1"])
def test_what_is_not_known_of_a_model_is_not_offered(version: str) -> None:
    """Of a FP50-HL manual and driver contradict each other."""
    typed = julabo(version=version, in_pv_01="26.00", in_pv_02="5")
    with served(typed) as (_, bath):
        reading = bath.read()
        assert (reading.external_c, reading.power_percent) == (None, None)
        with pytest.raises(LimitError, match="not offered by this model"):
            bath.get("external")
        tried = {one.row: one for one in bath.try_rows()}
        assert tried["power"].said.startswith("26 % (got '26.00'); models differ here")
        assert not tried["power"].sensible
        assert tried["temperature"].sensible


def test_a_status_that_says_invalid_command_is_no_refusal_of_itself() -> None:
    with served(julabo(status="-08 INVALID COMMAND")) as (_, bath):
        assert (bath.read().alarm, bath.read().remote) == (0, None)


def test_the_emulated_julabos_are_models_too() -> None:
    panel = Julabo(calm_plant())
    assert (panel.answer("in_pv_01"), panel.answer("in_pv_02")) == ("0", "20.00")
    panel.version = "JULABO FP50-HE VER 2.1"
    assert (panel.answer("in_pv_01"), panel.answer("in_pv_02")) == ("20.00", "0")
    assert panel.answer("in_pv_04") == "-08 INVALID COMMAND"


def test_an_emulated_julabo_is_silent_at_no_known_query() -> None:
    """What the julabo library, lewis and the manual ask."""
    panel = Julabo(calm_plant())
    asked = [f"in_sp_{n:02d}" for n in range(9)] + [f"in_par_{n:02d}" for n in range(17)]
    asked += ["in_hil_00", "in_hil_01", "version", "status", *(f"in_pv_0{n}" for n in range(5))]
    asked += [f"in_mode_{n:02d}" for n in (1, 2, 3, 4, 5, 8)]
    for command in asked:
        said = panel.answer(command)
        assert said, command
        assert "INVALID" not in said
    assert panel.answer("out_par_06 2.5") is None
    assert panel.answer("in_par_06") == "2.5"
    assert panel.answer("in_xy_00") == "-08 INVALID COMMAND"


@pytest.mark.parametrize(
    ("name", "commands"),
    [
        ("lauda-ascii", "IN_PV_01 IN_PV_02 IN_PV_10 IN_SP_01 IN_SP_02 IN_SP_07 IN_SP_08 STATUS"),
        ("haake", "R HL|R LL|R FR|R ZA|R ZB|R ZI|R WD|R WS|R CC|R PF"),
        ("polyscience", "RH RL RM RF RU"),
        ("huber-pb", "{M03**** {M04**** {M0F**** {M26**** {M30**** {M31**** {M48**** {M5C****"),
    ],
)
def test_an_emulated_circulator_answers_what_public_drivers_ask(name: str, commands: str) -> None:
    profile = load_profile(name)
    assert isinstance(profile, LineProfile)
    panel = LineEmulator(calm_plant(), profile, VirtualClock()).panel
    for command in commands.split("|" if "|" in commands else " "):
        said = panel.answer(command)
        assert said, command
        assert profile.refusal(said) is None
        assert not said.endswith("7FFF")


@pytest.mark.parametrize("refusal", ["ERR_8", "ERR_99"])
def test_a_lauda_without_an_external_probe_is_read(refusal: str) -> None:
    typed = Typed(VirtualClock(), {**LAUDA_REPLIES, "IN_PV_03": refusal}, confirm="OK")
    with served(typed, "lauda-ascii") as (_, bath):
        assert bath.read().external_c is None
        assert bath.identity["not offered by this model"] == "external"


def test_laudas_port_need_not_be_named() -> None:
    profile = load_profile("lauda-ascii")
    bath = OwnBath("tcp://127.0.0.1", profile, VirtualClock(), identify=False)
    assert bath._wire.line.port == 54321


@pytest.mark.parametrize("identify", [True, False])
def test_polyscience_with_run_and_stand_by(identify: bool) -> None:
    """A guardian puts it into standby, too, which has never seen which of the two it knows."""

    def act(on: Typed, command: str) -> None:
        if command.startswith("SW"):
            on.replies["RW"] = command[-1]
        on.confirm = "!" if command.startswith("SW") else "?"

    replies = POLYSCIENCE | {"RO": "?", "RW": "1", "RJ": "?"}
    typed = Typed(VirtualClock(), replies, reply_end=b"\r", acts=act)
    profile = load_profile("polyscience")
    with driven(typed, profile, typed.clock, identify=identify) as bath:
        if identify:
            assert bath.read().running is True
        bath.safe()
    assert typed.replies["RW"] == "0"
    assert typed.told == (["SW0"] if identify else ["SO0", "SW0"])


# ---- states and alarms


@pytest.mark.parametrize("code", [1, 2])
def test_a_ramp_is_not_written_in_another_unit_of_time(code: int) -> None:
    with bath_on("eurotherm-3200", {**EUROTHERM_MEMORY, 122: 0x3216, 531: code}) as (far, bath):
        calls: list[Callable[[], object]] = [
            lambda: bath.set("ramp", 2.0),
            lambda: bath.get("ramp"),
        ]
        for call in calls:
            with pytest.raises(DeviceError, match="ramp needs ramp_unit = per_min"):
                call()
        assert all(pdu[0] == 3 for pdu in far.asked)
        far.memory[531] = 0
        bath.set("ramp", 2.0)
        assert bath.get("ramp") == 2.0


@pytest.mark.parametrize(("code", "alarm"), [("7FFF", 0), ("0003", 0), ("FFFB", -5)])
def test_only_a_negative_number_is_hubers_fault(code: str, alarm: int) -> None:
    shown = {"01": "0802", "00": "0CE4", "14": "0000", "05": code, "07": "C504", "1B": "3039"}
    shown |= {"06": "7FFF", "0A": "0000"}
    replies = {f"{{M{at}****": f"{{S{at}{word}" for at, word in shown.items()}
    typed = Typed(VirtualClock(), replies, end=b"\r\n", reply_end=b"\r\n")
    with served(typed, "huber-pb") as (_, bath):
        assert bath.read().alarm == alarm


def test_a_huber_that_was_without_power_and_runs_on_is_noticed() -> None:
    """It may start by itself: that it runs says nothing of its set point."""
    with emulated("huber-pb", confirmed=False) as (device, bath):
        bath.start(33.0)
        assert bath.read().restarted is False
        device.panel.restarted = True
        for _ in range(2):
            with pytest.raises(DeviceError, match="restarted and lost its set point"):
                bath.read()
        bath.start(33.0)
        assert bath.read().running


# ---- the unit of the numbers


def test_every_profile_says_where_the_unit_of_its_numbers_stands() -> None:
    known = {name: load_profile(name).number_unit for name in profile_names()}
    told = {name: unit.rows or unit.fixed for name, unit in known.items() if unit.note == ""}
    assert told == {
        "eurotherm-2400": ("unit",),
        "eurotherm-3200": ("unit",),
        "huber-pb": "degC",
        "julabo-magio": ("unit",),
        "julabo-presto": ("unit",),
        "omega-cn7": ("unit",),
        "polyscience": ("unit",),
        "thermo-arctic": ("unit",),
        "watlow-pm-map1": ("unit", "unit_2"),
    }
    assert {*known} - {*told} == {"haake", "julabo-ascii", "lauda-ascii", "watlow-pm-map2"}


def test_an_omega_that_takes_no_writes_says_why() -> None:
    with (
        bath_on("omega-cn7", OMEGA_MEMORY | {0x0810: 0}) as (_, bath),
        pytest.raises(DeviceError, match=r"needs write_enable = on .*CoSH"),
    ):
        bath.set_point(33.0)


@pytest.mark.parametrize(
    ("units", "refused"),
    [({2490: 15, 2510: 30}, True), ({2490: 30, 2510: 15}, True), ({2490: 15, 2510: 0}, False)],
)
def test_both_ports_of_a_watlow_have_to_be_in_celsius(units: dict[int, int], refused: bool) -> None:
    with shown_by(WATLOW_MEMORY | units) as (far_end, url):
        profile = load_register_profile("watlow-pm-map1")
        if refused:
            with pytest.raises(DeviceError, match="does not speak degC"):
                OwnBath(url, profile, far_end.clock)
        else:
            OwnBath(url, profile, far_end.clock).close()


@pytest.mark.parametrize("name", ["haake", "lauda-ascii", "watlow-pm-map2"])
def test_where_nothing_tells_the_unit_nothing_is_written_before_a_person_has(name: str) -> None:
    if name in LINE_FAMILIES:
        with emulated(name, confirmed=False) as (device, bath):
            check_confirmation(bath, device.plant)
    else:
        with Stand(profile=load_register_profile(name)) as stand:
            bath = stand.bath(unit_confirmed=False)
            check_confirmation(bath, stand.plant)
            assert {address for _, address in stand.emulator.writes()} == {2360, 2640}


def check_confirmation(bath: OwnBath, plant: Any) -> None:
    calls: list[Callable[[], object]] = [
        lambda: bath.start(33.0),
        lambda: bath.set_point(33.0),
        lambda: bath.set("run", "started"),
    ]
    for call in calls:
        with pytest.raises(LimitError, match="nothing tells whether its numbers are degC"):
            call()
    bath.standby()
    bath.safe()
    assert plant.set_point_c == 20.0
    with pytest.raises(DeviceError, match=r"differ: they are not both degC"):
        bath.confirm_unit(68.0)
    bath.confirm_unit(20.3)
    bath.start(33.0)
    assert plant.set_point_c == pytest.approx(33.0)
    bath.safe()


def test_a_julabo_that_tells_its_unit_needs_no_person() -> None:
    typed = Typed(
        VirtualClock(), {**JULABO_REPLIES, "version": "JULABO FP51-SL 1", "in_sp_06": "0"}
    )
    with served(typed) as (_, bath):
        assert bath.unit_source == "degC, as it shows itself"
        typed.replies["in_sp_06"] = "1"
        with pytest.raises(DeviceError, match="does not speak degC"):
            bath.read()


# ---- which sensor controls

CONTROLLED = ["haake", "huber-pb", "julabo-ascii", "lauda-ascii", "thermo-arctic"]


@pytest.mark.parametrize("name", CONTROLLED)
def test_a_set_point_is_not_given_to_another_sensor(name: str) -> None:
    with emulated(name) as (device, bath):
        device.fault("external control")
        bath.read()
        calls: list[Callable[[], object]] = [lambda: bath.set_point(33.0), lambda: bath.start(33.0)]
        for call in calls:
            with pytest.raises(DeviceError, match=r"needs control_sensor = internal .*brought"):
                call()
        device.fault("external control", on=False)
        bath.start(33.0)
        device.fault("external control")
        for _ in range(2):
            with pytest.raises(DeviceError, match="where internal is needed"):
                bath.read()
        bath.safe()
        assert not device.plant.running


@pytest.mark.parametrize("name", [name for name in REGISTER_FAMILIES if "julabo" in name])
def test_a_julabos_set_point_over_modbus_is_its_own_sensors(name: str) -> None:
    with Stand(profile=load_register_profile(name)) as stand:
        bath = stand.bath()
        bath.start(33.0)
        stand.emulator.fault("external control")
        with pytest.raises(DeviceError, match="control_sensor = external where internal"):
            bath.read()
        bath.safe()
        with pytest.raises(DeviceError, match="needs control_sensor = internal"):
            bath.start(30.0)
        assert not stand.plant.running


# ---- numbers that no device has


def test_a_cut_out_that_can_not_be_does_not_keep_a_presto_from_being_read() -> None:
    """Nothing else depends on it; it is not shown either."""
    with Stand() as stand:
        rows = [
            row.model_copy(update={"address": 20}) if row.name == "cut_out" else row
            for row in stand.profile.rows
        ]
        stand.profile = stand.profile.model_copy(update={"rows": tuple(rows)})
        bath = stand.bath()
        assert bath.identity["cut_out"] == "no value that a device has"
        assert bath.read().safety_c == pytest.approx(20.0, abs=0.1)


def test_no_number_that_no_device_has_is_shown_or_counted() -> None:
    memory = BROWSED["watlow-pm-map1"] | {1480: 0x41A0, 1481: 0}
    with bath_on("watlow-pm-map1", memory) as (_, bath):
        with pytest.raises(ProtocolError, match="alarm1_high is no value of a device") as caught:
            bath.get("alarm1_high")
        assert "e-4" not in str(caught.value)
        tried = {one.row: one for one in bath.try_rows()}
        assert not tried["alarm1_high"].sensible
        assert tried["alarm1_high"].said == "can't be its value (got 41A0 0000)"
        assert tried["alarm1_low"].sensible
