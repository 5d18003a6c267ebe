"""Every wire codec and small reader against damaged input: only its named errors leave it, in
bounded time and memory. Readers of people's files are damaged beside their own tests.
"""

from __future__ import annotations

import contextlib
import json
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.rig.loading import RIGS
from detector.calibration import load_calibration
from detector.external.lines import BadAnswer, GarbledLine, check_ready, parse_answer
from instruments.bath import protocol as modbus
from instruments.bath.line_access import LONGEST as LONGEST_LINE
from instruments.bath.line_access import Lines
from instruments.bath.profile import LineProfile, RegisterProfile, load_profile
from instruments.bath.requests import Answers, read_question, values_in, write_question
from instruments.bath.rows import LineRow
from instruments.bath.transactions import MOST_UNUSED
from instruments.camera.files import FileCamera
from instruments.camera.frame import Conversion, Radiometry, Ranging, RawFrame
from instruments.camera.opencv import OpenCvCamera
from instruments.camera.pixel_formats import FORMATS, unpack
from instruments.captures.capture import CaptureError, read_capture
from instruments.captures.replay import _ids
from instruments.clock import VirtualClock
from instruments.errors import InstrumentError
from instruments.microscribe import configuration as conf
from instruments.microscribe.protocol import Code, PacketDecoder, WireError
from instruments.operators.mailbox import (
    ANSWERS,
    FOLDER,
    PROMPT,
    Mailbox,
    NotOpenError,
    give_answer,
    read_answer,
    read_prompt,
)
from instruments.operators.operator import OperatorEnough
from instruments.operators.remote import read_line
from instruments.stage import marlin
from instruments.stage import protocol as grbl
from tests.conftest import ROOT
from tests.examples import examples
from tests.mutants import mutant

MUTANTS = 25  # of each of some samples, by each example that hypothesis draws
LONGEST_CPU_S = 5.0  # of one input; the usual one takes microseconds
MOST_BYTES = 16 << 20
FLOODS = (
    b"9",
    b"[",
    b"\x83",
    b"\0",
    b'{"a":',
    b"ok ",
    b"\n",
    b"<Idle|",
    b"\x01\x03\xfa",
    b"\xc6\xff",
)
FLOOD = 1 << 14
TALKS = ROOT / "tests/instruments/stage/witnesses"


@dataclass(frozen=True)
class Codec:
    """``read`` takes bytes such as ``samples``; ``errors`` may leave it. ``share``: of the usual
    number of inputs, for one that takes long.
    """

    read: Callable[[bytes], object]
    samples: tuple[bytes, ...]
    errors: tuple[type[Exception], ...] = ()
    share: float = 1.0

    def check(self, data: bytes) -> None:
        """One input. Fails where it takes too long or raises anything else."""
        began_s = time.process_time()
        with contextlib.suppress(*self.errors):
            self.read(data)
        took_s = time.process_time() - began_s
        assert took_s < LONGEST_CPU_S, f"{took_s:.1f} s for {data[:200]!r}"


def spoken(name: str) -> tuple[bytes, ...]:
    """What the firmware says in the transcript of that name."""
    lines = (TALKS / f"{name}.txt").read_text(encoding="utf-8").splitlines()
    answers = [line.partition("->")[2].strip() for line in lines if "->" in line]
    return tuple({"\n".join(answer.split(" | ")).encode() + b"\n" for answer in answers if answer})


def stage(parse: Callable[[bytes], grbl.Response]) -> Callable[[bytes], object]:
    def read(data: bytes) -> None:
        decoder = grbl.Decoder(parse)
        for answer in [one for at in (0, 1) for one in decoder.feed(data[at::2] + b"\n")]:
            if isinstance(answer, grbl.ErrorReply | grbl.Alarm):
                grbl.meaning(answer)
        assert len(decoder._pending) <= grbl.MAX_ANSWER

    return read


def marlin_settings(data: bytes) -> None:
    marlin.read_marlin(data.decode("utf-8", "replace").splitlines(), "XYZ", who="stage")


