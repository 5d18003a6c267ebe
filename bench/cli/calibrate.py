"""`calibrate cameras|thermal|world|merge`: each step writes a file, and a page that says how good
it is.

`calibrate check`: an existing calibration against a board, or points that the arm touches, today.

`calibrate stage`: where the stage's axes lie in the world. Each calibration writes a dated file
with its quality figures.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from bench.cli.arguments import CODES, Commands, whole
from bench.cli.calibration_files import (
    add_files,
    add_out_file,
    add_rig_option,
    command_line,
    gather_views,
    gather_world,
    make_record,
    size,
    told,
    write_step,
)

if TYPE_CHECKING:
    from bench.calibrate.thermal import Delivered
    from bench.calibrate.views import BoardViews
    from bench.truth.registration import Registration
    from detector.calibration import Part
    from detector.calibration.diagnosis import Finding
    from detector.geometry import Array
    from reports.page import Page

Result = TypeVar("Result")

# of detector.calibration.cameras, which is heavy to import here
MODELS = ("k1", "k1 k2", "k1 k2 p1 p2", "k1 k2 p1 p2 k3")


def add_steps(group: Commands) -> None:
    """The steps' commands with their arguments."""
    _add_cameras(group)
    _add_thermal(group)
    _add_world(group)
    merge = group.add(
        "merge",
        "put the steps' files together into one calibration.toml",
        _merge,
        opens_links=False,
    )
    merge.add_argument(
        "parts", nargs="+", type=Path, metavar="PART", help="the files that the steps wrote"
    )
    add_out_file(merge, "calibration.toml")


def _add_cameras(group: Commands) -> None:
    cameras = group.add(
        "cameras",
        "the stereo pair from pictures of a board, or live from a rig's cameras",
        _cameras,
    )
    add_frames(cameras, live=True)
    add_rig_option(cameras)
    cameras.add_argument(
        "--model",
        choices=MODELS,
        default="k1 k2 p1 p2",
        help="distortion that is fitted (default: k1 k2 p1 p2)",
    )
    cameras.add_argument("--square-pixels", action="store_true", help="hold fx = fy")
    cameras.add_argument(
        "--identity",
        action="append",
        default=[],
        metavar="CAMERA=SERIAL",
        help="which camera it is, for the record",
    )
    add_out_file(cameras, "cameras.toml")


def _add_thermal(group: Commands) -> None:
    thermal = group.add(
        "thermal",
        "the thermal camera, from pictures of a heated board, live from a rig, or from point pairs",
        _thermal,
    )
    add_frames(thermal, live=True, board_required=False)
    add_rig_option(thermal)
    thermal.add_argument(
        "--cameras",
        type=Path,
        metavar="FILE",
        help="what 'calibrate cameras' wrote; needed with pictures",
    )
    thermal.add_argument(
        "--pairs",
        type=Path,
        metavar="CSV",
        help="point pairs instead of pictures: thermal_x,thermal_y,left_x,left_y,right_x,right_y",
    )
    thermal.add_argument(
        "--image-size",
        type=size,
        metavar="COLUMNSxROWS",
        help="of the delivered thermal picture; needed with --pairs",
    )
    thermal.add_argument(
        "--sensor-size",
        type=size,
        metavar="COLUMNSxROWS",
        help="default: 160x120, or as the rig's calibration says",
    )
    thermal.add_argument(
        "--mirrored",
        action="store_true",
        help="the camera delivers mirrored pictures, and these are",
    )
    thermal.add_argument(
        "--polarity",
        choices=("hot_is_black", "hot_is_white"),
        help="default: hot_is_white, or as the rig's says",
    )
    thermal.add_argument(
        "--model", choices=MODELS, default="k1", help="distortion that is fitted (default: k1)"
    )
    thermal.add_argument(
        "--plane",
        type=float,
        metavar="MM",
        help="distance of the plane that the homographies hold on (default: 1076.3)",
    )
    add_out_file(thermal, "thermal.toml")


