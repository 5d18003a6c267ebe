"""`calibrate cameras|thermal|world|merge`: each step writes a dated file with its quality figures,
and a page that says how good it is; from files, or live with ``--rig``.

`calibrate check`: an existing calibration against a board, or points that the arm touches, today;
`calibrate stage`: where the stage's axes lie in the world; `calibrate board|export|import`.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

import bench
from bench.calibrate import exchange
from bench.calibrate.cameras import (
    LEAST_LOOKED_AT,
    ThermalFormat,
    calibrate_pair,
    calibrate_thermal,
    check_pair,
    held,
    map_pairs,
)
from bench.calibrate.merge import CAMERAS_INPUT, read_part
from bench.calibrate.merge import merge as merged
from bench.calibrate.stage import calibrate_stage
from bench.calibrate.views import (
    CAMERAS,
    BoardViews,
    ViewsRequest,
    find_pictures,
    find_views,
    free_folder,
    gather,
)
from bench.calibrate.world import (
    POINTS_FILE,
    TouchSession,
    calibrate_world,
    check_points,
    gather_points,
    read_points,
)
from bench.cli.arguments import CODES, code_of, command_line, complain, refuse_existing
from bench.cli.terminal import working
from bench.config import ConfigError, read_calibration
from bench.files import write_synced
from bench.rig.alone import TakePictures, pictures, with_retries
from bench.rig.loading import find_board
from bench.script.calibration_age import refuse_other_cameras
from bench.version import __version__
from detector.calibration import (
    DEFAULT_PLANE_DEPTH_MM,
    Calibration,
    CalibrationError,
    Part,
    Record,
    check_text,
    dump_calibration,
    file_hash,
)
from detector.calibration.bundle import BundleError
from detector.calibration.gate import pair_faults
from instruments.clock import wall_time
from instruments.operators.operator import Finish
from instruments.world.boards import NoPlaceError

if TYPE_CHECKING:
    from detector.calibration.boards import Board
    from detector.calibration.diagnosis import Finding
    from instruments.camera.frame import FrameSet, Grey
    from reports.page import Page

CHECK_VIEWS = 5
SHOWN = 3  # pictures that are left out
say = partial(print, flush=True)  # for the person at the rig
STEREO = ViewsRequest()
FOLDERS = "folders of pictures (FRAMES)"


# The steps


def cameras(given: argparse.Namespace) -> int:
    from bench.report.calibration import cameras_page, cameras_sentence

    _one_source(given, given.frames, FOLDERS)
    named = dict(text.partition("=")[::2] for text in given.identity)
    for camera, serial in named.items():
        if camera not in CAMERAS or not serial:
            raise ConfigError.plain(
                f"--identity {camera}={serial}: say left=SERIAL, right=SERIAL or thermal=SERIAL"
            )
    views, paths, identity = _views_of(given)
    with _fitting("the cameras"):
        result = calibrate_pair(views, model=given.model, square_pixels=given.square_pixels)
    at_mm, record = given.distance, _record(given, paths, identity | named)
    _write_step(given, result.part(record), cameras_page(result, record, command_line(), at_mm))
    for camera, coverage in result.coverage.items():
        if coverage.missing:
            print(f"still missing, {camera}: {'; '.join(coverage.missing)}")
    for text in result.not_shown(at_mm):
        print(f"still missing: {text}")
    print(*result.text(), sep="\n")
    good_mm = float(result.good_to_mm(np.array([at_mm]))[0])
    print(f"a point at {at_mm / 1000:g} m: good to {good_mm:.2f} mm (k = 2)")
    verdict = "not met" if result.findings else held(good_mm)
    print(f"Verdict: {verdict}. {cameras_sentence(result, at_mm)}")
    return _say(result.findings, on_page=True) or code_of(verdict)


def thermal(given: argparse.Namespace) -> None:
    from bench.report.calibration import pairs_page, thermal_page

    delivered = _delivered(given)
    if given.pairs is not None:
        if given.image_size is None:
            raise ConfigError.plain(
                "--pairs needs --image-size COLUMNSxROWS: how large the thermal picture is whose"
                " pixels the pairs name"
            )
        mapped = map_pairs(given.pairs)
        record = _record(given, (given.pairs,))
        part = mapped.part(given.image_size, delivered, record)
        _write_step(given, part, pairs_page(mapped, record, command_line()))
        return
    if not (given.frames or given.rig) or not given.board or not given.cameras:
        raise ConfigError.plain(
            "give folders of pictures or --rig with --board and --cameras, or a table with --pairs"
        )
    pair, mirrored = read_part(given.cameras), frozenset({"thermal"} if delivered.mirrored else ())
    how = ViewsRequest(("left", "thermal"), guided=("thermal",), heated=True, mirrored=mirrored)
    views, paths, identity = _views_of(given, pair.part, how)
    with _fitting("the thermal camera"):
        plane_mm = given.plane or DEFAULT_PLANE_DEPTH_MM
        result = calibrate_thermal(views, pair.part, delivered, plane_mm)
    record = _record(given, paths, identity, {CAMERAS_INPUT: pair.sha256})
    _write_step(given, result.part(record), thermal_page(result, record, command_line()))
    of_views = [*result.joint.view_rms_px("thermal").values()]
    rms = float(np.sqrt(np.mean(np.square(of_views))))
    print(f"thermal camera: {rms:.3f} px rms over {len(of_views)} views")


def _delivered(given: argparse.Namespace) -> ThermalFormat:
    """How thermal pictures come, by command, by the rig's calibration or by its file."""
    size, mirrored, polarity = (160, 120), False, None
    if given.rig:
        rig = bench.load_rig(given.rig)
        known, table = rig.made_calibration, rig.rig.cameras.thermal
        if known is not None:
            thermal = known.thermal
            size, mirrored, polarity = thermal.sensor_size, thermal.mirrored, thermal.polarity
        elif table is not None:
            mirrored, polarity = bool(table.mirrored), table.polarity
    return ThermalFormat(
        given.sensor_size or size,
        given.mirrored or mirrored,
        given.polarity or polarity or "hot_is_white",
        given.model,
    )