def arm_packets(data: bytes) -> None:
    for command in (None, 0x03):
        decoder = PacketDecoder(command)
        for at in range(0, len(data), 64):
            for packet in decoder.feed(data[at : at + 64]):
                assert all(0 <= count < 1 << 14 for count in packet.counts)
        assert decoder.pending <= 64


def arm_blocks(data: bytes) -> None:
    for decode in (
        conf.decode_maxima,
        conf.decode_parameters,
        conf.decode_stream,
        partial(conf.decode, Code.EXTENDED),
        partial(conf.decode_name, 0xC8),
    ):
        with contextlib.suppress(WireError):
            decode(data)
    for code in (0xC8, Code.PARAMETERS, Code.MAXIMA):
        conf.reply_length(code, data)


def modbus_server(data: bytes) -> None:
    for reader in (modbus.FrameReader(), modbus.RtuReader()):
        with contextlib.suppress(modbus.UnframedError):
            for frame in reader.feed(data, 0.0):
                with contextlib.suppress(modbus.ModbusException):
                    modbus.parse(frame.pdu)
        assert len(reader._buffer) <= max(len(data), modbus.LONGEST_RTU)


def modbus_answers(data: bytes) -> None:
    for rtu in (True, False):
        asked = [read_question(3, 10, 4, 1), write_question(16, 7, [1, 2], 1)]
        answers = Answers(rtu=rtu)
        for question in asked:
            answers.put(question, 0.0)
        assert 0 <= answers.feed(data[:MOST_UNUSED]) <= MOST_UNUSED
        for question in asked:
            if question.answer is not None:
                values_in(question.answer)


@cache
def profiles() -> tuple[Any, ...]:
    return tuple(
        load_profile(path) for path in sorted((ROOT / "instruments/bath/profiles").glob("*.toml"))
    )