def _add_world(group: Commands) -> None:
    world = group.add(
        "world", "camera to table, from points that the arm touched and both cameras saw", _world
    )
    world.add_argument(
        "points",
        nargs="?",
        type=Path,
        metavar="CSV",
        help="left_x,left_y,right_x,right_y,x_mm,y_mm,z_mm, a point a line",
    )
    add_rig_option(world)
    world.add_argument(
        "--board", metavar="BOARD", help="with --rig: a shipped board by name, or a .toml file"
    )
    world.add_argument(
        "--cameras", type=Path, required=True, metavar="FILE", help="what 'calibrate cameras' wrote"
    )
    world.add_argument(
        "--pixel-sd",
        type=float,
        default=0.1,
        metavar="PX",
        help="of a pixel coordinate (default: 0.1)",
    )
    world.add_argument(
        "--touch-sd",
        type=float,
        default=0.25,
        metavar="MM",
        help="of a touch, along each axis (default: 0.25)",
    )
    add_out_file(world, "world.toml")


def add_frames(
    parser: argparse.ArgumentParser, *, live: bool = False, board_required: bool = True
) -> None:
    """Pictures of a board, and how it is looked for in them."""
    parser.add_argument(
        "frames",
        nargs="*" if live else "+",
        type=Path,
        metavar="FRAMES",
        help="folders of pictures (docs/calibration.md)",
    )
    parser.add_argument(
        "--board",
        metavar="BOARD",
        required=board_required,
        help="a shipped board by name, or a .toml file",
    )
    parser.add_argument(
        "--max-views", type=int, metavar="N", help="take this many views, spread over the set"
    )
    parser.add_argument(
        "--window",
        type=int,
        metavar="PX",
        help="half of the corner window (default: as large as reaches no other corner)",
    )


def _cameras(given: argparse.Namespace) -> int:
    from bench.calibrate.arm import refuse_existing
    from bench.calibrate.capture import ViewsRequest
    from bench.calibrate.stereo import Lens, calibrate_pair
    from bench.report.calibration import cameras_page
    from detector.calibration.bundle import BundleError

    refuse_existing(given.out, replace=given.replace)
    one_source(given, given.frames, "folders of pictures (FRAMES)")
    identity = _identities(given.identity)
    if given.rig:
        gathered = gather_views(given, ViewsRequest())
        given.frames, identity = [gathered.folder], {**gathered.identity, **identity}
    views, paths = views_of(given, "left", "right")
    result = _sentence(
        lambda: calibrate_pair(views, Lens(given.model, given.square_pixels)), BundleError
    )
    record = make_record(given, paths, identity)
    write_step(given, result.part(record), cameras_page(result, record, command_line()))
    for camera, coverage in result.coverage.items():
        for text in coverage.missing:
            print(f"still missing, {camera}: {text}")
    print(
        f"misses {result.joint.fit.rms_px:.3f} px rms; good to"
        f" {float(result.good_to_mm(_metres(1.2))[0]):.2f} mm at 1.2 m (k = 2)"
    )
    return told(result.findings)


def _thermal(given: argparse.Namespace) -> int:
    from bench.calibrate.arm import refuse_existing
    from bench.calibrate.capture import ViewsRequest
    from bench.calibrate.merge import CAMERAS_INPUT, read_part
    from bench.calibrate.thermal import calibrate_thermal, map_pairs
    from bench.config import ConfigError
    from bench.report.calibration import pairs_page, thermal_page
    from detector.calibration import DEFAULT_PLANE_DEPTH_MM
    from detector.calibration.bundle import BundleError

    refuse_existing(given.out, replace=given.replace)
    delivered = _delivered(given)
    if given.pairs is not None:
        if given.image_size is None:
            raise ConfigError.plain(
                "--pairs needs --image-size COLUMNSxROWS: how large the thermal picture is whose"
                " pixels the pairs name"
            )
        mapped = map_pairs(given.pairs)
        record = make_record(given, (given.pairs,), {})
        write_step(
            given,
            mapped.part(given.image_size, delivered, record),
            pairs_page(mapped, record, command_line()),
        )
        return CODES.met
    if not (given.frames or given.rig) or not given.board or not given.cameras:
        raise ConfigError.plain(
            "give folders of pictures or --rig with --board and --cameras, or a table with --pairs"
        )
    one_source(given, given.frames, "folders of pictures (FRAMES)")
    cameras, identity = read_part(given.cameras), {}
    if given.rig:
        mirrored = frozenset({"thermal"} if delivered.mirrored else ())
        gathered = gather_views(
            given,
            ViewsRequest(("left", "thermal"), ("thermal",), heated=True, mirrored=mirrored),
            cameras.part,
        )
        given.frames, identity = [gathered.folder], gathered.identity
    views, paths = views_of(given, "left", "thermal", mirrored=delivered.mirrored)
    plane = DEFAULT_PLANE_DEPTH_MM if given.plane is None else given.plane
    result = _sentence(
        lambda: calibrate_thermal(views, cameras.part, delivered, plane), BundleError
    )
    record = make_record(given, paths, identity, {CAMERAS_INPUT: cameras.sha256})
    write_step(given, result.part(record), thermal_page(result, record, command_line()))
    return CODES.met


