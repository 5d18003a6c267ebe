"""Peers that are no instrument: what each sends, whatever it is asked, and how long a command at
them may last.

``tests/bench/cli/test_hostile_peers.py`` runs every command at every link against each of them.
"""

from __future__ import annotations

import os
import re
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil

from instruments.bath import protocol
from instruments.bath.emulator import BathEmulator
from instruments.world.plant import Plant
from tests.bench.commands import served
from tests.bench.forked import begin
from tests.bench.operated_runs import ONE
from tests.instruments.bath.devices import load_register_profile

# a process that has loaded the bench, but nothing else, takes 110 MB
WITHIN_S, MOST_MORE_MB = 65.0, 90.0


def crc(data: bytes) -> bytes:
    return protocol.crc(data).to_bytes(2, "little")


def modbus(data: bytes, answer: Callable[[bytes], bytes]) -> bytes | None:
    """``answer`` to the unit and PDU in a request of either framing; None for no Modbus."""
    if len(data) >= 8 and data[2:4] == b"\0\0" and data[4:6] == (len(data) - 6).to_bytes(2, "big"):
        said = answer(data[6:])
        return data[:4] + len(said).to_bytes(2, "big") + said
    if len(data) >= 4 and crc(data[:-2]) == data[-2:]:
        said = answer(data[:-2])
        return said + crc(said)
    return None


def zero_answer(request: bytes) -> bytes:
    unit, function, count = request[:1], request[1], int.from_bytes(request[4:6], "big")
    if function in (5, 6, 15, 16):
        return request[:6]
    size = (count + 7) // 8 if function in (1, 2) else 2 * count
    return unit + bytes((function, min(size, 255))) + bytes(min(size, 255))


def exception(request: bytes) -> bytes:
    return request[:1] + bytes((request[1] | 0x80, 2))


@dataclass(frozen=True)
class Kind:
    """``first``: sent at once; ``reply`` to what comes; ``stream``: a piece, again and again."""

    first: bytes = b""
    reply: Callable[[bytes], bytes] = lambda _: b""
    stream: bytes = b""
    pause_s: float = 0.0
    hangs_up: bool = False


KINDS: Mapping[str, Kind] = {
    "endless data": Kind(stream=bytes(range(1, 256)).replace(b"\n", b"") * 64),
    "endless lines": Kind(stream=b"[MSG:hello]\r\n" * 1000),
    "silence": Kind(),
    "closing at once": Kind(hangs_up=True),
    "echo": Kind(reply=lambda data: data),
    "zeros": Kind(reply=lambda data: modbus(data, zero_answer) or bytes(len(data))),
    "exceptions": Kind(reply=lambda data: modbus(data, exception) or b"error:9\r\n"),
    "another protocol's banner": Kind(
        first=b"SSH-2.0-OpenSSH_9.2p1\r\n", reply=lambda _: b"Invalid SSH identification.\r\n"
    ),
    "one byte a second": Kind(stream=b"x", pause_s=1.0),
}