def bath_rows(data: bytes) -> None:
    """Every row of every shipped profile, with the text of a reply or the registers of one."""
    line = data[:LONGEST_LINE].decode("ascii", "replace").strip()
    words = np.frombuffer(data[: len(data) // 2 * 2][:8], dtype=">u2").tolist()
    for profile in profiles():
        for row in profile.rows:
            with contextlib.suppress(ValueError):
                if isinstance(row, LineRow):
                    row.decode(line)
                else:
                    assert isinstance(profile, RegisterProfile)
                    row.decode(words, profile.order)


def bath_lines(data: bytes) -> None:
    lines = Lines.__new__(Lines)  # without a link: what comes is given
    lines._reply_end, lines._buffer, lines._open, lines.in_step = b"\r\n", b"", None, True
    lines._profile = next(one for one in profiles() if isinstance(one, LineProfile))
    for at in range(0, len(data), 50):
        lines.take(data[at : at + 50])
        assert len(lines._buffer) <= LONGEST_LINE


def pixels(data: bytes) -> None:
    """The first bytes say format, size and padding; the rest is the payload."""
    head, payload = data[:8].ljust(8, b"\0"), data[8:]
    layout = FORMATS[head[0] % len(FORMATS)]
    code = layout.code ^ (1 << head[1] % 64 if head[1] > 200 else 0)
    image, bits = unpack(payload, code, head[2], head[3], head[4] % 9)
    raw = RawFrame(image, 0.0, bits, Ranging(0.1))
    for convert in (
        Conversion().picture,
        Conversion(radiometry=Radiometry(0.01)).temperatures,
        Conversion().depth,
    ):
        with contextlib.suppress(ValueError):
            convert(raw)


class InFile:
    """A reader of a path, given bytes."""

    def __init__(self, folder: Path, name: str, read: Callable[[Path], object]) -> None:
        self.path, self.read = folder / name, read
        self.path.parent.mkdir(parents=True, exist_ok=True)

    def __call__(self, data: bytes) -> None:
        self.path.write_bytes(data)
        self.read(self.path)


def taken(camera: Any) -> None:
    """All frames of a camera by a file."""
    with contextlib.closing(camera):
        for _ in range(20):
            camera.begin()
            camera.take()


def mailbox(path: Path) -> None:
    folder = path.parent.parent
    if (asked := read_prompt(folder)) is not None:
        assert isinstance(asked["number"], int)
    with contextlib.suppress(NotOpenError, ValueError):
        give_answer(folder, -7, "", "fuzz")
    Mailbox(folder)


def encoded(ending: str) -> bytes:
    picture = np.arange(24 * 16, dtype=np.uint16).reshape(16, 24) * 170
    return cv2.imencode(ending, picture)[1].tobytes()


def encoded_video(folder: Path, codec: str, ending: str) -> bytes:
    path = folder / f"made.{ending}"
    fourcc = cv2.VideoWriter.fourcc(*codec)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, 25.0, (64, 48))
    for level in range(4):
        writer.write(np.full((48, 64, 3), 50 * level, np.uint8))
    writer.release()
    return path.read_bytes()


CAPTURE = (
    b'{"format": "teatbench capture", "version": 1, "wall_time": "w", "teatbench": "0", "command":'
    b' "c", "machine": "m"}\n{"t_s": 0.5, "link": "arm", "event": "opened", "url": "COM5"}\n'
    b'{"t_s": 1.0, "link": "arm", "event": "sent", "data": "03"}\n{"t_s": 1.25, "link": "arm",'
    b' "event": "received", "data": "83 00"}\n{"t_s": 2, "link": "arm", "event": "closed"}\n'
)
PROMPTED = json.dumps(
    {"kind": "touch", "text": "Touch LF", "progress": "1 of 4", "hidden_to": 4, "pedal": True}
    | {"enough": False, "press": False, "number": 7, "open": True, "by": "", "in_trial": True}
    | {"explained": "…", "wall_time": "2026-01-01T00:00:00"}
).encode()
GIVEN = b'{"number": 7, "words": "skip", "by": "browser", "wall_time": "2026-01-01"}'
ANSWER = json.dumps(
    {
        "frame": "7",
        "teats": [
            {"world_mm": [1, 2.5, 3], "covariance_mm2": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
            {"left_px": [100, 200], "right_px": [90.5, 200]},
        ],
        "hidden": 1,
        "reason": "why",
        "predicted": [{"world_mm": [0, 0, 0]}],
    }
).encode()
READY = b'{"ready": true, "device": "cpu", "trained_on": {"cows": ["c1"], "herds": []}}'
MASTER = bytes.fromhex("000100000006010300000004") + bytes.fromhex(
    "01030000000444 09".replace(" ", "")
)
SLAVE = modbus.framed(1, bytes.fromhex("03080001000200030004"))
NAMES = (
    *("microscribe packets", "microscribe blocks", "grbl", "grblhal", "marlin", "marlin settings"),
    *("modbus requests", "modbus answers", "modbus in captures", "bath rows"),
    *("bath lines", "pixels", "capture", "prompt", "answer", "remote operator", "ready"),
    *("detection", "png", "tiff", "mjpeg", "mpeg4"),
)


def codecs(folder: Path) -> dict[str, Codec]:
    """All by `NAMES`; those that read files do so in ``folder``."""
    calibration = load_calibration(RIGS / "calibration.toml")
    run, clock = folder / "run" / FOLDER, VirtualClock()
    answers = run / ANSWERS
    answers.mkdir(parents=True)
    replies = (
        b"24.05\r\n02 REMOTE STOP\r\n{S0109C4\r\nBS000000000000$\r\n-1\r\n",
        b"T124.05$",
        b"+24.05",
    )

    def pictures(name: str) -> InFile:
        return InFile(folder, name, lambda path: taken(FileCamera("left", path, clock)))

    def films(name: str) -> InFile:
        return InFile(folder, name, lambda path: taken(OpenCvCamera("left", str(path), clock)))

    marlins = spoken("marlin")
    stored = b"echo:  M92 X80.00 Y80.00 Z400.00 E93.00\necho:  M203 X300.00 Y300.00 Z5.00 E25.00\n"
    stored += (
        b"echo:  M201 X3000.00 Y3000.00 Z100.00 E10000.00\necho:Soft endstops: On  Min:  X0.00"
    )
    stored += b" Y0.00 Z0.00   Max:  X299.00 Y274.00 Z49.00\n"
    made = (
        Codec(arm_packets, (bytes.fromhex("8300 20002000200020002000 2000".replace(" ", "")) * 3,)),
        Codec(arm_blocks, (b"\xc8MicroScribe\0", b"\xc6" + bytes(60), b"\xc0\x24" + bytes(36))),
        Codec(stage(grbl.parse), spoken("grbl-locked")),
        Codec(stage(grbl.parse), spoken("fluidnc")),
        Codec(stage(marlin.parse), marlins),
        Codec(marlin_settings, (stored,), (InstrumentError,)),
        Codec(modbus_server, (MASTER, MASTER[12:])),
        Codec(modbus_answers, (SLAVE, b"\0\1\0\0\0\x0b\1" + SLAVE[1:-2])),
        Codec(lambda data: list(_ids(data)), (MASTER,)),
        Codec(bath_rows, (*replies, *replies[0].split()), (), 0.1),
        Codec(bath_lines, replies),
        Codec(
            pixels,
            tuple(bytes((at, 0, 6, 4, 0, 0, 0, 0)) + bytes(96) for at in range(19)),
            (ValueError,),
        ),
        Codec(InFile(folder, "c.jsonl", read_capture), (CAPTURE,), (CaptureError,), 0.3),
        Codec(InFile(run, PROMPT, mailbox), (PROMPTED,), (), 0.1),
        Codec(
            InFile(answers, "7.json", lambda path: read_answer(path.parents[2], 7)),
            (GIVEN,),
            (),
            0.3,
        ),
        Codec(
            lambda data: read_line(data, "touch", "operator"),
            (b'{"done": {"visible": []}}', b'{"enough": "x"}', b'{"refused": "no"}'),
            (InstrumentError, OperatorEnough),
        ),
        Codec(check_ready, (READY,), (GarbledLine,)),
        Codec(
            lambda data: parse_answer(data, "7", calibration), (ANSWER,), (GarbledLine, BadAnswer)
        ),
        Codec(pictures("p.png"), (encoded(".png"),), (InstrumentError,), 0.1),
        Codec(pictures("p.tiff"), (encoded(".tiff"),), (InstrumentError,), 0.1),
        Codec(films("f.avi"), (encoded_video(folder, "MJPG", "avi"),), (InstrumentError,), 0.02),
        Codec(films("f.mp4"), (encoded_video(folder, "mp4v", "mp4"),), (InstrumentError,), 0.02),
    )
    return dict(zip(NAMES, made, strict=True))


@pytest.fixture(scope="module")
def all_codecs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Codec]:
    return codecs(tmp_path_factory.mktemp("fuzzing"))


@pytest.fixture
def codec(all_codecs: dict[str, Codec], request: pytest.FixtureRequest) -> Codec:
    return all_codecs[str(request.param)]


every = pytest.mark.parametrize("codec", NAMES, indirect=True)


@pytest.mark.slow
@every
def test_only_named_errors_leave_a_reader(codec: Codec) -> None:
    """Some four thousand inputs in all: damaged samples, and any bytes."""

    @settings(max_examples=max(1, round(examples(8) * codec.share)))
    @given(st.randoms(use_true_random=False), st.binary(max_size=80))
    def damaged(rng: Any, other: bytes) -> None:
        codec.check(other)
        for _ in range(MUTANTS):
            codec.check(mutant(rng.choice(codec.samples), rng))

    damaged()


@pytest.mark.slow
@every
def test_floods_take_bounded_memory(codec: Codec) -> None:
    codec.check(codec.samples[0])  # what is loaded once is no flood's
    for flood in (*FLOODS, *codec.samples[:1]):
        data = (flood * (FLOOD // len(flood) + 1))[:FLOOD]
        tracemalloc.start()
        try:
            codec.check(codec.samples[0] + data)
            assert tracemalloc.get_traced_memory()[1] < MOST_BYTES, flood
        finally:
            tracemalloc.stop()
