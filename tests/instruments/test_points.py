"""Points of other measuring arms: from a file that grows, and typed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from bench.rig.urls import arm_url
from bench.truth.touching import NoTruthError, TipReader, Toucher
from instruments.clock import VirtualClock
from instruments.errors import InstrumentError, LinkError, ProtocolError, TouchAgainError
from instruments.operators.operator import CheckPoint, Prompt, Release, Request, Touch
from instruments.operators.prompted import (
    PromptedOperator,
    ScriptedAnswer,
    ScriptedAnswers,
    check_answer,
)
from instruments.points import PointArm, points_url
from tests.bench.truth.touches import ENDS_MM, arm_settings, table_5_1

U_MM = 0.05
RESOLUTION_MM = 1.0  # most rows here are short


def arm_of(folder: Path, query: str = "", text: str = "x_mm,y_mm,z_mm\n") -> PointArm:
    (folder / "points.csv").write_bytes(text.encode())
    url = points_url(f"points:points.csv{query}")
    assert url is not None
    return PointArm(url, folder, VirtualClock(), U_MM, RESOLUTION_MM)


def add(folder: Path, text: str) -> None:
    with (folder / "points.csv").open("ab") as file:
        file.write(text.encode())


@pytest.mark.parametrize(
    ("heads", "row", "query"),
    [
        ("x_mm,y_mm,z_mm", "1.5,-2.25,300", ""),
        ("Nr;X [mm];Y [mm];Z [mm]", "7;1,5;-2,25;300", ""),
        ("point\tX\tY\tZ", "A1\t1,5\t-2,25\t300,0", "?unit=mm"),
        ("X (in),Y (in),Z (in)", "0.05905511811,-0.08858267717,11.81102362", ""),
        ("exported by ARM 3.1\nx y z", "1.5 -2.25 300", "?unit=mm"),
        ("", '"P 1",0.15,-0.225,30', "?unit=cm&columns=name,x,y,z"),
        ("z_m,u_m,x_m,y_m", "0.3,0.00004,0.0015,-0.00225", ""),
    ],
)
def test_a_point_is_read_as_its_software_writes_it(
    tmp_path: Path, heads: str, row: str, query: str
) -> None:
    arm = arm_of(tmp_path, query, f"{heads}\n" if heads else "")
    arm.sign_on()
    add(tmp_path, f"{row}\r\n")
    assert arm.read().tip_mm == pytest.approx([1.5, -2.25, 300.0], abs=1e-6)


def test_each_point_is_taken_once_and_those_from_before_never(tmp_path: Path) -> None:
    arm = arm_of(tmp_path, text="x_mm,y_mm,z_mm,i,j,k\n9,9,9,0,0,1\n")
    arm.sign_on()
    add(tmp_path, "1,2,3,0,0,2\n4,5")  # the second is still being written
    first = arm.read()
    assert first.tip_mm.tolist() == [1.0, 2.0, 3.0]
    assert first.written == "1,2,3,0,0,2"
    assert first.axis is not None
    assert first.axis.tolist() == [0.0, 0.0, 1.0]
    with pytest.raises(TouchAgainError, match=r"no new point came in .*points.csv within 10 s"):
        arm.read()
    add(tmp_path, ",6,3,4,0\n")
    second = arm.read()
    assert second.tip_mm.tolist() == [4.0, 5.0, 6.0]
    assert second.axis is not None
    assert second.axis.tolist() == pytest.approx([0.6, 0.8, 0.0])


@pytest.mark.parametrize(
    ("rows", "why"),
    [
        ("0,0,0,\n", "the row before is there once more, to the last digit"),
        ("10e1,20e1,30e1,\n", "is written to 10 mm, the rig file states 1 mm.*resolution_mm"),
        ("1,2,3,\n4,5,6,\n", "2 points came in .* where one was asked for"),
        ("1,2,,\n", "this row isn't a point: '1,2,,'"),
        ("1,2,nan,\n", "this row isn't a point"),
        ("a word\n", "this row isn't a point: 'a word'"),
        ("1,2,30000,\n", "farther than any arm reaches.*Is the unit right"),
        ("1,2,3,0.06\n", "its software states 0.060 mm of the point, the rig file 0.050 mm"),
    ],
)
def test_what_cannot_be_used_costs_the_touch_alone(tmp_path: Path, rows: str, why: str) -> None:
    arm = arm_of(tmp_path, text="x_mm,y_mm,z_mm,u_mm\n0,0,0,\n")
    arm.sign_on()
    add(tmp_path, rows)
    with pytest.raises(TouchAgainError, match=why):
        arm.read()
    add(tmp_path, "7,8,9,0.05\n")
    assert arm.read().tip_mm.tolist() == [7.0, 8.0, 9.0]


def test_a_point_from_before_its_prompt_is_of_no_touch(tmp_path: Path) -> None:
    arm = arm_of(tmp_path, "?wait_s=0")
    arm.sign_on()
    written = [("1,2,3\n", ""), ("", "4,5,6\n"), ("", "7,8,9\n")]  # before each prompt, and after

    class Person(PromptedOperator):
        def answer(self, prompt: Prompt, check: Callable[[], None]) -> str:
            add(tmp_path, written.pop(0)[1])
            return ""

        def say(self, text: str) -> None:
            raise AssertionError(text)

    person = Person()
    arm.asked_of(person)
    add(tmp_path, written[0][0])
    person.ask(CheckPoint(1, 2))
    with pytest.raises(TouchAgainError, match=r"no new point.*; 1 came before it was asked for"):
        arm.read()
    for place in ([4.0, 5.0, 6.0], [7.0, 8.0, 9.0]):
        person.ask(CheckPoint(1, 2))
        assert arm.read().tip_mm.tolist() == place


def test_a_file_that_is_gone_unclear_or_written_anew_is_refused(tmp_path: Path) -> None:
    for text, query, why in (
        ("x,y,z\n", "", "doesn't say the unit of x"),
        ("1,2,3\n", "?unit=mm", "has no row that heads its columns"),
    ):
        with pytest.raises(ProtocolError, match=why):
            arm_of(tmp_path, query, text).sign_on()
    arm = arm_of(tmp_path, text="x_mm,y_mm,z_mm\n1,2,3\n")
    arm.sign_on()
    (tmp_path / "points.csv").write_text("x_mm,y_mm,z_mm\n1,2,4\n5,6,7\n", encoding="utf-8")
    with pytest.raises(ProtocolError, match="rows that were there have changed or are gone"):
        arm.read()
    (tmp_path / "points.csv").unlink()
    with pytest.raises(LinkError, match=r"points.csv: No such file.*write its first point"):
        arm.read()


@pytest.mark.parametrize(
    ("url", "why"),
    [
        ("points:", "which file"),
        ("points:a.csv?units=mm", "unknown: units"),
        ("points:a.csv?unit=foot", "there are mm, cm, m, inch"),
        ("points:a.csv?columns=x,y", "has to name x, y and z"),
        ("points:a.csv?wait_s=soon", "seconds, 0 to 600"),
        ("typed:a.csv", "which file"),
        ("typed:?columns=x,y,z", "unknown: columns"),
        ("usb:", "their protocol isn't published.*points:FILE"),
        ("romer:", 'allowed: "emulator:".*of another make "points:FILE"'),
    ],
)
def test_a_url_that_is_none_says_what_is_allowed(url: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        arm_url(url)


@dataclass
class Hand:
    """Touches where it is asked to; before each answer the arm's software does as it ``writes``."""

    write: Callable[[str], None]
    rows: dict[int, str] = field(default_factory=dict)  # by the number of the touch, from 0
    asked: list[str] = field(default_factory=list)

    def ask(self, request: Request) -> None:
        if isinstance(request, Touch):
            x, y, z = ENDS_MM[request.teat - 1]
            usual = f"{x:.3f},{y:.3f},{z + 0.001 * len(self.asked):.3f}\n"
            self.write(self.rows.get(len(self.asked), usual))
            self.asked.append(request.again)
        else:
            assert isinstance(request, Release)