def _world(given: argparse.Namespace) -> int:
    from bench.calibrate.arm import refuse_existing
    from bench.calibrate.merge import CAMERAS_INPUT, read_part
    from bench.calibrate.touch_board import POINTS_FILE
    from bench.calibrate.world import calibrate_world, read_points
    from bench.config import ConfigError
    from bench.report.calibration import world_page

    refuse_existing(given.out, replace=given.replace)
    one_source(given, given.points, "a table of points (CSV)")
    cameras = read_part(given.cameras)
    if given.rig:
        if not given.board:
            raise ConfigError.plain(
                "--rig needs --board: what both cameras see and the arm touches"
            )
        given.points = gather_world(given, cameras.part).folder / POINTS_FILE
    result = calibrate_world(
        read_points(given.points),
        cameras.part,
        pixel_sd_px=given.pixel_sd,
        touch_sd_mm=given.touch_sd,
    )
    record = make_record(given, (given.points,), {}, {CAMERAS_INPUT: cameras.sha256})
    write_step(given, result.part(record), world_page(result, record, command_line()))
    return told(result.findings)


def _merge(given: argparse.Namespace) -> int:
    from bench.calibrate.arm import refuse_existing
    from bench.calibrate.merge import merge, read_part

    refuse_existing(given.out, replace=given.replace)
    write_step(
        given, merge([read_part(path) for path in given.parts], make_record(given, (), {})), None
    )
    return CODES.met


def one_source(given: argparse.Namespace, files: object, what: str) -> None:
    """Raises ConfigError where neither files nor a rig are named, or both."""
    from bench.config import ConfigError

    if bool(files) == bool(given.rig):
        raise ConfigError.plain(
            f"give either {what} or --rig RIG{', not both' if given.rig else ''}"
        )


def _delivered(given: argparse.Namespace) -> Delivered:
    """How the thermal pictures come: as told, as the rig's
    calibration has it, or as its file says.
    """
    from bench.calibrate.thermal import Delivered
    from bench.rig.loading import find_rig, load_rig

    if not given.rig:
        return Delivered(
            given.sensor_size or (160, 120),
            given.mirrored,
            given.polarity or "hot_is_white",
            given.model,
        )
    rig = load_rig(find_rig(given.rig))
    known, table = rig.made_calibration, rig.rig.cameras.thermal
    if known is not None:
        size, mirrored, polarity = (
            known.thermal.sensor_size,
            known.thermal.mirrored,
            known.thermal.polarity,
        )
    else:
        size, mirrored = (160, 120), bool(table and table.mirrored)
        polarity = (table and table.polarity) or "hot_is_white"
    return Delivered(
        given.sensor_size or size,
        given.mirrored or mirrored,
        given.polarity or polarity,
        given.model,
    )


def views_of(
    given: argparse.Namespace, *cameras: str, mirrored: bool = False
) -> tuple[BoardViews, tuple[Path, ...]]:
    """The board in the pictures of these cameras, and the files they were."""
    from bench.calibrate.views import find_pictures, find_views
    from bench.rig.board import find_board_file, load_board

    board_file = find_board_file(given.board)
    pictures = find_pictures(given.frames).only(*cameras)
    turned = frozenset({"thermal"} if mirrored else ())
    board = load_board(board_file).board
    views = find_views(
        pictures, board, print, window_px=given.window, max_views=given.max_views, mirrored=turned
    )
    return views, (board_file, *pictures.paths)


