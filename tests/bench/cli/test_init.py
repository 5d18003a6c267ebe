"""`init` finds instruments without moving, heating or setting any, and writes a rig."""

from __future__ import annotations

import io
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path

import pytest

from bench.cli.init import _bath
from bench.rig import finding
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import MISSING, PLACES, find_rig, load_rig
from bench.rig.model import Rig
from instruments.clock import RealClock, VirtualClock
from instruments.link import Link
from instruments.listener import Listener
from instruments.stage.emulator.board import StageEmulator
from instruments.stage.emulator.store import FLUIDNC, MARLIN, ZABER, Firmware
from tests.bench.commands import Said, teatbench

LISTED = [("opencv:4", "Cam A"), ("genicam:FLIR-1", "FLIR A50"), ("genicam:", "not looked for")]


@pytest.fixture(scope="module")
def twin() -> Iterator[EmulatedRig]:
    with closing(RealClock()) as clock:
        rig = load_rig(find_rig("emulated"))
        with EmulatedRig(rig, clock, 1, pty=sys.platform != "win32") as emulated:
            yield emulated


@pytest.fixture(autouse=True)
def _here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few profiles, short waits, no look for cameras of this machine."""
    monkeypatch.setattr(finding, "LISTEN_S", 0.6)
    monkeypatch.setattr(finding, "profile_names", lambda: ["julabo-magio", "julabo-presto"])
    monkeypatch.setattr("bench.list_cameras", lambda: iter(LISTED), raising=False)
    monkeypatch.setattr("bench.rig.finding.list_ports.comports", list)


def typed(monkeypatch: pytest.MonkeyPatch, *lines: str) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n".join(lines) + "\n"))


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    """What was written to each link, by its URL."""
    bytes_of: dict[str, bytes] = {}
    write = Link.write

    def noted(link: Link, data: bytes) -> None:
        bytes_of[link.url] = bytes_of.get(link.url, b"") + data
        write(link, data)

    monkeypatch.setattr(Link, "write", noted)
    return bytes_of


def rig_of(path: Path) -> Rig:
    return load_rig(path).rig


@pytest.mark.slow
def test_instruments_are_found_and_nothing_of_them_changes(
    twin: EmulatedRig,
    tmp_path: Path,
    said: Said,
    monkeypatch: pytest.MonkeyPatch,
    sent: dict[str, bytes],
) -> None:
    urls: Mapping[str, str] = {name: twin.urls[name] for name in ("arm", "bath", "stage")}
    plant, stage = twin.world.plant, twin.stage
    assert stage
    before = plant.set_point_c, plant.running, tuple(stage.position_mm())
    out = tmp_path / "my-rig.toml"
    typed(
        monkeypatch,
        *("north lab", "3DL", "julabo-presto", "2026-11-20", "xyz"),
        *("opencv:4", "opencv:5", "genicam:FLIR-1", "flir-a"),
    )
    text = said(0, "init --out {} --port {} --port {} --port {}", out, *urls.values()).out
    assert "opencv:4: camera, Cam A" in text
    rig = rig_of(out)
    assert (rig.name, rig.arm.url, rig.bath.url) == ("north lab", urls["arm"], urls["bath"])
    assert (rig.arm.accuracy_mm, rig.arm.accuracy_source) == (0.64, "maker's data sheet, 3DL")
    assert (rig.bath.profile, rig.bath.cut_out_tested) == ("julabo-presto", "2026-11-20")
    assert rig.stage
    assert (rig.stage.url, rig.stage.axes) == (urls["stage"], "XYZ")
    assert rig.cameras.thermal
    assert rig.cameras.thermal.radiometric
    assert rig.cameras.thermal.settings.features == {"IRFormat": "TemperatureLinear10mK"}
    assert set(sent[urls["stage"]]) == set(b"?"), "a stage is asked for its status only"
    assert (plant.set_point_c, plant.running, tuple(stage.position_mm())) == before
    file = out.read_text(encoding="utf-8")
    assert f"#   {urls['arm']}: arm, MicroScribe" in file
    assert "# remind_s = 120.0" in file


class Clock(VirtualClock):
    def close(self) -> None: ...


@pytest.mark.parametrize(
    ("dialect", "answers", "expected", "allowed"),
    [
        (FLUIDNC, [], {"dialect": "grbl"}, b"?"),
        (
            MARLIN,
            ["90, 80"],
            {"dialect": "marlin", "reference_mm": (90.0, 80.0)},
            b"?IMCBEGN\xc5M15\n",
        ),
        (
            ZABER,
            ["1 1, 2 1", "2500, 2500", ""],
            {"reference_mm": (150.0, 137.5)},
            b"?IMCBEGN\xc5M15\n/get pos",
        ),
    ],
    ids=lambda value: value.name if isinstance(value, Firmware) else "",
)
def test_stages_of_every_firmware_are_found_by_questions_alone(
    tmp_path: Path,
    said: Said,
    monkeypatch: pytest.MonkeyPatch,
    sent: dict[str, bytes],
    dialect: Firmware,
    answers: list[str],
    expected: dict[str, object],
    allowed: bytes,
) -> None:
    clock = Clock()
    stage = StageEmulator(clock, dialect=dialect)
    monkeypatch.setattr("bench.rig.finding.RealClock", lambda: clock)
    typed(monkeypatch, "lab", "XY", *answers, "", "", "")
    before = tuple(stage.position_mm())
    listener = Listener(stage, clock, lock=threading.RLock(), name="stage")
    with closing(listener):
        out = tmp_path / "my-rig.toml"
        text = said(0, "init --out {} --port {}", out, listener.url).out
        if dialect is ZABER:
            unknown = said(0, "init --yes --out {} --port {}", tmp_path / "b.toml", listener.url)
            assert "left out" in unknown.out
            assert rig_of(tmp_path / "b.toml").stage is None
    found = rig_of(out).stage
    assert found
    if dialect is ZABER:
        keys = "devices=1.1,2.1&microsteps=2500,2500&axes=XY"
        assert found.url == f"plugin:zaber?{keys}&url={listener.url}"
    assert {key: getattr(found, key) for key in expected} == expected
    assert f"{listener.url}: stage, {dialect.name}" in text
    assert set(b"".join(sent.values())) <= set(allowed)
    assert tuple(stage.position_mm()) == before


def test_what_is_not_found_is_marked_and_the_file_can_be_checked(
    tmp_path: Path, said: Said
) -> None:
    out = tmp_path / "my-rig.toml"
    marked: dict[str, str] = {}
    text = said(0, "init --yes --out {}", out).out
    assert "no serial port on this machine" in text
    for name in ("arm", "bath", "cameras.left", "cameras.right"):
        assert f"not found: {name}; its url is marked in the file" in text
    rig = rig_of(out)
    assert rig.stage is None
    assert rig.cameras.thermal is None
    assert out.read_text(encoding="utf-8").count(MISSING) == 4
    lines = out.read_text(encoding="utf-8").splitlines()
    for name, url in PLACES.items():
        (at,) = (n for n, line in enumerate(lines, 1) if f'"{url}"' in line and "# NOT" in line)
        marked[name] = f"not filled in yet: {out}:{at} ({name}.url)"
    seen = said(2, "check {}", out).out  # a file to be put right, no fault of an instrument
    assert "FAULT" not in seen
    assert all(text in seen for text in marked.values())
    assert "Check cable" not in seen
    runs = tmp_path / "runs"
    for more in ("", " --dry-run"):
        seen = said(2, "run six-situations --rig {} --out {}" + more, out, runs).err
        assert all(text in seen for text in marked.values())
    assert not runs.exists()
    again = said(2, "init --yes --out {}", out).err
    assert "is there already" in again
    assert teatbench("init --yes --replace --out {}", out) == 0


def test_a_place_that_was_filled_in_is_no_placeholder(tmp_path: Path, said: Said) -> None:
    """By its url, or by leaving out the mark where what stands there is right."""
    out = tmp_path / "my-rig.toml"
    said(0, "init --yes --out {}", out)
    text = out.read_text(encoding="utf-8").replace("opencv:LEFT", "opencv:3")
    bath = next(line for line in text.splitlines() if PLACES["bath"] in line)
    out.write_text(text.replace(bath, bath.partition("#")[0]), encoding="utf-8")
    assert [one.split()[-1] for one in load_rig(out).unfilled()] == [
        "(arm.url)",
        "(cameras.right.url)",
    ]
    assert load_rig(out).unfilled("bath", "stage") == []
    assert "(cameras.right.url)" in said(2, "camera focus {} --seconds 0.1", out).err


@pytest.mark.parametrize("answer", ["2026-11-20", ""])
def test_a_bath_whose_unit_nothing_tells_is_asked_about(answer: str) -> None:
    asked: list[str] = []

    def ask(question: str, default: str) -> str:
        asked.append(question)
        return answer if "display" in question else default

    values = _bath(finding.FoundInstrument("bath", "/dev/ttyUSB1", "it", ("lauda-ascii",)), ask)
    assert values == {"profile": "lauda-ascii", "cut_out_tested": "", "unit_confirmed": answer}
    assert "'teatbench bath read' show the same, in degC" in asked[-1]
    told = _bath(finding.FoundInstrument("bath", "/dev/ttyUSB1", "it", ("julabo-presto",)), ask)
    assert told.keys() == {"profile", "cut_out_tested"}


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        (["lab", "4"], "4: not a camera; allowed:"),
        (["lab", "opencv:1", "opencv:2", "opencv:3", "leptom"], "'leptom' is not one of lepton"),
    ],
)
def test_an_answer_that_makes_no_sense_writes_nothing(
    tmp_path: Path, said: Said, monkeypatch: pytest.MonkeyPatch, answers: list[str], message: str
) -> None:
    typed(monkeypatch, *answers)
    assert message in said(2, "init --out {}", tmp_path / "rig.toml").err
    assert not (tmp_path / "rig.toml").exists()


def test_a_port_that_is_not_there_is_said(tmp_path: Path, said: Said) -> None:
    text = said(0, "init --yes --out {} --port socket://127.0.0.1:1", tmp_path / "r.toml").out
    assert "nothing takes the connection" in text
    assert "socket://127.0.0.1:1: nothing that is known" in text
