"""What every way into a rig leaves behind, however the process ends: emulators in a process of
their own, the bench in another, and a reader here that shares nothing with either. It types the
bytes of the makers' documents and asks the wire.

A Zaber stage, because opening its port stops nothing: what stands was told to stop. What its host
sends goes through a relay of this process, which shows when a motion begins.
"""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from bench.rig.loading import RIGS
from tests.bench.forked import Running, begin
from tests.bench.operated_runs import ONE
from tests.bench.safety.guards import guardians_of
from tests.bench.small_cameras import write_calibration
from tests.conftest import ROOT
from tests.waiting import PATIENCE_S, alive, within

BASE = (
    (RIGS / "emulated.toml")
    .read_text(encoding="utf-8")
    .replace(
        '[stage]\nurl = "emulator:"',
        '[stage]\nurl = "emulator:zaber?devices=1,2&microsteps=250,250"\n'
        "reference_mm = [150.0, 137.5]",
    )
)

CAMERAS = """[cameras]
url = "recording:recording"
settle_s = 0.1
"""

# JULABO PRESTO: function 3, holding register 0, 0 standby and 1 started (fact sheet, 1.2)
ASK_RUN = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
STARTS = {0: False, 1: True}
# Zaber ASCII: the state of an axis stands in each reply (maker's manual)
ASK_STAGE = b"/%d 1 07 get pos\n"
REPLY = re.compile(rb"@\d\d 1 07 OK (IDLE|BUSY) (\S\S) (-?\d+)")
BEGUN = {"home": b" home", "move": b" move abs"}


class Relay:
    """A port of this process that leads to ``port``, each connection to one of its own."""

    def __init__(self, port: int) -> None:
        self._port, self._listening = port, socket.create_server(("127.0.0.1", 0))
        self.sent = b""  # by all hosts since `forget`
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def port(self) -> int:
        return int(self._listening.getsockname()[1])

    def forget(self) -> None:
        self.sent = b""

    def close(self) -> None:
        self._listening.close()

    def _accept(self) -> None:
        with suppress(OSError):  # closed
            while True:
                host, _ = self._listening.accept()
                device = socket.create_connection(("127.0.0.1", self._port))
                for ends in ((host, device, True), (device, host, False)):
                    threading.Thread(target=self._carry, args=ends, daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket, noted: bool) -> None:
        with suppress(OSError):
            while piece := source.recv(4096):
                self.sent += piece * noted
                sink.sendall(piece)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()


@dataclass
class Elsewhere:
    """Emulators of another process, and what the wire says of them."""

    folder: Path
    said: str = ""
    rig_path: Path = field(init=False)
    relay: Relay = field(init=False)

    def __post_init__(self) -> None:
        self.rig_path = self.folder / "lab.toml"

    def port(self, name: str) -> int:
        found = re.search(rf"^{name} \S+:(\d+)", self.said, re.MULTILINE)
        assert found, self.said
        return int(found[1])

    def heats(self) -> bool:
        """Whether the controller says that it is started."""
        with socket.create_connection(("127.0.0.1", self.port("bath")), timeout=PATIENCE_S) as wire:
            wire.sendall(ASK_RUN)
            answer = b""
            while len(answer) < 11:
                piece = wire.recv(64)
                assert piece, "the bath hung up"
                answer += piece
        return STARTS[int.from_bytes(answer[9:11], "big")]

    def start_heating(self) -> None:
        """Somebody else has left it on: function 6, register 0, 1."""
        with socket.create_connection(("127.0.0.1", self.port("bath")), timeout=PATIENCE_S) as wire:
            wire.sendall(bytes.fromhex("0001 0000 0006 01 06 0000 0001"))
            assert len(wire.recv(64)) == 12

    def moves(self) -> bool:
        """Whether an axis says that it is busy. The newest host has the stage's port."""
        busy = False
        with socket.create_connection(
            ("127.0.0.1", self.port("stage")), timeout=PATIENCE_S
        ) as wire:
            for device in (1, 2):
                wire.sendall(ASK_STAGE % device)
                answer = b""
                while not (found := REPLY.search(answer)):
                    piece = wire.recv(256)
                    if not piece:  # the guardian has opened the port meanwhile
                        return True
                    answer += piece
                busy = busy or found[1] == b"BUSY"
        return busy


