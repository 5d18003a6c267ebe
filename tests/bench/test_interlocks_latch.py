"""The latch: what it keeps, whom it stops, and what takes it away."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from bench.rig import RIGS, LoadedRig, find_rig, load_rig
from bench.safety.interlocks import InterlockTrip
from bench.safety.latch import Latch, LatchedError, acknowledge, latch_path, read_latch, refuse_latched, set_latch
from instruments.bath.reading import BathReading

CALM = BathReading(t_s=0.0, temp_c=33.0, raw=(1, 2), external_c=None, power_percent=2.0, safety_c=None, alarm=0, warning=0, remote=True)
TRIP = InterlockTrip("controller alarm", "the controller reports alarm 1", "Clear it there.", ({"t_s": 1.0, "temp_c": 33.0},))


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
    with pytest.raises(LatchedError, match=r"controller alarm.*reports alarm 1.*Clear it there\. Then: teatbench bath acknowledge"):
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
