"""The thermal camera as a third one: a heated board, mirrored and inverted."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from detector.calibration import Part, Record, dump_calibration, load_part
from tests.bench.calibrate.board_pictures import (
    HEATED,
    HEATED_TOML,
    LEFT,
    RIGHT,
    RIGHT_FROM_LEFT,
    THERMAL,
    THERMAL_FROM_LEFT,
    picture,
    poses,
    write_image,
)
from tests.bench.calibrate.touched import placed, there, within
from tests.bench.commands import Said

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    (folder / "heated.toml").write_text(HEATED_TOML, encoding="utf-8")
    pair = Part(
        left=LEFT,
        right=RIGHT,
        right_from_left=RIGHT_FROM_LEFT,
        record=Record("2026-11-20", "", "test", {}, {}),
    )
    (folder / "cameras.toml").write_text(dump_calibration(pair), encoding="utf-8")
    for number, pose in enumerate(poses(10, 3, HEATED, 0.3)):
        show = partial(picture, board=HEATED, pitch_mm=HEATED.pitch_mm)
        seen = 255 - show(THERMAL, THERMAL_FROM_LEFT @ pose, 50 + number)
        pictures = {"left": show(LEFT, pose, number), "thermal": seen[:, ::-1].copy()}
        for camera, image in pictures.items():
            write_image(folder / "day" / camera / f"{number:02d}.png", image)
    return folder


CALIBRATE = "calibrate thermal day --board heated.toml --cameras {} --out {}"


def test_lens_and_pose_come_out_as_they_were_put_in(lab: Path, in_lab: Said) -> None:
    in_lab(0, f"{CALIBRATE} --mirrored --plane 900", "cameras.toml", "thermal.toml")
    part = load_part(lab / "thermal.toml")
    thermal = there(part.thermal)
    assert thermal.mirrored
    off = np.subtract(there(thermal.lens).fc, THERMAL.fc)
    assert within(part, "thermal", {"fx": off[0], "fy": off[1]})
    assert placed(part, "thermal pose", there(part.thermal_from_left), THERMAL_FROM_LEFT)
    page = (lab / "thermal.page" / "index.html").read_text(encoding="utf-8")
    assert "10 views of a heated" in page
    assert "Derived at a plane 900 mm" in page


def test_without_the_pair_it_is_refused(lab: Path, in_lab: Said) -> None:
    empty = Part(record=Record("2026-11-20", "", "test", {}, {}))
    (lab / "empty.toml").write_text(dump_calibration(empty), encoding="utf-8")
    why = in_lab(2, CALIBRATE, "empty.toml", "t.toml").err
    assert "holds no stereo pair ([cameras.left], [cameras.right], [stereo])" in why


def test_pictures_that_come_mirrored_without_a_word_of_it_are_refused(
    lab: Path, in_lab: Said
) -> None:
    """They fit a lens that looks away."""
    why = in_lab(2, f"{CALIBRATE} --max-views 6", "cameras.toml", "unsaid.toml").err
    assert not (lab / "unsaid.toml").exists()
    assert "do its pictures come mirrored (--mirrored)" in why
