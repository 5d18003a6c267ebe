"""`teatbench bath …` on an emulated bath of another thread."""

from __future__ import annotations

import inspect
import io
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import bench
from bench.cli.bath_plot import HEIGHT, WIDTH, BathPlot, output_strip, plot, show_views
from instruments.bath.emulator import BathEmulator
from instruments.bath.line_emulator import LineEmulator
from instruments.bath.profile import SHIPPED, LineProfile, load_profile
from instruments.bath.reading import BathReading
from instruments.clock import VirtualClock
from instruments.errors import LinkError
from instruments.world.plant import Plant
from tests.bench.commands import Said, served, teatbench
from tests.instruments.bath.devices import load_register_profile


@dataclass
class Served:
    plant: Plant
    emulator: BathEmulator
    at: list[str]


@pytest.fixture
def bath() -> Iterator[Served]:
    """``at`` are the arguments that lead to it."""
    plant, profile = Plant(1, start_c=25.0), load_register_profile("julabo-presto")
    with served(lambda clock: BathEmulator(plant, profile, clock)) as (emulator, url):
        at = ["--port", url.replace("socket", "tcp"), "--profile", "julabo-presto"]
        yield Served(plant, emulator, at)


def test_read_says_everything_with_units(bath: Served, said: Said) -> None:
    note = json.loads(said(0, "bath read {} --json", bath.at).out)
    assert note["temp_c"] == pytest.approx(25.0, abs=0.05)
    known = {"run": "standby", "output_percent": 0.0, "alarm": 0, "comms_loss": "hold"}
    assert note | known == note
    shown = said(0, "bath read {}", bath.at).out.strip()
    lines = dict(line.split(": ", 1) for line in shown.split("\n"))
    assert ["schema_version", *lines] == list(note)
    assert lines["family"] == "JULABO PRESTO"
    bath.plant.run(33.0)
    assert json.loads(said(0, "bath read {} --json", bath.at).out)["run"] == "started"
    assert bath.plant.running, "reading leaves a hot bath as it is"


@pytest.mark.slow
def test_learn_says_row_by_row_what_answered_and_writes_nothing(tmp_path: Path, said: Said) -> None:
    """A profile with one wrong command and one wrong form, on a JULABO that heats."""
    profile, plant = load_profile("julabo-ascii"), Plant(1, start_c=25.0)
    assert isinstance(profile, LineProfile)
    text = (SHIPPED / "julabo-ascii.toml").read_text(encoding="utf-8")
    text = text.replace('ask = "in_pv_01"', 'ask = "in_pv_99"')
    text = text.replace('reply = "<number> <text>"', 'reply = "<number>"')
    mine = tmp_path / "mine.toml"
    mine.write_text(text.replace("timeout_s = 1.0", "timeout_s = 0.3"), encoding="utf-8")
    plant.run(33.0)
    with served(lambda clock: LineEmulator(plant, profile, clock)) as (_, url):
        at = ["--port", url.replace("socket", "tcp"), "--profile", str(mine)]
        out = said(0, "bath learn {}", at).out
        rows = {
            one["row"]: one for one in json.loads(said(0, "bath learn {} --json", at).out)["rows"]
        }
    lines = {line.split()[1]: line for line in out.splitlines()}
    right = r"\+ temperature +'in_pv_00': 2\d\.?\d* degC \(got '2\d\.\d\d'\)"
    assert re.match(right, lines["temperature"])
    assert re.match(r"- power .*it does not know this command", lines["power"])
    assert re.search(r"expects .<number>. .*got 03 REMOTE START", lines["alarm"])
    assert lines["run"].endswith("'in_mode_05': started (got '1')")
    assert (rows["power"]["answered"], rows["version"]["answered"]) == (False, True)
    assert (plant.running, plant.set_point_c) == (True, 33.0), "learning changes nothing"


def test_learn_tries_a_modbus_profile_too(bath: Served, said: Said) -> None:
    out = said(0, "bath learn {}", bath.at).out
    assert re.search(r"\+ temperature +input 10, f32: 2\d\.?\d* degC \(got 41", out)
    assert "- " not in out.replace("- bath", "")


