"""Runs and commands with an arm that the bench can't speak to: its software adds points to a file,
here the test, or the operator types them. Checks, budgets and evidence are those of any arm.
"""

from __future__ import annotations

import io
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bench.record.reader import read_run
from bench.results.stated_arm import arm_checks
from bench.rig.arm_files import load_frame, load_verification
from bench.truth.arm_check import AFTER, CHECK_FACT, new_touches
from tests.bench.commands import Said, lab_rig, teatbench
from tests.bench.real_rig import real_rig, record_one
from tests.plain_text import plain_text

CHECK_MM = (-190.0, 120.0, 15.0)
Places = Callable[[str], tuple[float, ...] | None]


class Hand(io.StringIO):
    """Who sits at the terminal: at each prompt for a touch the arm's software writes a point, or the
    person types it. ``place``: where the tip is held for the last lines that were shown.
    """

    def __init__(self, shown: io.StringIO, place: Places, file: Path | None) -> None:
        super().__init__()
        self._shown, self._place, self._file = shown, place, file
        self._rng = np.random.default_rng(5)
        self._at = 0
        self._points = 0
        self._last: tuple[float, ...] | None = None

    def readline(self, _: int | None = -1, /) -> str:  # type: ignore[override]
        text, self._at = self._shown.getvalue()[self._at :], len(self._shown.getvalue())
        place = self._place(text)
        if self._file is None:  # the prompt for the touch, then that for what is displayed
            self._last = place or self._last
            place = self._last if "Type x, y and z" in text else None
        if place is None:
            return "\n"
        x, y, z = np.array(place) + self._rng.normal(0.0, 0.03, 3)
        self._points += 1
        if self._file is None:
            lean = self._points % 3 - 1  # the stylus, as the display shows it
            return f"{x:.2f} {y:.2f} {z:.2f} {0.6 * lean} 0 {1 - 0.2 * abs(lean)}\n"
        with self._file.open("a", encoding="utf-8") as file:
            for part in (f"P{self._points};{x:.3f};", f"{y:.3f};{z:.3f}".replace(".", ","), "\n"):
                file.write(part.replace(".", ","))
                file.flush()
        return "\n"


@pytest.fixture
def sit(monkeypatch: pytest.MonkeyPatch) -> Callable[[Places, Path | None], io.StringIO]:
    def at_terminal(place: Places, file: Path | None) -> io.StringIO:
        shown = io.StringIO()
        monkeypatch.setattr(sys, "stdout", shown)
        monkeypatch.setattr(sys, "stdin", Hand(shown, place, file))
        return shown

    return at_terminal


def url_of(folder: Path, kind: str) -> tuple[str, Path | None]:
    """The arm's URL, and the file that its software writes."""
    if kind == "typed":
        return "typed:?serial=E9-04521", None
    file = folder / "faro.csv"
    file.write_text("Report of 23.11.2026\nNr;X [mm];Y [mm];Z [mm]\n", encoding="utf-8")
    return "points:faro.csv?serial=E9-04521", file


@pytest.mark.slow
def test_a_run_takes_its_truth_from_elsewhere(
    tmp_path: Path, sit: Callable[[Places, Path | None], io.StringIO]
) -> None:
    with real_rig(tmp_path / "rig", record_one(tmp_path / "recording", 1), check_touches=5) as rig:
        url, file = url_of(rig.folder, "points")
        stated = f'url = "{url}"\nresolution_mm = 0.001\naccuracy_mm = 0.03\naccuracy_source = "ISO 10360-12, 2026"'
        text = rig.rig_path.read_text(encoding="utf-8")
        arm = f'url = "{rig.twin.urls["arm"]}"'
        assert arm in text
        rig.rig_path.write_text(text.replace(arm, stated), encoding="utf-8")
        ends = rig.twin.world.ends_mm()

        def place(shown: str) -> tuple[float, ...] | None:
            if teat := re.findall(r"end of teat (\d)", shown):
                return tuple(ends[int(teat[-1]) - 1])
            return CHECK_MM if "divot of the check point" in shown else None

        shown = sit(place, file)
        code = teatbench("run {} --rig {} --out {}", rig.script_path, rig.rig_path, rig.out)
        folder = rig.run_folder()
    assert code == 0, shown.getvalue()
    assert "Reference the measuring arm as its maker says" in shown.getvalue()
    run = read_run(folder)
    assert run.facts["identities"]["arm"]["serial_number"] == "E9-04521"
    (trial,) = run.trials
    touched = np.array([[row["x_mm"], row["y_mm"], row["z_mm"]] for row in trial.touches])
    np.testing.assert_allclose(touched, ends, atol=0.2)
    written = json.loads(trial.touches[0]["counts"])
    assert written.startswith("P6;")
    sources = {one["name"]: one for one in json.loads(trial.truth[0]["budget"])["components"]}
    assert sources["arm"]["u_mm"] == 0.03
    assert "ISO 10360-12, 2026" in sources["arm"]["source"]
    assert sources["resolution"]["u_mm"] == pytest.approx(0.001 / 12**0.5)
    (check,) = arm_checks(run.facts)
    assert check.df == 15  # five touches before the trials and one after them
    assert 0.5 < check.ratio < 1.6
    assert "how far the stylus swung is not known" in str(run.events)
    assert new_touches(run.facts[CHECK_FACT.format(AFTER)]) == 1
    assert "ISO 10360-12, 2026" in plain_text(folder / "report" / "index.html")