def _sentence(job: Callable[[], Result], error: type[Exception]) -> Result:
    """What a job gives; its error as the command's own."""
    from bench.config import ConfigError

    try:
        return job()
    except error as why:
        raise ConfigError.plain(str(why)) from why


def _identities(given: list[str]) -> dict[str, str]:
    from bench.config import ConfigError

    found = dict(text.partition("=")[::2] for text in given)
    for camera, serial in found.items():
        if camera not in ("left", "right", "thermal") or not serial:
            raise ConfigError.plain(
                f"--identity {camera}={serial}: say left=SERIAL, right=SERIAL or thermal=SERIAL"
            )
    return found


def _metres(*distances_m: float) -> Array:
    import numpy as np

    return 1000.0 * np.array(distances_m)


VIEWS = 5


def add_check(group: Commands) -> None:
    """The command with its arguments."""
    what = (
        "measure a board or touched points again with an existing calibration: does it still hold?"
    )
    check = group.add("check", what, _check)
    check.add_argument(
        "calibration",
        type=Path,
        metavar="CAL",
        help="the calibration, or the cameras' file where a board is shown",
    )
    add_frames(check, live=True, board_required=False)
    add_rig_option(check)
    check.add_argument(
        "--points",
        type=Path,
        metavar="CSV",
        help="touched points in the place of a board, as for 'calibrate world'",
    )
    check.add_argument(
        "--pixel-sd",
        type=float,
        default=0.1,
        metavar="PX",
        help="of a pixel coordinate of a point (default: 0.1)",
    )
    check.add_argument(
        "--touch-sd",
        type=float,
        default=0.25,
        metavar="MM",
        help="of a touch, along each axis (default: 0.25)",
    )
    check.add_argument(
        "--page", type=Path, metavar="DIR", help="where the page goes (default: none is written)"
    )


def _check(given: argparse.Namespace) -> int:
    from bench.calibrate.merge import read_part

    part = read_part(given.calibration).part
    # whose pictures are kept beside the calibration that they check
    given.by, given.out = "", given.calibration
    return _points(given, part) if given.points else _board(given, part)


def _board(given: argparse.Namespace, part: Part) -> int:
    from bench.calibrate.capture import ViewsRequest
    from bench.calibrate.check import check_pair
    from bench.config import ConfigError
    from bench.report.calibration import check_page

    one_source(
        given, given.frames, "folders of pictures (FRAMES), or touched points (--points CSV),"
    )
    if not given.board:
        raise ConfigError.plain("--board is needed: what is in the pictures")
    if given.rig:
        given.frames = [gather_views(given, ViewsRequest(guided=(), most=VIEWS), part).folder]
    views, paths = views_of(given, "left", "right")
    again, findings = check_pair(part, views)
    scale, sd = again.scale
    print(
        f"{len(again.views)} views: lengths {scale:.5f} ± {sd:.5f} of the print, rows"
        f" {again.epipolar_rms_px:.2f} px rms"
    )
    return _said(
        given, findings, check_page(again, findings, make_record(given, paths, {}), command_line())
    )


def _points(given: argparse.Namespace, part: Part) -> int:
    import numpy as np

    from bench.calibrate.check import check_points
    from bench.calibrate.world import read_points
    from bench.config import ConfigError
    from bench.report.calibration import check_points_page

    if given.frames or given.rig:
        raise ConfigError.plain("--points is in the place of pictures and --rig: give one of them")
    again, findings = check_points(
        part, read_points(given.points), pixel_sd_px=given.pixel_sd, touch_sd_mm=given.touch_sd
    )
    rms = float(np.sqrt(np.mean(np.sum(again.missed_mm**2, axis=1))))
    print(
        f"{len(again.missed_mm)} points: missed by {rms:.2f} mm rms,"
        f" {np.sqrt(np.mean(again.expected_mm**2)):.2f} mm is to be expected"
    )
    return _said(
        given,
        findings,
        check_points_page(again, findings, make_record(given, (given.points,), {}), command_line()),
    )