class HostilePeer:
    """Takes every connection, treats it as ``kind`` says, and keeps what it was sent."""

    def __init__(self, kind: Kind) -> None:
        self._kind = kind
        self._server = socket.create_server(("127.0.0.1", 0))
        self._ended = threading.Event()
        self._connections: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self.port: int = self._server.getsockname()[1]
        self.received: list[bytes] = []
        self._start(self._accept)

    def close(self) -> None:
        """End all of it; nothing is left behind."""
        self._ended.set()
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._threads[0].join()
        for connection in self._connections:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        for one in (self._server, *self._connections):
            one.close()

    def _start(self, work: Callable[..., None], *arguments: socket.socket) -> None:
        thread = threading.Thread(target=work, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self._server.accept()
                self._connections.append(connection)
                if self._kind.hangs_up:
                    connection.close()
                    continue
                self._start(self._read, connection)
                self._start(self._stream, connection)

    def _read(self, connection: socket.socket) -> None:
        with suppress(OSError):
            connection.sendall(self._kind.first)
            while data := connection.recv(65536):
                self.received.append(data)
                connection.sendall(self._kind.reply(data))
            connection.shutdown(socket.SHUT_RDWR)

    def _stream(self, connection: socket.socket) -> None:
        with suppress(OSError):
            while self._kind.stream and not self._ended.wait(self._kind.pause_s):
                connection.sendall(self._kind.stream)


@contextmanager
def hostile(kind: str) -> Iterator[HostilePeer]:
    peer = HostilePeer(KINDS[kind])
    try:
        yield peer
    finally:
        peer.close()


# ---- the commands

RIG = """
name = "one hostile peer"
calibration = "{calibration}"
[operator]
url = "console:"
[arm]
url = "{arm}"
accuracy_mm = 0.23
accuracy_source = "a data sheet"
[bath]
url = "{bath}"
profile = "{profile}"
cut_out_tested = "2026-11-20"
allow_inferred = true
{pump}
{stage}
[cameras]
url = "{cameras}"
"""
STAGE = """
[stage]
url = "socket://{{at}}"
dialect = "{}"
{}
"""
ZABER = 'zaber_axes = ["1 1", "2 1"]\nmicrosteps = [1000.0, 1000.0]\nreference_mm = [150.0, 137.5]'
MARLIN = "reference_mm = [150.0, 137.5]"
SCRIPT = re.sub(r"\nwindow_s(?:.*\n)*?\n", "\n\n", ONE).replace("table-5-1", "single")

RELAYED = "watlow-pm-map1"  # a controller whose pump is a relay's
# link -> what of the rig file names it
LINKS: Mapping[str, Mapping[str, str]] = {
    "arm": {"arm": "socket://{at}"},
    "bath, Modbus TCP": {"bath": "tcp://{at}", "profile": "julabo-presto"},
    "bath, RTU over TCP": {"bath": "rtu+tcp://{at}", "profile": "eurotherm-3200"},
    "bath, lines": {"bath": "tcp://{at}", "profile": "julabo-ascii"},
    "bath, lines of another": {"bath": "tcp://{at}", "profile": "thermo-arctic"},
    "pump's relay": {
        "profile": RELAYED,
        "pump": 'pump_url = "rtu+tcp://{at}"\npump_profile = "modbus-relay"',
    },
    "stage, Grbl": {"stage": STAGE.format("grbl", "")},
    "stage, Marlin": {"stage": STAGE.format("marlin", MARLIN)},
    "stage, Zaber": {"stage": STAGE.format("zaber", ZABER)},
    "cameras": {"cameras": ""},
}
BATHS = {
    "bath, Modbus TCP": ("tcp", "julabo-presto"),
    "bath, RTU over TCP": ("rtu+tcp", "watlow-pm-map2"),
    "bath, lines": ("tcp", "julabo-ascii"),
}
STAGES = {"stage, Grbl": "grbl", "stage, Marlin": "marlin"}


def rig_text(link: str, at: str, bath: str, recording: Path) -> str:
    """A rig whose ``link`` is at ``at``; the others are sound, or not there."""
    named = {key: value.format(at=at) for key, value in LINKS[link].items()}
    sound = {
        "calibration": (recording / "calibration.toml").as_posix(),
        "arm": "typed:",
        "bath": bath,
        "profile": "julabo-presto",
        "pump": "",
        "stage": "",
        "cameras": f"recording:{recording.as_posix()}",
    }
    text = RIG.format(**(sound | named))
    if link == "cameras":
        tables = "".join(
            f'\n[cameras.{name}]\nurl = "opencv:http://{at}/"\n' for name in ("left", "right")
        )
        text = text.replace('[cameras]\nurl = ""\n', "[cameras]\n") + tables
    return text


def commands(link: str, at: str, bath: str, folder: Path, recording: Path) -> Iterator[list[str]]:
    """Every command that opens ``link`` at the address ``at``."""
    rig = folder / "rig.toml"
    rig.write_text(rig_text(link, at, bath, recording), encoding="utf-8")
    script = folder / "script.toml"
    script.write_text(SCRIPT, encoding="utf-8")
    yield ["check", str(rig)]
    yield ["run", str(script), "--rig", str(rig), "--out", str(folder / "runs")]
    if link == "arm":
        port = ["--port", f"socket://{at}"]
        yield ["arm", "read", *port, "--homed"]
        yield ["arm", "watch", *port, "--homed", "--seconds", "5"]
        yield ["arm", "home", *port, "--on-peg"]
        yield ["init", *port, "--yes", "--out", str(folder / "made.toml")]
    if link in BATHS:
        scheme, profile = BATHS[link]
        to = ["--port", f"{scheme}://{at}", "--profile", profile]
        yield ["bath", "read", *to]
        yield ["bath", "watch", *to, "--seconds", "5"]
        yield ["bath", "learn", *to]
        yield ["bath", "set", *to, "33"]
        yield ["bath", "standby", *to]
        yield ["init", *to[:2], "--yes", "--out", str(folder / "made.toml")]
    if link in STAGES:
        to = ["--port", f"socket://{at}", "--dialect", STAGES[link]]
        yield ["stage", "status", *to]
        yield ["stage", "recover", *to]
        yield ["stage", "home", *to]
        yield ["stage", "move", *to, "--", "-100", "-100"]
    if link == "cameras":
        url = f"opencv:http://{at}/"
        yield ["camera", "show", url]
        yield ["camera", "grab", url, url, "--out", str(folder / "grabbed")]


CELLS = tuple((link, kind) for link in LINKS for kind in KINDS)


@dataclass(frozen=True)
class Outcome:
    """How one command ended at one peer."""

    link: str
    kind: str
    command: str
    code: int | None  # None: it had to be killed
    seconds: float
    mb: float
    said: str
    received: bytes
    heats: bool = False  # whether the sound bath beside it was left heating

    @property
    def name(self) -> str:
        return f"{self.command}, {self.link}, {self.kind}"

    @property
    def faults(self) -> list[str]:
        """What of it is not as it has to be."""
        found = []
        if self.code is None or self.seconds > WITHIN_S:
            found.append(f"it took {self.seconds:.0f} s")
        if self.mb > MOST_MORE_MB:
            found.append(f"it took {self.mb:.0f} MB")
        if "Traceback" in self.said or "mistake of the bench" in self.said:
            found.append("it calls it a mistake of its own")
        if self.code != self.expected_code:
            found.append(f"it ended with {self.code}")
        if self.command == "init" and "nothing that is known" not in self.said:
            found.append("it found an instrument")
        if self.code == 3 and "127.0.0.1" not in self.said:
            found.append("it does not say who")
        if self.heats:
            found.append("the bath beside it heats")
        return found + [f"it sent {one!r}" for one in self.dangerous]

    @property
    def expected_code(self) -> int:
        """3; but a relay that rests answers zeros too, until the pump is switched on."""
        rests = (self.command, self.link, self.kind) == ("check", "pump's relay", "zeros")
        return 0 if self.command == "init" or rests else 3

    @property
    def dangerous(self) -> list[bytes]:
        """What was sent that moves, heats or changes a setting; standby is asked for."""
        if self.command == "bath standby":
            return []
        return [one[0] for one in _MOVES.finditer(self.received)] + [
            one for one in _writes(self.received) if self.link.startswith(("bath, M", "bath, R"))
        ]


# lines that move or heat: G-code with axes, homing, jogs; Zaber's; circulators' set and start
_MOVES = re.compile(
    rb"\$H|\$J|G28|G[0-3] ?[XYZA]|move (?:abs|rel)|\d home|out_[a-z]+_\d\d|SS ?\d|SO ?1", re.I
)
_WRITES = (5, 6, 15, 16)


def _writes(sent: bytes) -> list[bytes]:
    """Requests of Modbus that write: TCP by their heads, RTU by their check sums."""
    found, at = [], 0
    while at + 8 <= len(sent):
        tcp = sent[at + 2 : at + 5] == b"\0\0\0" and sent[at + 5] >= 2
        length = 6 + sent[at + 5] if tcp else 1
        if tcp and sent[at + 7] in _WRITES:
            found.append(sent[at : at + length])
        at += length
    for at in range(len(sent) - 7):
        unit_on = sent[at : at + 8]
        if unit_on[1] in _WRITES[:2] and crc(unit_on[:6]) == unit_on[6:]:
            found.append(unit_on)
    return found


def outcomes(link: str, kind: str, recording: Path) -> list[Outcome]:
    """Each command of ``link``, one after another, at a peer of ``kind``."""
    found = []
    profile = RELAYED if link == "pump's relay" else "julabo-presto"
    with TemporaryDirectory() as made, hostile(kind) as peer, sound_bath(profile) as (plant, bath):
        at = f"127.0.0.1:{peer.port}"
        for arguments in list(commands(link, at, bath, Path(made), recording)):
            peer.received.clear()
            plant.standby()
            one = _outcome(link, kind, arguments, peer)
            found.append(replace(one, heats=plant.running))
    return found


@contextmanager
def sound_bath(profile: str) -> Iterator[tuple[Plant, str]]:
    """An emulated bath in real time, and its URL."""
    plant, family = Plant(1, start_c=20.0), load_register_profile(profile)
    with served(lambda clock: BathEmulator(plant, family, clock)) as (emulator, url):
        scheme = "tcp://" if emulator.framing == "tcp" else "rtu+tcp://"
        yield plant, url.replace("socket://", scheme)


def _outcome(link: str, kind: str, arguments: list[str], peer: HostilePeer) -> Outcome:
    start_s, code, said = time.monotonic(), None, list[str]()
    environment = {**os.environ, "COLUMNS": "300"}
    with begin(arguments, stdin=subprocess.PIPE, environment=environment) as process:
        first = peak = _resident_kb(process.pid)
        reader = threading.Thread(
            target=lambda: said.append(process.stdout.read() if process.stdout else "")
        )
        reader.start()
        with suppress(OSError):  # a person who agrees to everything
            assert process.stdin is not None
            process.stdin.write("\n" * 200)
            process.stdin.close()
        while (code := process.poll()) is None and time.monotonic() - start_s < 2 * WITHIN_S:
            peak = max(peak, _resident_kb(process.pid))
            time.sleep(0.05)
        seconds = time.monotonic() - start_s
        if code is None:
            process.kill()
        reader.join()
    command = " ".join(word for word in arguments[:2] if not word.startswith(("-", "/")))
    sent = b"".join(peer.received)
    return Outcome(link, kind, command, code, seconds, (peak - first) / 1024, "".join(said), sent)


def _resident_kb(pid: int) -> int:
    with suppress(psutil.Error):
        return int(psutil.Process(pid).memory_info().rss / 1024)
    return 0