def test_learn_counts_no_number_that_no_bath_has(bath: Served, tmp_path: Path, said: Said) -> None:
    """The safety sensor one register too high, as it once was: half of two numbers."""
    text = (SHIPPED / "julabo-presto.toml").read_text(encoding="utf-8")
    mine = tmp_path / "mine.toml"
    text = text.replace('address = 15\ntype = "f32"', 'address = 16\ntype = "f32"')
    mine.write_text(text, encoding="utf-8")
    # half of 41C7 AE14 is no temperature; of 41C7 FFCC, which 25 degC cools to, not-a-number
    bath.plant.ambient_c = 24.96
    bath.plant.be_at(24.96)
    out = said(0, "bath learn {}", [*bath.at[:3], str(mine)]).out
    assert re.search(
        r"^\? safety +input 16, f32: can't be its value \(got [0-9A-F ]+\)$", out, re.M
    )
    right, asked = map(int, re.findall(r"(\d+) of (\d+) rows that can be read made sense", out)[0])
    assert right == asked - 1
    assert not re.search(r"\de[+-]\d", out)
    said(3, "bath read {}", [*bath.at[:3], str(mine)])


def test_set_changes_the_set_point_and_starts_nothing(bath: Served, said: Said) -> None:
    assert "33.50 degC; the bath is in standby" in said(0, "bath set {} 33.5", bath.at).out
    assert bath.plant.set_point_c == pytest.approx(33.5)
    assert not bath.plant.running


@pytest.mark.slow
def test_where_nothing_tells_the_unit_a_person_compares_with_the_display(said: Said) -> None:
    profile, plant = load_profile("lauda-ascii"), Plant(1, start_c=25.0)
    assert isinstance(profile, LineProfile)
    with served(lambda clock: LineEmulator(plant, profile, clock)) as (_, url):
        at = ["--port", url.replace("socket", "tcp"), "--profile", "lauda-ascii"]
        note = json.loads(said(0, "bath read {} --json", at).out)
        assert note["number_unit"] == "not stated by the controller"
        refused = said(2, "bath set {} 33", at).err
        assert "nothing tells whether its numbers are degC" in refused
        assert "they are not both degC" in said(3, "bath set {} 33 --display 77", at).err
        assert plant.set_point_c == 25.0
        assert "33.00 degC" in said(0, "bath set {} 33 --display 25.1", at).out
        assert plant.set_point_c == 33.0
        plant.run(33.0)
        assert said(0, "bath standby {}", at).out.startswith("in standby")
        assert not plant.running


def test_standby_stops_a_bath_with_an_alarm_and_a_broken_sensor(
    bath: Served, capsys: pytest.CaptureFixture[str]
) -> None:
    bath.plant.run(33.0)
    bath.emulator.fault("sensor break")
    assert teatbench("bath standby {}", bath.at) == 0
    assert not bath.plant.running
    assert "in standby; no temperature" in capsys.readouterr().out


@pytest.mark.slow
def test_watch_prints_a_line_a_second_without_a_terminal(bath: Served, said: Said) -> None:
    bath.plant.run(33.0)
    lines = said(0, "bath watch {} --seconds 2.5", bath.at).out.strip().split("\n")
    assert 1 <= len(lines) <= 3, "a busy machine gets round to fewer"
    assert all("set point 33.00 degC" in line and "heating" in line for line in lines)
    assert bath.plant.running, "watching changes nothing"


class ExpectedScene(io.StringIO):
    """A terminal at which somebody presses Ctrl-C after three readings."""

    pressed = False

    def write(self, text: str) -> int:
        count = super().write(text)
        if not self.pressed and self.getvalue().count("last ") >= 3:
            self.pressed = True
            raise KeyboardInterrupt
        return count


@pytest.mark.slow
def test_watch_on_a_terminal_is_a_live_plot_of_everything(bath: Served) -> None:
    bath.plant.run(33.0)
    shown = ExpectedScene()
    console = Console(file=shown, force_terminal=True, width=120, height=40, color_system=None)
    with bench.open_bath(bath.at[1], "julabo-presto") as driver, pytest.raises(KeyboardInterrupt):
        show_views(bench.watch_bath(driver), console)
    frames = shown.getvalue().split("last ")
    last = frames[-2] + frames[-1]
    assert "33.00 ─" in last, "the set point is a line"
    assert "•" in last, "the bath is points"
    assert re.search("output [ ▁▂▃▄▅▆▇]*█", last), "a cold bath is heated at full power"
    for text in ("set point 33.00 degC", "output 100 %", "heating", "not getting nearer"):
        assert text in last
    assert bath.plant.running, "watching changes nothing"