@contextmanager
def emulators(folder: Path, recording: Path) -> Iterator[Elsewhere]:
    """`teatbench emulate` in a process of its own, and the rig file that it writes, with cameras
    that play a recording: pictures over a network come late on a busy machine.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_calibration(folder)
    (folder / "recording").symlink_to(recording, target_is_directory=True)
    base, written = folder / "base.toml", folder / "written.toml"
    base.write_text(BASE, encoding="utf-8")
    there = Elsewhere(folder)
    with begin(["emulate", base, "--write-rig", written]) as process:
        try:
            assert process.stdout
            while "written:" not in there.said:
                line = process.stdout.readline()
                assert line, there.said
                there.said += line
            there.relay = Relay(there.port("stage"))
            text, _, _ = written.read_text(encoding="utf-8").partition("[cameras]")
            text = text.replace(f":{there.port('stage')}", f":{there.relay.port}")
            there.rig_path.write_text(f"{text}{CAMERAS}", encoding="utf-8")
            with closing(there.relay):
                yield there
        finally:
            process.kill()


# ---- ways in

SCRIPT = """
import os, signal, sys, time
from pathlib import Path

from bench.rig.loading import load_rig
from bench.rig.opening import open_instruments

rig, what, end = load_rig(Path(sys.argv[1])), sys.argv[2], sys.argv[3]


def work(devices):
    if what == "heats":
        devices.bath.start(33.0)
    else:
        devices.stage.connect()
        devices.stage.home()
        devices.stage.jog(x_mm=250.0, feed_mm_min=300.0)
    print("@@ under way", flush=True)
    if end == "exception":
        raise RuntimeError("a mistake")
    if end == "sys.exit":
        sys.exit(7)
    if end in ("context", "interpreter"):
        return
    while True:  # Ctrl-C comes in a call of Python's own
        time.sleep(0.05)


names = ("bath",) if what == "heats" else ("stage",)
if end == "interpreter":  # entered, and never left
    devices = open_instruments(rig, names).__enter__()
    work(devices)
else:
    with open_instruments(rig, names) as devices:
        work(devices)
"""
# the terminal on standard input becomes the controlling one, as in a shell
LAUNCH = """
import fcntl, runpy, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""

# what the console's page does when somebody presses Start there
CONSOLE = """
import sys, time
from pathlib import Path

from bench.console.starting import start
from bench.record.state import holder_of
from instruments.clock import RealClock

out = Path(sys.argv[1])
name = start(["run", *sys.argv[2:], "--out", str(out)], out, RealClock())
print(f"@@ run {holder_of(out / name)['pid']}", flush=True)
time.sleep(600.0)
"""

TRIALS = re.sub(r"\nwindow_s(?:.*\n)*?\n", "\n\n", ONE)  # with the gate as it is usual


@dataclass
class Dying:
    """A process on a terminal of its own, in a session of its own. ``pid`` is what dies."""

    process: Running
    pid: int
    master: int
    pieces: list[bytes] = field(default_factory=list)

    @property
    def said(self) -> str:
        """What it has shown so far."""
        os.set_blocking(self.master, False)
        with suppress(BlockingIOError, OSError):  # a terminal without a process has an error
            while piece := os.read(self.master, 4096):
                self.pieces.append(piece)
        return b"".join(self.pieces).decode("utf-8", "replace")

    def until(self, there: Callable[[], bool], what: str) -> None:
        within(there, what, said=lambda: self.said, code=self.process.poll)