def _said(given: argparse.Namespace, findings: Sequence[Finding], page: Page) -> int:
    from reports.render import write_report

    if given.page:
        print(f"page: {write_report(page, given.page)}")
    print("It still holds." if not findings else "It no longer holds.")
    return told(findings)


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    group = commands.group("calibrate", "make a calibration file with its quality figures")
    add_steps(group)
    add_check(group)
    add_files(group)
    stage = group.add(
        "stage",
        "register the stage in the world: one teat end touched at several stage positions"
        " (docs/truth.md)",
        _stage,
    )
    stage.add_argument(
        "--rig", metavar="RIG", help="a shipped rig by name, or a .toml file (default: emulated)"
    )
    stage.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="FILE",
        help="where to write it; a script's [truth] names it",
    )
    stage.add_argument("--replace", action="store_true", help="write over a file that is there")
    stage.add_argument(
        "--layout",
        default="table-5-1",
        metavar="NAME",
        help="how the phantom's teats stand (default: table-5-1)",
    )
    stage.add_argument(
        "--teat", type=whole(1, 20), default=1, metavar="N", help="the teat to touch (default: 1)"
    )
    stage.add_argument(
        "--readings",
        type=whole(1, 20),
        metavar="N",
        help="touches at each position (default: as the rig says)",
    )
    stage.add_argument(
        "--seed", type=int, metavar="N", help="of the emulators' noise (default: the rig's)"
    )
    stage.add_argument(
        "--at",
        type=_place,
        action="append",
        default=[],
        metavar="X,Y",
        help=(
            "touch there, mm from the reference place (--at=-60,80); three or more (default: the"
            " corners and the middle of 200 x 200 mm)"
        ),
    )


def _stage(given: argparse.Namespace) -> int:
    from bench.calibrate.arm import refuse_existing
    from bench.calibrate.stage import RegistrationRequest, calibrate_stage
    from bench.rig.loading import find_rig, load_rig
    from bench.truth.registration_file import write_registration
    from instruments.clock import wall_time
    from instruments.operators.operator import OperatorAbort, OperatorSkip

    refuse_existing(given.out, replace=given.replace)
    rig = load_rig(find_rig(given.rig))
    wanted = RegistrationRequest(given.layout, given.teat, tuple(given.at), given.readings)
    seed = rig.rig.seed if given.seed is None else given.seed
    made = wall_time().replace(microsecond=0)
    try:
        found = calibrate_stage(
            rig,
            wanted,
            made,
            lambda text: print(text, flush=True),
            seed=seed,
            capture=given.capture,
        )
    except (OperatorAbort, OperatorSkip) as stop:
        print(f"teatbench: {stop}; nothing was written", file=sys.stderr)
        return CODES.fault
    write_registration(given.out, found)
    _show(found)
    print(
        f'Written: {given.out}. Name it in a script, beside which it lies: [truth] mode = "carry",'
        f' registration = "{given.out.name}"'
    )
    for fault in found.faults:
        print(f"teatbench: {fault}", file=sys.stderr)
    return CODES.not_met if found.faults else CODES.met


def _show(found: Registration) -> None:
    print(f"{len(found.stations)} positions, touches good for {found.u_mm:.2f} mm along an axis")
    for fit in found.comparison.fits:
        held_out = found.comparison.held_out_mm[fit.model]
        left_out = (
            "too few positions to hold one out"
            if held_out is None
            else f"held out {held_out:.2f} mm"
        )
        print(f"{fit.model}: residual {fit.fre_mm:.2f} mm rms, {left_out}")
    print(f"expected residual of the rigid fit: {found.expected_fre_mm:.2f} mm")
    for one in found.diagnostics:
        print(
            f"{one.name}: {one.value:+.5f} (u"
            f" {one.u:.5f}){', SIGNIFICANT' if one.significant else ''}"
        )


def _place(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a place; write two numbers as 120,-80"
        ) from error
    if not all(abs(v) <= 2000 for v in (x, y)):
        raise argparse.ArgumentTypeError(f"{text!r} is not within 2 m of the reference place")
    return x, y