def world(given: argparse.Namespace) -> int:
    from bench.report.calibration import world_page

    _one_source(given, given.points, "a table of points (CSV)")
    pair = read_part(given.cameras)
    if given.rig:
        if not given.board:
            raise ConfigError.plain(
                "--rig needs --board: what both cameras see and the arm touches"
            )
        # A table of points of the board that the rig's arm touched and its cameras saw
        board, _ = find_board(given.board)
        folder = free_folder(given.out)
        with _opened(given, pair.part, arm=True) as (rig, look):
            try:
                rig.home()
                radius_mm = rig.loaded.rig.arm.tip_radius_mm
                asking = TouchSession(look, rig.operator, rig.tip, radius_mm, say)
                gather_points(asking, board, folder)
                rig.operator.ask(Finish())
            finally:
                rig.arm.safe()
        given.points = folder / POINTS_FILE
    result = calibrate_world(
        read_points(given.points), pair.part, pixel_sd_px=given.pixel_sd, touch_sd_mm=given.touch_sd
    )
    record = _record(given, (given.points,), more={CAMERAS_INPUT: pair.sha256})
    _write_step(given, result.part(record), world_page(result, record, command_line()))
    fit = result.fit
    print(
        f"{len(fit.touched_mm)} points: missed by {fit.comparison.rigid.fre_mm:.3f} mm rms, lengths"
        f" {fit.scale:.5f} ± {fit.scale_sd:.5f} of the arm's"
    )
    return _say(result.findings)


def merge(given: argparse.Namespace) -> None:
    whole = merged([read_part(path) for path in given.parts], _record(given, ()))
    _write_step(given, whole, None)


def check(given: argparse.Namespace) -> int:
    part = read_part(given.calibration).part
    # whose pictures are kept beside the calibration that they check
    given.by, given.out = "", given.calibration
    if given.ends:
        return _check_ends(given, part)
    findings, page, looked_at = (_check_points if given.points else _check_board)(given, part)
    _write_page(given, page, given.page)
    if not findings and looked_at < LEAST_LOOKED_AT:
        what = "points" if given.points else "views of the board"
        text = f"{looked_at} {what} tell nothing, at least {LEAST_LOOKED_AT} are needed"
        return complain(f"not checked: {text}", CODES.inconclusive)
    print("It still holds." if not findings else "It no longer holds.")
    return _say(findings)


