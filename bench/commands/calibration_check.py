"""`calibrate check`: an existing calibration against a board, or points that the arm touches, today."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands import Commands
from bench.commands.calibrating import add_frames, one_source, views_of
from bench.commands.calibration_files import command_line, make_record, told
from bench.commands.live_calibration import add_rig_option, gather_views

if TYPE_CHECKING:
    from detector.calibration import Part
    from detector.calibration.diagnosis import Finding
    from reports.page import Page

VIEWS = 5


def add_check(group: Commands) -> None:
    """The command with its arguments."""
    what = "measure a board or touched points again with an existing calibration: does it still hold?"
    check = group.add("check", what, _check)
    check.add_argument("calibration", type=Path, metavar="CAL", help="the calibration, or the cameras' file where a board is shown")
    add_frames(check, live=True, board_required=False)
    add_rig_option(check)
    check.add_argument("--points", type=Path, metavar="CSV", help="touched points in the place of a board, as for 'calibrate world'")
    check.add_argument("--pixel-sd", type=float, default=0.1, metavar="PX", help="of a pixel coordinate of a point (default: 0.1)")
    check.add_argument("--touch-sd", type=float, default=0.25, metavar="MM", help="of a touch, along each axis (default: 0.25)")
    check.add_argument("--page", type=Path, metavar="DIR", help="where the page goes (default: none is written)")


def _check(given: argparse.Namespace) -> int:
    from bench.calibrating.merging import read_part

    part = read_part(given.calibration).part
    given.by, given.out = "", given.calibration  # whose pictures are kept beside the calibration that they check
    return _points(given, part) if given.points else _board(given, part)


def _board(given: argparse.Namespace, part: Part) -> int:
    from bench.calibrating.checkup import check_pair
    from bench.calibrating.live import Wanted
    from bench.config import ConfigError
    from bench.summary.calibration_checks import check_page

    one_source(given, given.frames, "folders of pictures (FRAMES), or touched points (--points CSV),")
    if not given.board:
        raise ConfigError.plain("--board is needed: what is in the pictures")
    if given.rig:
        given.frames = [gather_views(given, Wanted(guided=(), most=VIEWS), part).folder]
    views, paths = views_of(given, "left", "right")
    again, findings = check_pair(part, views)
    scale, sd = again.scale
    print(f"{len(again.views)} views: lengths {scale:.5f} ± {sd:.5f} of the print, rows {again.epipolar_rms_px:.2f} px rms")
    return _said(given, findings, check_page(again, findings, make_record(given, paths, {}), command_line()))


def _points(given: argparse.Namespace, part: Part) -> int:
    import numpy as np

    from bench.calibrating.checkup import check_points
    from bench.calibrating.world_job import read_points
    from bench.config import ConfigError
    from bench.summary.calibration_checks import check_points_page

    if given.frames or given.rig:
        raise ConfigError.plain("--points is in the place of pictures and --rig: give one of them")
    again, findings = check_points(part, read_points(given.points), pixel_sd_px=given.pixel_sd, touch_sd_mm=given.touch_sd)
    rms = float(np.sqrt(np.mean(np.sum(again.missed_mm**2, axis=1))))
    print(f"{len(again.missed_mm)} points: missed by {rms:.2f} mm rms, {np.sqrt(np.mean(again.expected_mm**2)):.2f} mm is to be expected")
    return _said(given, findings, check_points_page(again, findings, make_record(given, (given.points,), {}), command_line()))


def _said(given: argparse.Namespace, findings: Sequence[Finding], page: Page) -> int:
    from reports.render import write_report

    if given.page:
        print(f"page: {write_report(page, given.page)}")
    print("It still holds." if not findings else "It no longer holds.")
    return told(findings)