@contextmanager
def on_a_terminal(arguments: Sequence[object], *, script: bool = False) -> Iterator[Dying]:
    """`teatbench` with these arguments, or a Python program."""
    master, slave = os.openpty()
    words = [str(one) for one in arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    process: Running
    if script:
        command = [sys.executable, "-c", LAUNCH, *words]
        process = subprocess.Popen(
            command,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            cwd=ROOT,
            env=environment,
            start_new_session=True,
            encoding="utf-8",
        )
    else:
        process = begin(
            words, stdin=slave, stdout=slave, stderr=slave, environment=environment, terminal=True
        )
    os.close(slave)
    dying = Dying(process, process.pid, master)
    try:
        yield dying
    finally:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(process.pid, signal.SIGKILL)
        process.wait(PATIENCE_S)
        with suppress(OSError):
            os.close(master)


def stop_signal(name: str) -> Callable[[Dying], None]:
    return lambda dying: os.kill(dying.pid, getattr(signal, name))


def close_terminal(dying: Dying) -> None:
    dying.said  # noqa: B018 - reads what is there
    os.close(dying.master)
    dying.master = os.open(os.devnull, os.O_RDONLY)


DEATHS: dict[str, Callable[[Dying], None]] = {
    "kill -9": stop_signal("SIGKILL"),
    "group kill": lambda dying: os.killpg(dying.pid, signal.SIGKILL),
    "SEGV": stop_signal("SIGSEGV"),
    "INT": stop_signal("SIGINT"),
    "TERM": stop_signal("SIGTERM"),
    "HUP": stop_signal("SIGHUP"),
    "hang": stop_signal("SIGSTOP"),
    "terminal closed": close_terminal,
}
ENDINGS = ("exception", "sys.exit", "interpreter", "context")  # of a script alone

HEATS, MOVES = "heats", "moves"


@dataclass(frozen=True)
class Way:
    """A command with ``{rig}``, ``{capture}`` and ``{out}``; what it does then (``does``) and the
    motion that it begins with; ``script``: a Python program that gets how it ends, or that
    starts a run (``begun``).
    """

    words: str
    does: str
    begun: str = ""
    script: bool = False
    said: str = ""


CAPTURED = "--rig {rig} --capture {capture}"
RUN = "run {trials} --out {out}"
WAYS: dict[str, Way] = {
    "script that heats": Way("{script} {rig} heats {end}", HEATS, script=True),
    "script that moves": Way("{script} {rig} moves {end}", MOVES, script=True),
    "stage home": Way(f"stage home {CAPTURED}", MOVES, "home"),
    "stage move": Way(f"stage move {CAPTURED} --feed 300 250 100", MOVES, "move"),
    "stage jog": Way(f"stage jog {CAPTURED} --feed 300 X250", MOVES, "move"),
    "calibrate stage": Way(f"calibrate stage {CAPTURED} --out {{out}}/reg.toml", MOVES, "home"),
    "run": Way(f"{RUN} {CAPTURED}", HEATS),
    "run, homing": Way(f"{RUN} {CAPTURED}", MOVES, "home"),
    "run by the console's page": Way(
        "{console} {out} {trials} --rig {rig}", HEATS, script=True, begun="run"
    ),
    "run beside a console": Way(f"{RUN} {CAPTURED} --console", HEATS),
}


def safe_after(there: Elsewhere, does: str) -> float:
    """How long what heats or moves goes on, as the wire says."""
    start, asks = time.monotonic(), there.heats if does == HEATS else there.moves
    while True:
        if does == MOVES:  # to ask is to take the port from whoever stops it
            time.sleep(0.4)
        if not asks():
            return time.monotonic() - start
        assert time.monotonic() - start < PATIENCE_S, f"it still {does}"
        time.sleep(0.02)


def die(there: Elsewhere, name: str, death: str, folder: Path) -> tuple[float, str]:
    """Bring the process of this way to what it does, let it die; seconds until safe, its words."""
    way, capture = WAYS[name], folder / "capture.jsonl"
    folder.mkdir(parents=True)
    places: dict[str, object] = {"rig": there.rig_path, "capture": capture, "out": folder}
    for what, text in (("script.py", SCRIPT), ("console.py", CONSOLE), ("trials.toml", TRIALS)):
        (folder / what).write_text(text, encoding="utf-8")
        places[what.partition(".")[0]] = folder / what
    places["end"] = death if death in ENDINGS else "waits"
    words = [word.format(**places) for word in way.words.split()]
    assert not there.heats(), "the last one left it on"
    there.relay.forget()
    with on_a_terminal(words, script=way.script) as dying:
        if death in ENDINGS:
            dying.process.wait(PATIENCE_S)
            assert "@@ under way" in dying.said, dying.said
        else:
            begun(there, dying, way)
            DEATHS[death](dying)
        seconds = safe_after(there, way.does)
        if death == "hang":
            _end_hung(dying.pid)
        return seconds, dying.said


def _end_hung(pid: int) -> None:
    """End a stopped process, and wait for its guardian, which tries again where `safe_after` took
    the port from it, and would take it from whoever comes next.
    """
    with suppress(psutil.NoSuchProcess):
        guardians = [one.pid for one in guardians_of(pid)]
        psutil.Process(pid).kill()
        within(lambda: not any(map(alive, guardians)), "the guardian's end")


def begun(there: Elsewhere, dying: Dying, way: Way) -> None:
    if way.begun == "run":  # a process of its own, which the page's end doesn't touch
        dying.until(lambda: bool(re.search(r"@@ run \d+\s", dying.said)), "began")
        dying.pid = int(re.findall(r"@@ run (\d+)\s", dying.said)[0])
        dying.until(there.heats, "heated")
    elif way.script:
        dying.until(lambda: "@@ under way" in dying.said, "began")
    elif way.does == HEATS:
        dying.until(there.heats, "heated")
    else:
        dying.until(lambda: BEGUN[way.begun] in there.relay.sent, "moved")
        time.sleep(0.3)  # amid the motion