def _check_board(given: argparse.Namespace, part: Part) -> tuple[Sequence[Finding], Page, int]:
    """Findings, their page, and how many views were looked at."""
    from bench.report.calibration import check_page

    others = ", touched points (--points CSV), touched ends (--ends DIR),"
    views, paths, _ = _views_of(given, part, ViewsRequest(guided=(), most=CHECK_VIEWS), others)
    again, findings = check_pair(part, views)
    scale, sd = again.scale
    print(
        f"{len(again.views)} views: lengths {scale:.5f} ± {sd:.5f} of the print, rows"
        f" {again.epipolar_rms_px:.2f} px rms"
    )
    page = check_page(again, findings, _record(given, paths), command_line())
    return findings, page, len(again.views)


def _check_points(given: argparse.Namespace, part: Part) -> tuple[Sequence[Finding], Page, int]:
    """As `_check_board`, of points."""
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
    record = _record(given, (given.points,))
    page = check_points_page(again, findings, record, command_line())
    return findings, page, len(again.missed_mm)


def _check_ends(given: argparse.Namespace, part: Part) -> int:
    """Whether the cameras show touched teat ends where the calibration says."""
    from bench.report.calibration import check_ends_page
    from bench.results.cameras_agree import DEFAULT, check_folder, decide_cameras
    from bench.scoring.decisions import Verdict

    if given.frames or given.points or given.board:
        raise ConfigError.plain("--ends is in the place of pictures, --points and --board")
    calibration = read_calibration(given.calibration)
    anew: list[FrameSet] = []
    if given.rig:
        say(f"The phantom has to stand as in the last trial of {given.ends}.")
        with _opened(given, part, arm=False) as (rig, _):
            for _ in range(CHECK_VIEWS):
                rig.clock.sleep(rig.loaded.rig.cameras.settle_s)
                anew.append(with_retries(rig.cameras.capture)())
    with working("looking for the ends in the pictures"):
        found = check_folder(given.ends, calibration, anew)
    if anew and not found.thermal:
        print("no end in the thermal picture: it is not checked while the phantom is cold")
        found = replace(found, thermal=None)
    decision = decide_cameras(DEFAULT, found)
    print(f"{found.measured} of {found.ends} ends measured")
    for one in found.offsets:
        print(f"{one.text}, over {one.poses} {'ends' if anew else 'poses'}")
    page = check_ends_page(found, decision, _record(given, ()), command_line())
    _write_page(given, page, given.page)
    if decision.verdict is Verdict.MET:
        print("It still holds.")
        return CODES.met
    if decision.verdict is Verdict.NOT_MET:
        print("It no longer holds.")
        return complain(decision.sentence, CODES.not_met)
    return complain(f"not decided: {decision.sentence}", CODES.inconclusive)


def _one_source(given: argparse.Namespace, files: object, what: str) -> None:
    """Raises ConfigError where neither files nor a rig are named, or both."""
    if bool(files) == bool(given.rig):
        raise ConfigError.plain(
            f"give either {what} or --rig RIG{', not both' if given.rig else ''}"
        )


def _views_of(
    given: argparse.Namespace,
    known: Part | None = None,
    request: ViewsRequest = STEREO,
    others: str = "",
) -> tuple[BoardViews, tuple[Path, ...], dict[str, str]]:
    """The board as the cameras of ``request`` see it, in the pictures named or taken live; the
    files that this came from; and of a rig the cameras' identities. Raises ConfigError,
    InstrumentError, OperatorAbort.
    """
    _one_source(given, given.frames, FOLDERS + others)
    board, files = find_board(given.board)
    identity = _gather_views(given, board, known, request) if given.rig else {}
    found = find_pictures(given.frames, request.cameras)
    alone = sorted(
        f"{camera} {view}: no picture of the {other} camera"
        for camera, other in permutations(request.cameras, 2)
        for view in found[camera].keys() - found[other].keys()
    )
    _print_some("without its partner", alone)
    with working("finding the board in the pictures") as report:
        views = find_views(
            found,
            board,
            report=report,
            window_px=given.window,
            max_views=given.max_views,
            mirrored=request.mirrored,
        )
    _print_some("left out", [f"{one.camera} {one.view}: {one.reason}" for one in views.refused])
    paths = (*files, *(path for views_of in found.values() for path in views_of.values()))
    return views, paths, identity


