"""The arm's two dated files: what is written is read again, and whatever is wrong with one is shown
in its place.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.config import ConfigError, write_file
from bench.rig.arm_files import (
    LengthTest,
    LocationTest,
    TableFrame,
    TouchedPoint,
    Verification,
    VerificationLimits,
    frame_text,
    load_frame,
    load_verification,
    verification_text,
)
from bench.toml import toml_text
from tests.bench.calibrate.arm_rig import MADE
from tests.bench.calibrate.test_arm_dialogues import CROSS, SWUNG

NEAR_MM = np.array([200.0, 0.0, 20.0])
FRAME = TableFrame.from_touches(
    MADE,
    "40937",
    [
        TouchedPoint("origin", (-60.25, 203.5, -11.5), 0.12),
        TouchedPoint("x axis", (203.25, 59.75, -16.5), 0.13),
        TouchedPoint("plane", (88.25, 350.25, -15.5), 0.15),
        TouchedPoint("check 1", (75.25, 243.5, -14.5), 0.10, (100.0, 100.0, 0.0)),
        TouchedPoint("check 2", (174.25, 257.75, -16.75), 0.22),
    ],
)
VERIFICATION = Verification(
    MADE,
    "40937",
    (
        LocationTest("near", CROSS + NEAR_MM, SWUNG),
        LocationTest("far", 0.5 * CROSS + 2.0 * NEAR_MM, SWUNG),
    ),
    (LengthTest("upright", np.zeros(3), np.array([0.0, 0.0, 300.25]), 300.0),),
)
LIMITS = VerificationLimits(0.46, 0.7)


def written(tmp_path: Path, text: str, *changes: tuple[str, str]) -> Path:
    for old, new in changes:
        assert text.count(old) >= 1, old
        text = text.replace(old, new, 1)
    path = tmp_path / "arm.toml"
    write_file(path, text)
    return path


def refused(load: Callable[..., object], path: Path, place: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(path)
    text = str(caught.value)
    assert re.search(rf"{re.escape(str(path))}:\d+: {re.escape(place)}", text), text
    assert message in text


def test_a_frame_is_read_as_it_was_written(tmp_path: Path) -> None:
    again = load_frame(written(tmp_path, frame_text(FRAME)), serial_number="40937")
    for key in ("made", "serial_number", "points"):
        assert getattr(again, key) == getattr(FRAME, key)
    assert np.allclose(again.world_from_arm.R, FRAME.world_from_arm.R, atol=1e-12)
    assert again.residuals_mm == pytest.approx(FRAME.residuals_mm)


def test_other_programs_find_the_motion_in_a_frame_file(tmp_path: Path) -> None:
    """Worked through by Rodrigues' formula here, with nothing of the bench: the origin's touch is
    the world's origin.
    """
    table = tomllib.loads(written(tmp_path, frame_text(FRAME)).read_text(encoding="utf-8"))
    om = np.array(table["om"])
    angle = float(np.linalg.norm(om))
    x, y, z = om / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    R = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    assert np.allclose(R @ table["points"][0]["arm_mm"] + table["T"], 0.0, atol=1e-6)
    on_x = R @ table["points"][1]["arm_mm"] + table["T"]
    assert on_x[0] > 100.0
    assert np.allclose(on_x[1:], 0.0, atol=1e-6)
    assert table["made"] == datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


@pytest.mark.parametrize(
    ("change", "place", "message"),
    [
        (
            ("40937", "40938"),
            "serial_number",
            "of the arm 40938, but the arm that answers is 40937",
        ),
        (("residual_mm = ", "residul_mm = "), "residul_mm", 'did you mean "residual_mm"?'),
        (("made = 2026-03-04T05:06:07+00:00", "made = 2026-03-04T05:06:07"), "made", "timezone"),
        (("made = 2026-03-04T05:06:07+00:00\n", ""), "made", "is missing"),
        (("T = [", "T = [9"), "T", "doesn't follow from what was touched"),
        (("om = [", "om = [1"), "om", "doesn't follow from what was touched"),
        (("350.25, -15.5]", "350.25]"), "points[3].arm_mm", "missing"),
        (("350.25, -15.5]", "350.25, nan]"), "points[3].arm_mm", "finite"),
        (("[203.25, 59.75, -16.5]", "[-59.25, 203.5, -11.5]"), "points", "100 mm are needed"),
        (('name = "check 2"', 'name = "check 1"'), "points", "same name"),
        (
            ("spread_mm = 0.12", "spread_mm = -1.0"),
            "points[1].spread_mm",
            "greater than or equal to 0",
        ),
        (("[100.0, 100.0, 0.0]", "[100.0, 101.0, 0.0]"), "residual_mm", "doesn't follow"),
    ],
)
def test_a_faulty_frame_file_is_refused_in_its_place(
    tmp_path: Path, change: tuple[str, str], place: str, message: str
) -> None:
    load = partial(load_frame, serial_number="40937")
    refused(load, written(tmp_path, frame_text(FRAME), change), place, message)


def test_a_verification_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = written(tmp_path, verification_text(VERIFICATION, LIMITS))
    again = load_verification(path)
    assert (again.made, again.serial_number) == (MADE, "40937")
    assert again.location_mm == pytest.approx(0.3)
    assert again.length_mm == pytest.approx(0.25)
    assert [test.where for test in again.locations] == ["near", "far"]
    assert tomllib.loads(path.read_text(encoding="utf-8"))["passed"] is True


def test_a_verification_without_lengths_is_read_too(tmp_path: Path) -> None:
    bare = Verification(MADE, "40937", VERIFICATION.locations)
    path = written(tmp_path, verification_text(bare, VerificationLimits(0.46)))
    assert load_verification(path).lengths == ()
    assert tomllib.loads(verification_text(bare, LIMITS))["passed"] is False


@pytest.mark.parametrize(
    ("change", "place", "message"),
    [
        (("passed = true", "passed = false"), "passed", "changed by hand"),
        (("location_mm = 0.3", "location_mm = 0.2"), "location_mm", "changed by hand"),
        (("length_mm = 0.25", "length_mm = 0.05"), "length_mm", "changed by hand"),
        (("largest_mm = 0.3", "largest_mm = 0.1"), "location[1].largest_mm", "changed by hand"),
        (("[200.3, 0.0, 20.0]", "[200.0, 0.0, 20.0]"), "location", "changed by hand"),
        (("error_mm = 0.25", "error_mm = 0.0"), "length[1].error_mm", "changed by hand"),
        (("mm = 300.0", "mm = 0.0"), "length[1].calibrated_mm", "greater than 0"),
        (('where = "far"', 'were = "far"'), "location[2].were", "unknown key"),
        (("[0.6, 0.0, 0.8], ", ""), "location[1].axes", "a row for each"),
    ],
)
def test_a_faulty_verification_file_is_refused_in_its_place(
    tmp_path: Path, change: tuple[str, str], place: str, message: str
) -> None:
    path = written(tmp_path, verification_text(VERIFICATION, LIMITS), change)
    refused(load_verification, path, place, message)


def test_what_cannot_be_written_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    with pytest.raises(ConfigError, match="Name another place"):
        write_file(tmp_path / "file" / "arm.toml", "x = 1\n")


plain = st.one_of(
    st.booleans(),
    st.integers(-(2**53), 2**53),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(max_size=30),
)
tables = st.dictionaries(
    st.from_regex(r"[a-z_]{1,8}", fullmatch=True),
    st.one_of(plain, st.lists(plain, max_size=30)),
    max_size=5,
)


@pytest.mark.slow
@given(tables, st.lists(tables, max_size=3), tables)
def test_toml_reads_what_was_written(
    top: dict[str, Any], rows: list[dict[str, Any]], inner: dict[str, Any]
) -> None:
    table = {**top, "INNER": inner, **({"ROWS": rows} if rows else {})}
    assert tomllib.loads(toml_text(table, "a heading\nof two lines")) == table