class Readings:
    """A bath that reads what ``temp_c`` says of the time, with a set point of 33 degC."""

    profile = load_register_profile("julabo-presto")

    def __init__(self, temp_c: Callable[[float], float], alarm: int = 0) -> None:
        self.clock, self.temp_c, self.alarm = VirtualClock(), temp_c, alarm

    def get(self, name: str) -> float:
        return 33.0 if name == "set_point" else self.profile.row("run").values["started"]

    def read(self) -> BathReading:
        t_s = self.clock.now()
        if (temp_c := self.temp_c(t_s)) < 0.0:
            raise LinkError("bath", "cable")
        return a_reading(t_s, temp_c, 100.0 if t_s < 50 else None, self.alarm)

    def views(self, count: int, window_s: float = 600.0) -> list[bench.BathView]:
        watch: Any = inspect.unwrap(bench.watch_bath)  # it isn't all of a bath
        return list(islice(watch(self, clock=self.clock, window_s=window_s), count))


def test_a_stable_bath_says_so_and_one_on_its_way_says_when() -> None:
    shown, lines = BathPlot(), []
    for view in Readings(lambda t: min(33.0, 31.0 + t * 0.04) + 0.004 * (t % 2)).views(200, 60.0):
        shown.add(view)
        lines.append(shown.line())
    assert "stable in 1:36 min at the earliest" in lines[10], lines[10]
    assert "settling, stable in 0:" in lines[80]
    assert lines[-1].endswith("stable, stable now")
    strip = output_strip([a_reading(float(t), 33.0, 100.0 if t < 36 else 3.0) for t in range(72)])
    assert (strip.count("█"), strip.count("▁")) == (35, 36), "one column is that of now"
    assert output_strip([a_reading(0.0, 33.0, None)]) == "", "an output that is not told"


def a_reading(
    t_s: float, temp_c: float, output_percent: float | None, alarm: int = 0
) -> BathReading:
    raw, others = (round(temp_c * 1000),), (None, alarm, 0, True)
    return BathReading(t_s, temp_c, raw, None, output_percent, *others)


def test_a_set_point_beyond_the_profile_is_refused_and_not_sent(bath: Served, said: Said) -> None:
    assert "takes 5 to 36 degC" in said(2, "bath set {} 45", bath.at).err
    assert bath.plant.set_point_c == 25.0


def samples(at: dict[float, float]) -> list[BathReading]:
    return [a_reading(t_s, temp_c, None) for t_s, temp_c in at.items()]


def test_the_plot_has_the_set_point_as_a_line_and_the_bath_as_points() -> None:
    lines = plot(samples({float(t): 20.0 + t / 10 for t in range(131)}), 33.0)
    assert len(lines) == HEIGHT + 1
    assert {len(line) for line in lines[:-1]} == {8 + WIDTH}
    (line,) = [text for text in lines if "33.00" in text]
    assert "─" in line
    columns = [
        next((i for i, text in enumerate(lines[:-1]) if text[8 + x] == "•"), None)
        for x in range(WIDTH)
    ]
    assert None not in columns
    assert columns == sorted(columns, key=lambda row: -(row or 0)), "it rises from left to right"


def test_a_steady_bath_does_not_fill_the_plot_with_its_noise() -> None:
    lines = plot(samples({float(t): 33.0 + 0.004 * (t % 2) for t in range(60)}), 33.0)
    assert sum("•" in line for line in lines[:-1]) <= 2


@pytest.mark.parametrize(
    ("temp_c", "seconds", "expected"),
    [
        (lambda t: 20.0 + t * 0.04, 101, (33.0 - 24.0 - 0.15) / 0.04 + 600.0),
        (lambda t: 24.0 - t * 0.01, 101, None),
        (lambda _: 24.0, 3, None),
        (lambda t: 33.0 + 0.01 * (t % 3), 101, 500.0),
        (lambda t: 33.0 + 0.01 * (t % 3), 701, 0.0),
        (lambda t: min(33.0, 20.0 + t * 0.02) + 0.01 * (t % 3), 801, 600.0 - (800 - 643)),
    ],
)
def test_the_time_to_stable_is_way_and_window(
    temp_c: Callable[[float], float], seconds: int, expected: float | None
) -> None:
    found = Readings(temp_c).views(seconds)[-1].stable_in_s
    assert found == (None if expected is None else pytest.approx(expected))


def test_a_bath_that_cannot_be_read_is_reported_beside_its_last_reading() -> None:
    shown = BathPlot()
    for view in Readings(lambda t: 24.0 if t == 1.0 else -1.0, alarm=3).views(3):
        shown.add(view)
        assert "NO READING: bath: cable" in shown.line() or view.fault == ""
    for text in ("24.00 degC", "output 100 %", "alarm 3", "NO READING: bath: cable"):
        assert text in shown.line()
    assert len(list(shown.lines())) == 17