def _print_some(what: str, lines: Sequence[str]) -> None:
    for text in lines[:SHOWN]:
        print(f"{what}: {text}")
    if (more := len(lines) - SHOWN) > 0:
        print(f"{what}: {more} more")


@contextmanager
def _fitting(what: str) -> Iterator[None]:
    """Raises ConfigError for views that can't be fitted."""
    try:
        with working(f"fitting {what}"):
            yield
    except BundleError as why:
        raise ConfigError.plain(str(why)) from why
    except (np.linalg.LinAlgError, cv2.error) as why:
        text = f"the views of {what} can't be fitted together ({why}): look whether each picture"
        raise ConfigError.plain(f"{text} shows the board, and each pair one pose") from why


def _record(
    given: argparse.Namespace,
    inputs: Sequence[Path],
    cameras: Mapping[str, str] | None = None,
    more: Mapping[str, str] | None = None,
) -> Record:
    """Who, today, with this program, from these files by name."""
    names = [path.name for path in inputs]
    hashes = {
        f"{path.parent.name}/{path.name}" if names.count(path.name) > 1 else path.name: file_hash(
            path
        )
        for path in inputs
    }
    today, program = wall_time().date().isoformat(), f"teatbench {__version__}"
    return Record(today, given.by, program, cameras or {}, {**hashes, **(more or {})})


def _write_step(given: argparse.Namespace, found: Part | Calibration, page: Page | None) -> None:
    """The step's file, whole or not at all, and its page beside it."""
    given.out.resolve().parent.mkdir(parents=True, exist_ok=True)
    text = dump_calibration(found, command_line())
    try:
        check_text(given.out, text, whole=isinstance(found, Calibration))
    except CalibrationError as error:
        raise ConfigError.plain(f"not written, for it can't be: {error}") from error
    write_synced(given.out, text.encode("utf-8"))
    print(f"written: {given.out}")
    if page is not None:
        _write_page(given, page, given.out.with_suffix(".page"))


def _write_page(given: argparse.Namespace, page: Page, folder: Path | None) -> None:
    """Write it, where it is wanted; of a rig with what its instruments are."""
    if folder:
        from bench.report.calibration import with_kind
        from reports.render import write_report

        if rig := getattr(given, "rig", None):
            used = {"cameras", "arm"} if given.called == "calibrate world" else {"cameras"}
            page = with_kind(page, used, bench.load_rig(rig).rig.emulated)
        print(f"page: {write_report(page, folder)}")


def _say(findings: Sequence[Finding], *, on_page: bool = False) -> int:
    """Print the findings, with ``on_page`` one of each kind; gives back the exit code."""
    kinds = Counter(finding.name for finding in findings)
    said: set[str] = set()
    for finding in findings:
        if on_page and finding.name in said:
            continue
        said.add(finding.name)
        more = kinds[finding.name] - 1 if on_page else 0
        others = f" ({more} more of this kind on the page)" if more else ""
        complain(f"{finding.name}: {finding.sentence}{others}", CODES.not_met)
    return CODES.not_met if findings else CODES.met


# Live: the rig's cameras opened, the operator led, the pictures kept


def _gather_views(
    given: argparse.Namespace, board: Board, known: Part | None, request: ViewsRequest
) -> dict[str, str]:
    """Take views of ``board`` as ``given.frames``; gives back the cameras' identities."""
    folder = free_folder(given.out)
    with _opened(given, known, arm=False) as (rig, look):
        try:
            kept = gather(look, rig.operator, board, request, folder, say)
        except NoPlaceError as error:  # of the emulated operator
            raise ConfigError.plain(f"--board {given.board}: {error}") from error
        rig.operator.ask(Finish())
        identity = dict(rig.cameras.identity)
    say(f"{kept} views in {folder}")
    given.frames = [folder]
    return {camera: str(who) for camera, who in identity.items() if camera in request.cameras}


