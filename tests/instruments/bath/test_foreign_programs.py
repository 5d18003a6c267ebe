"""Programs of others from PyPI against our two ends: they drive the emulators, and the driver drives what
simulates a device there. None of them shares a line with the profiles, the driver or the emulators.

julabo and huber (their makers' users), omega_controller, pyModbusTCP; minimalmodbus is in `test_peers`.
watlow (numat) needs an older pymodbus than ours; pywatlow speaks Watlow's own bus and no Modbus."""

from __future__ import annotations

import asyncio
import importlib
import importlib.util
import logging
import struct
import sys
import threading
import types
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest

from instruments.bath.driver import OwnBath
from instruments.bath.line_emulator import LineEmulator
from instruments.bath.profile import LineProfile, Profile, load_profile
from instruments.clock import RealClock
from instruments.errors import DeviceError
from instruments.listener import Connection, Listener
from instruments.world.plant import Plant
from tests.instruments.bath.devices import (
    LineDevice,
    calm_plant,
    driven,
    load_register_profile,
)
from tests.instruments.bath.peers import foreign, real_time
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

WSAEINVAL = 10022  # winsock2.h


@contextmanager
def circulator(name: str) -> Iterator[tuple[LineEmulator, Plant, int]]:
    """An emulated circulator in real time, its plant, and its port on loopback."""
    profile = load_profile(name)
    assert isinstance(profile, LineProfile)
    plant = calm_plant()
    with closing(RealClock()) as clock:
        device = LineEmulator(plant, profile, clock)
        with closing(Listener(device, clock, lock=threading.RLock(), name="bath")) as listener:
            yield device, plant, listener.port


# ---- they drive


@pytest.mark.filterwarnings("ignore:'asyncio.iscoroutinefunction':DeprecationWarning")
def test_julabo_drives_an_emulated_julabo() -> None:
    library: Any = foreign("julabo", "julabo")

    async def talk(port: int) -> dict[str, Any]:
        url = f"serial-tcp://127.0.0.1:{port}"
        link = library.connection_for_url(url, concurrency="asyncio")
        try:
            await link.open()
        except OSError as error:
            if getattr(error, "winerror", 0) == WSAEINVAL:
                pytest.skip("its library sets IP_TOS, which this system refuses")
            raise
        try:
            bath = library.JulaboCF(link)
            await bath.set_point_1(33.5)
            await bath.start()
            names = ["identification", "status", "is_started", "set_point_1", "bath_temperature"]
            names += ["heating_power", "external_temperature", "safety_temperature"]
            names += ["high_temperature", "low_temperature", "active_set_point_channel"]
            names += ["self_tunning", "external_input", "temperature_control"]
            found = {name: await getattr(bath, name)() for name in names}
            await bath.stop()
            found["stopped"] = not await bath.is_started()
            return found
        finally:
            await link.close()

    with circulator("julabo-ascii") as (_, plant, port):
        found = asyncio.run(asyncio.wait_for(talk(port), PATIENCE_S))
        assert (plant.set_point_c, plant.running) == (33.5, False)
    assert found["identification"].startswith("JULABO")
    assert (found["status"], found["is_started"]) == ("03 REMOTE START", True)
    assert (found["set_point_1"], found["stopped"]) == (33.5, True)
    assert found["bath_temperature"] == pytest.approx(20.0, abs=0.5)
    assert found["safety_temperature"] == pytest.approx(20.0, abs=0.5)
    assert found["temperature_control"].name == "Internal"
    assert 0.0 <= found["heating_power"] <= 100.0


def test_huber_drives_an_emulated_huber() -> None:
    library: Any = foreign("huber", "huber")

    async def talk(port: int) -> dict[str, Any]:
        bath = library.Bath("127.0.0.1", comm_timeout=PATIENCE_S)
        bath.port = port
        async with bath:
            await bath.set_setpoint(33.5)
            await bath.start()
            found: dict[str, Any] = await bath.get()
            found["process"] = await bath.get_process_temperature()
            await bath.stop()
            return found

    async def fault(port: int) -> dict[str, Any]:
        bath = library.Bath("127.0.0.1", comm_timeout=PATIENCE_S)
        bath.port = port
        async with bath:
            while not (found := await bath.get_error()):
                await asyncio.sleep(0.05)
            return dict(found)

    with circulator("huber-pb") as (device, plant, port):
        found = asyncio.run(asyncio.wait_for(talk(port), PATIENCE_S))
        assert (plant.set_point_c, plant.running) == (33.5, False)
        device.fault("low level")
        assert asyncio.run(asyncio.wait_for(fault(port), PATIENCE_S))["code"] == -2
    assert found["on"] is True
    assert found["temperature"]["setpoint"] == 33.5
    assert found["temperature"]["bath"] == pytest.approx(20.0, abs=0.5)
    assert found["process"] == pytest.approx(20.0, abs=0.5)
    assert found["status"] == {
        "controlling": True,
        "circulating": True,
        "pumping": True,
        "error": False,
        "warning": False,
    }


