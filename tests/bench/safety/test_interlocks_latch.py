"""The latch: what it keeps, whom it stops, and what takes it away."""

from __future__ import annotations

from dataclasses import replace
from datetime import date
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.config import ConfigError
from bench.rig.loading import RIGS, LoadedRig, find_rig, load_rig
from bench.safety.interlocks import InterlockTrip
from bench.safety.latch import (
    Latch,
    LatchedError,
    acknowledge,
    latch_path,
    read_latch,
    refuse_latched,
    refuse_untested_cut_out,
    set_latch,
)
from instruments.bath.reading import BathReading
from tests.conftest import ROOT

CALM = BathReading(
    t_s=0.0,
    temp_c=33.0,
    raw=(1, 2),
    external_c=None,
    power_percent=2.0,
    safety_c=None,
    alarm=0,
    warning=0,
    remote=True,
)
TRIP = InterlockTrip(
    "controller alarm",
    "the controller reports alarm 1",
    "Clear it there.",
    ({"t_s": 1.0, "temp_c": 33.0},),
)


@pytest.fixture
def lab(tmp_path: Path) -> LoadedRig:
    for name in ("lab.example.toml", "calibration.toml"):
        (tmp_path / name).write_text((RIGS / name).read_text(encoding="utf-8"), encoding="utf-8")
    return load_rig(tmp_path / "lab.example.toml")


def latched(rig: LoadedRig) -> Latch:
    latch = read_latch(latch_path(rig))
    assert latch is not None
    return latch


def test_a_trip_keeps_the_rig_from_starting_and_says_what_and_what_to_do(lab: LoadedRig) -> None:
    refuse_latched(lab)
    path = latch_path(lab)
    assert path == lab.path.with_name("lab.example.tripped.json")
    set_latch(path, TRIP, "runs/one")
    set_latch(path, InterlockTrip("rate", "later", "Other."), "runs/one")
    with pytest.raises(
        LatchedError,
        match=(
            r"controller alarm.*reports alarm 1.*Clear it there\. Then: teatbench bath acknowledge"
        ),
    ):
        refuse_latched(lab)
    assert latched(lab).told["values"] == [{"t_s": 1.0, "temp_c": 33.0}]


def test_it_goes_when_its_cause_has_gone_and_not_before(lab: LoadedRig) -> None:
    path = latch_path(lab)
    assert path is not None
    set_latch(path, TRIP, "runs/one")
    with pytest.raises(LatchedError, match=r"still reports alarm 1.*resets with: alarm code 0"):
        acknowledge(lab, latched(lab), replace(CALM, alarm=1))
    assert path.exists()
    acknowledge(lab, latched(lab), CALM)
    assert read_latch(path) is None
    refuse_latched(lab)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"rule": "of another bench"}'])
def test_a_latch_that_cannot_be_understood_latches_all_the_same(lab: LoadedRig, text: str) -> None:
    path = latch_path(lab)
    assert path is not None
    path.write_text(text, encoding="utf-8")
    with pytest.raises(LatchedError):
        refuse_latched(lab)
    acknowledge(lab, latched(lab), CALM)
    refuse_latched(lab)


def test_a_mistake_of_the_bench_latches_too(lab: LoadedRig) -> None:
    path = latch_path(lab)
    assert path is not None
    set_latch(path, ZeroDivisionError("division by zero"), "runs/one")
    with pytest.raises(LatchedError, match="ZeroDivisionError"):
        refuse_latched(lab)


def test_an_emulated_rig_has_no_latch() -> None:
    assert latch_path(load_rig(find_rig(None))) is None


TODAY = date(2026, 11, 22)


def with_bath(folder: Path, profile: str, tested: str) -> LoadedRig:
    """The rig of the fixture ``lab`` in ``folder``, with another bath."""
    path = folder / "lab.example.toml"
    text = (RIGS / path.name).read_text(encoding="utf-8")
    text = text.replace('"julabo-presto"', f'"{profile}"')
    text = text.replace('cut_out_tested = ""', f'cut_out_tested = "{tested}"')
    path.write_text(text, encoding="utf-8")
    return load_rig(path)


@pytest.mark.parametrize(("profile", "loss"), [("julabo-presto", "hold"), ("omega-cn7", "unknown")])
def test_a_bath_that_may_stay_hot_needs_a_tested_cut_out(
    profile: str, loss: str, lab: LoadedRig, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError) as caught:
        refuse_untested_cut_out(with_bath(tmp_path, profile, ""), TODAY)
    said = str(caught.value)
    assert f'comms_loss = "{loss}"' in said
    assert said.startswith(f"{lab.path}: 1 fault\n{lab.path}:")
    assert 'write the day: cut_out_tested = "2026-11-22"' in said
    refuse_untested_cut_out(with_bath(tmp_path, profile, "2026-11-22"), TODAY)


@pytest.mark.parametrize("loss", ["stop", "safe_setpoint"])
def test_a_bath_that_stops_by_itself_needs_none(loss: str, lab: LoadedRig, tmp_path: Path) -> None:
    shipped = ROOT / "instruments" / "bath" / "profiles" / "julabo-presto.toml"
    text = shipped.read_text(encoding="utf-8").replace(
        'comms_loss = "hold"', f'comms_loss = "{loss}"'
    )
    (tmp_path / "own.toml").write_text(text, encoding="utf-8")
    refuse_untested_cut_out(with_bath(tmp_path, "own.toml", ""), TODAY)


def test_an_emulated_rig_has_no_cut_out() -> None:
    refuse_untested_cut_out(load_rig(find_rig(None)), TODAY)


def test_a_day_that_is_still_to_come_is_no_test(lab: LoadedRig, tmp_path: Path) -> None:
    refuse_untested_cut_out(with_bath(tmp_path, "julabo-presto", "2026-11-23"), TODAY)
    with pytest.raises(ConfigError, match="still to come"):
        refuse_untested_cut_out(with_bath(tmp_path, "julabo-presto", "2026-11-24"), TODAY)
    with pytest.raises(ConfigError, match=r'cut_out_tested: .*write it as "2026-11-20"'):
        with_bath(tmp_path, "julabo-presto", "yesterday")


def test_a_run_on_a_real_rig_is_refused_before_anything_is_opened(
    lab: LoadedRig, short_script: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["run", str(short_script), "--rig", str(lab.path), "--out", str(tmp_path / "runs")]
    assert main(arguments) == 2
    assert "bath.cut_out_tested: missing: nothing is heated" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