@contextmanager
def _opened(
    given: argparse.Namespace, known: Part | None, *, arm: bool
) -> Iterator[tuple[bench.OpenRig, TakePictures]]:
    """The rig's instruments, and what takes each camera's picture once all has come to rest."""
    names = ("arm", "operator", "cameras") if arm else ("operator", "cameras")
    with bench.open_rig(given.rig, names, seed=given.seed, capture=given.capture) as rig:
        refuse_other_cameras(known.record if known else None, rig.cameras.identity)
        taken = with_retries(lambda: pictures(rig.cameras.capture()))

        def look() -> Mapping[str, Grey]:
            rig.clock.sleep(rig.loaded.rig.cameras.settle_s)
            return taken()

        yield rig, look


# Boards, other tools, the stage


def board(given: argparse.Namespace) -> None:
    from bench.calibrate.board_print import board_pdf

    refuse_existing(given.pdf, replace=True, option="--pdf")
    write_synced(given.pdf, board_pdf(find_board(given.board)[0], given.paper))
    print(f"written: {given.pdf}; print it at 100 % and measure the line at its foot")


def export(given: argparse.Namespace) -> None:
    part = read_part(given.calibration).part
    if given.format == "ros":
        exchange.write_ros(part, given.out, given.camera)
    else:
        write = {"opencv": exchange.write_opencv, "bouguet": exchange.write_bouguet}
        write[given.format](part, given.out)
    print(f"written: {given.out}")


def take_over(given: argparse.Namespace) -> None:
    _one_source(given, given.file, "the other tool's files")
    if given.rig:
        part, record = _makers(given)
    elif given.format is None:
        raise ConfigError.plain("which tool's files are they? Name it with --format")
    else:
        part = exchange.read_foreign(given.file, given.format, given.image_size)
        record = _record(given, given.file)
    _write_step(given, replace(part, record=record), None)
    for fault in pair_faults(part.right_from_left) if part.right_from_left else ():
        complain(f"look at T before you go on: {fault}", CODES.met)


def _makers(given: argparse.Namespace) -> tuple[Part, Record]:
    """What the maker of the rig's cameras states of them."""
    with bench.open_rig(given.rig, ("cameras",)) as rig:
        ask = getattr(rig.cameras, "makers_calibration", None)
        stated = ask() if ask else None
        if stated is None:
            raise ConfigError.plain(
                f"{given.rig}: its cameras' driver has no calibration of their maker; calibrate"
                " them with a board ('teatbench calibrate cameras')"
            )
        identity, shown = rig.cameras.identity, rig.cameras.capture()
    sizes = {"left": shown.left.shape[::-1], "right": shown.right.shape[::-1]}
    if shown.depth_dmm is not None:
        sizes["depth"] = shown.depth_dmm.shape[::-1]
    part = exchange.read_maker(stated, sizes, f"the calibration of {identity['left']}'s maker")
    said = "stated with standard deviations" if part.covariance else "WITHOUT any uncertainty"
    print(f"the maker's calibration of {identity['left']}, {said}")
    record = _record(given, (), identity)
    return part, replace(record, with_what=f"the maker's own, read by {record.with_what}")


def stage(given: argparse.Namespace) -> int:
    from bench.truth.registration import write_registration

    rig = bench.load_rig(given.rig)
    found = calibrate_stage(
        rig,
        wall_time().replace(microsecond=0),
        say,
        layout=given.layout,
        teat=given.teat,
        at_mm=given.at,
        readings=given.readings,
        seed=rig.rig.seed if given.seed is None else given.seed,
        capture=given.capture,
    )
    write_registration(given.out, found)
    print(f"{len(found.stations)} positions, touches good for {found.u_mm:.2f} mm along an axis")
    for fit in found.comparison.fits:
        held_out_mm = found.comparison.held_out_mm[fit.model]
        held_out = "too few positions to hold one out"
        if held_out_mm is not None:
            held_out = f"held out {held_out_mm:.2f} mm"
        print(f"{fit.model}: residual {fit.fre_mm:.2f} mm rms, {held_out}")
    print(f"expected residual of the rigid fit: {found.expected_fre_mm:.2f} mm")
    for one in found.diagnostics:
        significant = ", SIGNIFICANT" if one.significant else ""
        print(f"{one.name}: {one.value:+.5f} (u {one.u:.5f}){significant}")
    print(
        f'Written: {given.out}. Name it in a script, beside which it lies: [truth] mode = "carry",'
        f' registration = "{given.out.name}"'
    )
    for fault in found.faults:
        complain(fault, CODES.not_met)
    return CODES.not_met if found.faults else CODES.met
