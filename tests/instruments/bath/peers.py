"""Independent Modbus programs: where they are, how they are built, and ports for them to meet the
emulators at.
"""

from __future__ import annotations

import importlib.util
import os
import select
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, NoReturn

import pytest

from instruments.bath.emulator import BathEmulator, Framing, RelayEmulator
from instruments.bath.profile import RegisterProfile, RelayProfile
from instruments.clock import RealClock
from instruments.listener import Connection, Listener
from instruments.pty_listener import PtyListener
from tests.instruments.bath.devices import calm_plant
from tests.waiting import PATIENCE_S

EXAMPLES = Path("/usr/share/doc/libmodbus-dev/examples")
# addresses in the examples' sources, and where a test's own come from
DEVICE = {'"/dev/ttyUSB0"': 'getenv("PEER_DEVICE")'}
PORT = {'"127.0.0.1", 1502': '"127.0.0.1", atoi(getenv("PEER_PORT"))'}
SOCKET = {"s = modbus_tcp_listen(ctx, 1)": 's = atoi(getenv("PEER_SOCKET"))'}  # one that listens
NAP = "usleep(500000)"  # of the server's late register: on a busy machine any answer takes as long
LONG_NAP = "sleep(5)"
CONNECTED = "if (modbus_connect(ctx) == -1)"
# its client gives half a second to an answer, and to the next byte of one: here the answer decides
PATIENT = (
    f"modbus_set_response_timeout(ctx, 120, 0); modbus_set_byte_timeout(ctx, 120, 0); {CONNECTED}"
)
OVER_RTU = "modbus_new_rtu(\"/dev/ttyUSB0\", 19200, 'N', 8, 1); modbus_set_slave(ctx, SERVER_ID)"


def absent(reason: str) -> NoReturn:
    """Skip the test; fail it where TEATBENCH_NEED_PEERS says that nothing may be absent."""
    if os.environ.get("TEATBENCH_NEED_PEERS"):
        pytest.fail(reason)
    pytest.skip(reason, allow_module_level=True)


def needed(module: str, package: str) -> None:
    """`absent` where a program of others is not installed."""
    if importlib.util.find_spec(module.partition(".")[0]) is None:
        absent(f"needs {package}: pip install {package}")


def foreign(module: str, package: str) -> Any:
    """The module of a program of others; `absent` where it is not installed."""
    needed(module, package)
    return importlib.import_module(module)


def program(name: str) -> str:
    """The path of an installed program; `absent` where there is none."""
    path = shutil.which(name)
    if path is None:
        absent(f"needs {name}: apt-get install {name}")
    return path


def built(example: str, folder: Path, *, over_rtu: bool = False) -> Path:
    """One of libmodbus's example programs, told its address by PEER_DEVICE, or PEER_PORT for a client
    and PEER_SOCKET for a server; `absent` where it can't be built.

    ``over_rtu`` makes a client that only knows TCP ask over a serial port.
    """
    source = EXAMPLES / f"{example}.c"
    if not source.is_file() or not Path("/usr/include/modbus/modbus.h").is_file():
        absent("needs libmodbus's headers and examples: apt-get install libmodbus-dev")
    text = source.read_text(encoding="utf-8")
    client = PORT | {CONNECTED: PATIENT}
    changes = DEVICE | (client if "client" in example else SOCKET | {NAP: LONG_NAP})
    assert all(fixed in text for fixed in changes), f"{source} has changed"
    if over_rtu:
        text = text.replace('modbus_new_tcp("127.0.0.1", 1502)', OVER_RTU)
    for fixed, note in changes.items():
        text = text.replace(fixed, note)
    copy = folder / source.name
    copy.write_text(text, encoding="utf-8")
    target = folder / example
    folders = ["-I/usr/include/modbus", f"-I{EXAMPLES}"]
    command = [program("gcc"), "-w", *folders, str(copy), "-lmodbus", "-o", str(target)]
    subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE_S)
    return target


def memory_profile() -> RegisterProfile:
    """A family without behaviour of its own: 100 coils and 100 registers that keep what is written,
    and a bath behind them.
    """

    def row(name: str, table: str, address: int, kind: str, **more: object) -> dict[str, object]:
        access = "r" if table == "input" else "rw"
        place = {"name": name, "table": table, "address": address, "type": kind}
        return {**place, "evidence": "CERTAIN", "access": access, **more}

    rows = [
        row("temperature", "input", 200, "f32", unit="degC"),
        row("set_point", "holding", 200, "f32", unit="degC", range=[0, 40]),
        row("run", "holding", 202, "u16", values={"standby": 0, "started": 1}),
        *(row(f"r{n}", "holding", n, "u16", range=[0, 65535]) for n in range(100)),
        *(row(f"c{n}", "coil", n, "bit", values={"off": 0, "on": 1}) for n in range(100)),
    ]
    return RegisterProfile.model_validate(
        {
            "family": "memory",
            "source": "libmodbus's random-test-client",
            "transports": ["tcp", "rtu"],
            "functions": [1, 2, 3, 4, 5, 6, 16],
            "comms_loss": "hold",
            "comms_loss_evidence": "CERTAIN",
            "rows": rows,
        }
    )


Device = BathEmulator | RelayEmulator


@contextmanager
def real_time(
    profile: RegisterProfile | RelayProfile, transport: str, *, unit_id: int | None = None
) -> Iterator[tuple[Device, Listener | PtyListener]]:
    """An emulated device in real time, on "tcp" or a pseudo-terminal ("pty")."""
    if transport == "pty" and not hasattr(os, "openpty"):
        pytest.skip("needs pseudo-terminals: Linux and macOS have them")
    framing: Framing = "tcp" if transport == "tcp" else "rtu"
    kind: type[Device] = RelayEmulator if isinstance(profile, RelayProfile) else BathEmulator
    clock, lock = RealClock(), threading.RLock()
    device = kind(calm_plant(), profile, clock, unit_id=unit_id, framing=framing)  # type: ignore[arg-type]
    with closing(clock), ExitStack() as stack:
        listener: Listener | PtyListener = (
            Listener(device, clock, lock=lock, name="bath")
            if transport == "tcp"
            else PtyListener(device, clock, lock=lock, name="bath")
        )
        stack.callback(listener.close)
        yield device, listener


class Bridge:
    """A device that hands bytes on to a program's serial port, its adapter being ``path``."""

    def __init__(self) -> None:
        tty = pytest.importorskip("tty", reason="needs pseudo-terminals: Linux and macOS have them")
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        self.path = os.ttyname(self._far)
        self._hosts: set[Connection] = set()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._hand_back, name="bridge", daemon=True)
        self._thread.start()

    def connect(self, connection: Connection) -> None:
        self._hosts.add(connection)

    def disconnect(self, connection: Connection) -> None:
        self._hosts.discard(connection)

    def receive(self, connection: Connection, data: bytes) -> None:
        os.write(self._near, data)

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        os.close(self._near)
        os.close(self._far)

    def _hand_back(self) -> None:
        while not self._closing.is_set():
            if select.select([self._near], [], [], 0.02)[0]:
                data = os.read(self._near, 4096)
                for host in list(self._hosts):
                    host.send(data)