def test_the_truth_comes_from_points_and_a_missing_one_is_asked_for_again(tmp_path: Path) -> None:
    arm = arm_of(tmp_path, "?wait_s=0")
    arm.sign_on()
    hand = Hand(lambda row: add(tmp_path, row), {1: "", 4: "1,2,3\n4,5,6\n"})
    settings, clock = arm_settings(), VirtualClock()
    toucher = Toucher(
        hand.ask, TipReader(arm, settings, None), settings, clock, lambda: None, readings=3
    )
    points, rows = toucher.touch_all(table_5_1())
    assert np.array([point.xyz_mm for point in points]) == pytest.approx(ENDS_MM, abs=0.03)
    assert len(rows) == 3 * len(ENDS_MM)
    again = [text for text in hand.asked if text]
    assert len(again) == 2
    assert "no new point came" in again[0]
    assert "2 points came" in again[1]
    silent = Toucher(
        Hand(lambda _: None).ask, TipReader(arm, settings, None), settings, clock, lambda: None
    )
    with pytest.raises(NoTruthError, match="no new point came"):
        silent.touch_all(table_5_1())


@pytest.mark.parametrize(
    ("url", "answer", "mm"),
    [
        ("typed:", "-110.2 284.2 134.2", [-110.2, 284.2, 134.2]),
        ("typed:?unit=inch&serial=7001", "1,000; 2,000; 3,500", [25.4, 50.8, 88.9]),
        ("typed:", "1.5 2.5 3.5 0.6 0.8 0", [1.5, 2.5, 3.5]),
    ],
)
def test_typed_points(tmp_path: Path, url: str, answer: str, mm: list[float]) -> None:
    told = points_url(url)
    assert told is not None
    arm = PointArm(told, tmp_path, VirtualClock(), U_MM, RESOLUTION_MM)
    assert arm.sign_on().serial_number == ("7001" if "7001" in url else "not stated")
    with pytest.raises(InstrumentError, match="there is no terminal to type"):
        arm.read()
    arm.asked_of(ScriptedAnswers([ScriptedAnswer("coordinates", answer)], {}, "answers.toml"))
    reading = arm.read()
    assert reading.tip_mm == pytest.approx(mm)
    assert (reading.axis is None) == (len(answer.split()) == 3)


@pytest.mark.parametrize("answer", ["1 2", "1 2 3 4", "one 2 3", "1 2 inf", ""])
def test_what_is_no_point_is_asked_for_again(answer: str) -> None:
    with pytest.raises(ValueError, match='there are "X Y Z"'):
        check_answer("coordinates", answer)
