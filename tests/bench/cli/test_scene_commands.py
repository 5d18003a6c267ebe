"""`teatbench scene …`: what is written, that it can be scored, and what is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.config import ConfigError, read_calibration, read_config
from bench.record.recording import Recording, RecordingError
from bench.rig.loading import load_rig
from bench.rig.model import EmulatedOptical, EmulatedThermal, Rig
from bench.rig.scenes import chosen, record_scenes, rig_renderer, warm
from instruments.world.situations import SITUATIONS, situation
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.commands import Said, teatbench, words

pytestmark = pytest.mark.slow


def test_a_recording_of_situations_can_be_read_and_has_exact_truth(
    tmp_path: Path, said: Said
) -> None:
    out, names = tmp_path / "situations", ("missing_or_hidden", "overlapping")
    rig = write_small_rig(tmp_path)
    seen = "scene record --situation overlapping --situation missing_or_hidden --seeds 2 --first 3"
    assert "4 frames in" in said(0, f"{seen} --rig {{}} --out {{}}", rig, out).out
    recording = Recording(out)
    assert recording.frames == tuple(f"{name}-000{seed}" for name in names for seed in (3, 4))
    renderer = rig_renderer(load_rig(rig), 1)
    for name in names:
        found = situation(name, 4)
        rows = recording.truth[f"{name}-0004"]
        ends_mm = np.array([row.xyz_mm for row in rows])
        assert ends_mm == pytest.approx(found.phantom.ends_mm, abs=1e-9)
        visible = renderer.visible_ends(warm(found)).all(axis=1)
        assert [row.visible for row in rows] == visible.tolist()
        assert {row.situation for row in rows} == {name}
    frames = recording.load("overlapping-0003")
    assert frames.left.shape == (256, 340)
    assert frames.thermal_ck is not None
    calibration = load_rig(rig).calibration_path.read_text(encoding="utf-8")
    assert calibration == (out / "calibration.toml").read_text(encoding="utf-8")


def test_a_frame_is_the_same_whatever_else_is_recorded(tmp_path: Path) -> None:
    rig = load_rig(write_small_rig(tmp_path))
    for folder, seeds in (("one", [5]), ("two", [4, 5])):
        list(record_scenes(rig, ["dim_light"], seeds, tmp_path / folder, seed=1))
    files = [
        sorted((tmp_path / folder / "frames" / "dim_light-0005").iterdir())
        for folder in ("one", "two")
    ]
    assert [one.read_bytes() for one in files[0]] == [two.read_bytes() for two in files[1]]
    with pytest.raises(RecordingError, match="there is such a frame already"):
        list(record_scenes(rig, ["dim_light"], [5], tmp_path / "one", seed=1))


def test_a_recording_is_perturbed_in_scene_pictures_and_calibration(
    tmp_path: Path, said: Said
) -> None:
    rig = write_small_rig(tmp_path)
    line = "scene record --situation ideal --seeds 1 --rig {} --out {}"
    said(0, line, rig, tmp_path / "plain")
    perturbed = words("--perturb teat-paint=0.9 --perturb exposure=0.5 --perturb column=2")
    said(0, f"{line} {{}}", rig, tmp_path / "other", perturbed)
    plain, other = (Recording(tmp_path / name) for name in ("plain", "other"))
    assert plain.truth == other.truth
    known, told = (read_calibration(one.calibration_path) for one in (plain, other))
    assert told.right.cc[0] == pytest.approx(known.right.cc[0] + 2.0)
    pictures = [one.load("ideal-0000").left.astype(float) for one in (plain, other)]
    end_px = known.project([row.xyz_mm for row in plain.truth["ideal-0000"]])[0]
    column, row = end_px[0].round().astype(int)
    teat = [picture[row + 10 : row + 20, column].mean() for picture in pictures]
    assert teat[1] > 2.0 * teat[0]  # 0.9 / 0.07 of half the light, if it isn't clipped
    assert pictures[1].max() <= 128
    refusal = said(2, f"{line} --perturb paint=1", rig, tmp_path / "none").err
    assert 'did you mean "teat-paint"?' in refusal
    assert not (tmp_path / "none").exists()


def test_a_place_that_cannot_be_written_is_reported(tmp_path: Path, said: Said) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    for command, why in (("record", "can't be written"), ("sheet", "there is no folder")):
        scene = f"scene {command} --situation ideal --seeds 1 --out {{}}"
        assert why in said(2, scene, tmp_path / "file" / "x").err
    refused = said(2, "scene sheet --out {}", tmp_path / "typo" / "sheet.png").err
    assert f"there is no folder {tmp_path / 'typo'}; name a file in a folder" in refused
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_all_families_are_chosen_by_naming_none() -> None:
    assert chosen([]) == tuple(SITUATIONS)
    assert chosen(["ideal", "ideal"]) == ("ideal",)
    with pytest.raises(ConfigError, match="known: ideal"):
        chosen(["x"])


def test_sensors_follow_the_rig_file(tmp_path: Path) -> None:
    rig = write_small_rig(tmp_path)
    text = rig.read_text(encoding="utf-8")
    optical = "\n[emulation.optical]\nread_noise_e = 9.0\naperture_mm = 3.0\n"
    thermal = "[emulation.thermal]\nsensor_size = [80, 60]\nnetd_k = 0.05\n"
    rig.write_text(f"{text}{optical}{thermal}flat_field_every_s = 60.0\n", encoding="utf-8")
    said = read_config(rig, Rig).emulation
    renderer = rig_renderer(load_rig(rig), 1)
    assert said.optical.sensor() == renderer.left.readout.sensor
    assert renderer.left.readout.sensor.read_noise_e == 9.0
    assert renderer.left.readout.sensor.focus.aperture_mm == 3.0
    found = renderer.thermal.readout.sensor
    assert (found.width_px, found.height_px) == (80, 60)
    assert (found.netd_k, found.drift.every_s) == (0.05, 60.0)
    assert EmulatedThermal().sensor({}).width_px == 160
    assert EmulatedOptical().sensor().full_well_e == 13000.0
    rig.write_text(text + "\n[emulation.thermal]\nnetd = 0.05\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"did you mean .netd_k"):
        read_config(rig, Rig)


def test_a_heated_board_of_circles_fits_the_thermal_view(tmp_path: Path) -> None:
    boards = "scene boards heated-circles-7x5-18 --warmer-k 14 --poses 1"
    assert (
        teatbench(f"{boards} --camera thermal --camera left --out {{}}", tmp_path / "boards") == 0
    )
    warmth = Recording(tmp_path / "boards").load("pose-00").thermal_ck
    assert warmth is not None
    spots, _ = cv2.connectedComponents((warmth > 29315 + 500).astype(np.uint8))
    assert spots - 1 == 35