def at_bench(shown: str) -> tuple[float, ...] | None:
    """A table's origin, axis and plane, one divot, and a length of 300 mm."""
    for words, place in {
        "origin (world": (100.0, 50.0, 0.0),
        "on the x axis": (400.0, 50.0, 0.0),
        "positive y": (200.0, 350.0, 0.0),
        "another point of the": (350.0, 300.0, 0.0),
        "tip in the divot": (300.0, 100.0, 20.0),
        "its first end": (100.0, 100.0, 30.0),
        "its second end": (100.0, 400.0, 30.0),
        "to be read": (10.0, 20.0, 30.0),
    }.items():
        if words in shown:
            return place
    return None


@pytest.mark.parametrize("kind", ["points", "typed"])
def test_frame_verification_and_reading_at_the_terminal(
    tmp_path: Path,
    kind: str,
    sit: Callable[[Places, Path | None], io.StringIO],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    url, file = url_of(tmp_path, kind)
    shown = sit(at_bench, file)
    assert teatbench("arm frame --homed --port {} --out frame.toml", url) == 0, shown.getvalue()
    frame = load_frame(Path("frame.toml"), serial_number="E9-04521")
    np.testing.assert_allclose(frame.world_from_arm.T, (-100.0, -50.0, 0.0), atol=0.3)
    plan = "--distances 1 --touches 5 --length-mm 300 --directions 2 --accuracy-mm 0.05"
    code = teatbench("arm verify --homed --port {} --out verified.toml {}", url, plan.split())
    found = load_verification(Path("verified.toml"))
    if kind == "typed":
        assert code == 0, shown.getvalue()
        assert found.locations[0].swing_deg == pytest.approx(73.74, abs=0.01)
    else:
        assert code == 4  # nothing is refuted, and how the arm turned is not known
        assert found.locations[0].swing_deg is None
    assert found.length_mm is not None
    assert found.length_mm < 0.2
    assert "--accuracy-mm 0.05 is not refuted" in shown.getvalue()
    monkeypatch.setattr(sys, "stderr", sit(at_bench, file))  # where questions are with --json
    monkeypatch.setattr(sys, "stdout", shown := io.StringIO())
    command = "arm read --json --homed --port {} --frame frame.toml"
    assert teatbench(command, url) == 0
    line = json.loads(shown.getvalue())
    np.testing.assert_allclose(line["world_mm"], (-90.0, -30.0, 30.0), atol=0.4)
    assert (line["axis"] is None) == (kind == "points")


def test_what_is_missing_or_wrong_is_said(tmp_path: Path, said: Said) -> None:
    out = tmp_path / "v.toml"
    assert "--accuracy-mm is needed" in said(2, "arm verify --port typed: --out {}", out).err
    assert "the software of another arm does that" in said(2, "arm watch --homed --port typed:").err
    gone = f"points:{tmp_path / 'none.csv'}"
    assert "write its first point there" in said(3, "arm read --homed --port {}", gone).err
    rig = lab_rig(tmp_path, {})
    text = re.sub(
        r'(\[arm\].*?\n)url = "[^"]*".*?\n', r'\1url = "typed:"\n', rig.read_text("utf-8")
    )
    rig.write_text(re.sub(r"\naccuracy_(mm = |source = ).*", "", text), encoding="utf-8")
    assert "accuracy_mm and accuracy_source are needed" in said(2, "check {}", rig).err