def test_omega_controller_drives_an_emulated_omega() -> None:
    library: Any = foreign("omega_controller", "omega_controller")
    with real_time(load_register_profile("omega-cn7"), "pty") as (emulator, listener):
        client = library.OmegaController(
            listener.url, baudrate=19200, parity="n", bytesize=8, timeout=PATIENCE_S, mode="rtu"
        )
        with closing(client.instrument.serial):
            assert client.get_pv() == 20.0
            client.set_sv(33.5)
            assert (client.get_sv(), emulator.plant.set_point_c) == (33.5, 33.5)
            assert client.get_control_method() == 0
            client.run()
            assert [client.is_running(), emulator.plant.running] == [True, True]
            client.stop()
            assert [client.is_running(), emulator.plant.running] == [False, False]
            assert client.read_status_code() in (None, 0)
            emulator.fault("sensor break")
            assert client.get_pv() is None


def words(value: float) -> list[int]:
    return list(struct.unpack(">HH", struct.pack(">f", value)))


# ---- the driver drives theirs


def patient(name: str) -> Profile:
    """A profile that waits for an answer as long as a busy machine may take."""
    return load_profile(name).model_copy(update={"timeout_s": 10.0})


# A PRESTO in standby at 20 degC with a set point of 25, its sensors at 20.5 and 21: by the manual's pages
HOLDING = {0: [0], 1: [0], 2: words(25.0), 10: [0], 90: [0], 93: [0]}
INPUT = {5: [4], 6: [0], 7: [0], 10: words(20.0), 12: words(20.5), 14: [0], 15: words(21.0)}
INPUT |= {19: words(40.0), 0: [0, 10400]}


def flat(image: dict[int, list[int]]) -> dict[int, int]:
    return {at + n: word for at, values in image.items() for n, word in enumerate(values)}


def check_presto(url: str) -> None:
    with (
        closing(RealClock()) as clock,
        closing(OwnBath(url, patient("julabo-presto"), clock)) as bath,
    ):
        reading = bath.read()
        assert (reading.temp_c, reading.external_c, reading.safety_c) == (20.0, 20.5, 21.0)
        assert bath.identity["cut_out"] == "40 degC"
        bath.start(33.5)
        assert (bath.read().set_point_c, bath.read().running) == (33.5, True)
        bath.safe()
        assert bath.read().running is False
        with pytest.raises(DeviceError, match="no register at this address"):
            bath._rows.wire.read(4, 900, 2)  # type: ignore[union-attr]


def test_the_driver_on_pymodbustcps_server() -> None:
    server_of: Any = foreign("pyModbusTCP.server", "pyModbusTCP")
    bank = server_of.DataBank(h_regs_size=100, i_regs_size=100, coils_size=1, d_inputs_size=1)
    bank._h_regs = [flat(HOLDING).get(at, 0) for at in range(100)]
    bank._i_regs = [flat(INPUT).get(at, 0) for at in range(100)]
    server = server_of.ModbusServer("127.0.0.1", 0, no_block=True, data_bank=bank)
    server.start()
    try:
        check_presto(f"tcp://127.0.0.1:{server._service.server_address[1]}")
    finally:
        server.stop()


class Simulated(LineDevice):
    """What julabo.simulator answers, behind a port of ours."""

    def __init__(self, device: Any) -> None:
        self.device = device

    def take(self, connection: Connection, line: bytes) -> None:
        if answer := self.device.handle_message(line):
            connection.send(answer)


def test_the_driver_on_julabos_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their base class is sinstruments' (gevent): a stand-in here has its name and its log."""
    foreign("julabo", "julabo")

    class BaseDevice:
        def __init__(self, name: str, **options: object) -> None:
            self._log = logging.getLogger(name)

    package, module = types.ModuleType("sinstruments"), types.ModuleType("sinstruments.simulator")
    module.BaseDevice = BaseDevice  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "sinstruments", package)
    monkeypatch.setitem(sys.modules, "sinstruments.simulator", module)
    monkeypatch.delitem(sys.modules, "julabo.simulator", raising=False)
    simulator: Any = importlib.import_module("julabo.simulator")
    device = simulator.JulaboCF("bath")
    with (
        closing(RealClock()) as clock,
        driven(Simulated(device), patient("julabo-ascii"), clock) as on,
    ):
        reading = on.read()
        assert (reading.temp_c, reading.set_point_c, reading.safety_c) == (29.45, 30.0, 29.69)
        assert (reading.power_percent, reading.external_c) == (3.0, 28.22)
        assert reading.remote is False
        on.confirm_unit(29.5)
        on.set_point(33.5)
        assert device._config["SP_00"] == "33.50"
        on.start(34.0)
        assert (device._config["MODE_05"], on.read().running) == ("1", True)
        on.safe()
        assert device._config["MODE_05"] == "0"
