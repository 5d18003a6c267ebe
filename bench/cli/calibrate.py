"""`calibrate cameras|thermal|world|merge`: each step writes a dated file with its quality figures,
and a page that says how good it is; from files, or live with ``--rig``.

`calibrate check`: an existing calibration against a board, or points that the arm touches, today;
`calibrate stage`: where the stage's axes lie in the world; `calibrate board|export|import`.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import bench
from bench.cli.arguments import CODES, code_of, command_line, complain, refuse_existing
from bench.cli.arguments import say as show
from bench.cli.commands import CAMERAS
from bench.cli.terminal import working
from bench.config import ConfigError, read_calibration
from bench.files import write_synced
from textfiles.text import plural
from textfiles.whole import refusal

if TYPE_CHECKING:
    from bench.report.calibration import PageOf
    from detector import Calibration, Part, Record

CHECK_VIEWS, SHOWN = 5, 3
say = show  # for the person at the rig, while it is worked with
FOLDERS = "folders of pictures (FRAMES)"


# The steps


def cameras(given: argparse.Namespace) -> int:
    from bench.report.calibration import cameras_page, cameras_sentence, good

    _one_source(given, given.frames, FOLDERS)
    named = dict(text.partition("=")[::2] for text in given.identity)
    for camera, serial in named.items():
        if camera not in CAMERAS or not serial:
            raise ConfigError.plain(
                f"--identity {camera}={serial}: say left=SERIAL, right=SERIAL or thermal=SERIAL"
            )
    views, paths, identity = _views_of(given)
    lens = {"model": given.model, "square_pixels": given.square_pixels}
    with working("fitting the cameras"):
        result = bench.calibrate_pair(views, **lens)
    at_mm = given.distance
    page = partial(cameras_page, result, at_mm)
    unwritten = _finish(given, result.part, page, inputs=paths, cameras=identity | named)
    for camera, coverage in result.coverage.items():
        if coverage.missing:
            show(f"still missing, {camera}: {'; '.join(coverage.missing)}")
    for text in result.not_shown(at_mm):
        show(f"still missing: {text}")
    show(*result.text())
    good_mm = float(result.good_to_mm(np.array([at_mm]))[0])
    show(f"a point at {at_mm / 1000:g} m: good to {good_mm:.2f} mm (k = 2)")
    verdict, _ = good(result.findings, good_mm)
    show(f"Verdict: {verdict}. {cameras_sentence(result, at_mm)}")
    code = _say(result.findings, on_page=True) or code_of(verdict)
    return unwritten or code


def thermal(given: argparse.Namespace) -> int:
    from bench.report.calibration import pairs_page, thermal_page

    # how the pictures come: by command, by the rig's calibration or by its file
    usual = bench.delivered_by(bench.load_rig(given.rig)) if given.rig else bench.ThermalFormat()
    delivered = bench.ThermalFormat(
        given.sensor_size or usual.sensor_size,
        given.mirrored or usual.mirrored,
        given.polarity or usual.polarity,
        given.model,
    )
    if given.pairs is not None:
        if given.image_size is None:
            raise ConfigError.plain(
                "--pairs needs --image-size COLUMNSxROWS: how large the thermal picture is whose"
                " pixels the pairs name"
            )
        mapped = bench.map_pairs(given.pairs)
        part = partial(mapped.part, given.image_size, delivered)
        return _finish(given, part, partial(pairs_page, mapped), inputs=(given.pairs,))
    if not (given.frames or given.rig) or not given.board or not given.cameras:
        raise ConfigError.plain(
            "give folders of pictures or --rig with --board and --cameras, or a table with --pairs"
        )
    pair, mirrored = bench.read_part(given.cameras), {"thermal"} if delivered.mirrored else ()
    how = bench.ViewsRequest(
        ("left", "thermal"), guided=("thermal",), heated=True, mirrored=frozenset(mirrored)
    )
    views, paths, identity = _views_of(given, pair.part, how)
    with working("fitting the thermal camera"):
        plane = {"plane_depth_mm": given.plane} if given.plane else {}
        result = bench.calibrate_thermal(views, pair.part, delivered, **plane)
    page = partial(thermal_page, result)
    unwritten = _finish(given, result.part, page, inputs=paths, cameras=identity, pair=pair)
    of_views = [*result.joint.view_rms_px("thermal").values()]
    rms = float(np.sqrt(np.mean(np.square(of_views))))
    show(f"thermal camera: {rms:.3f} px rms over {plural(len(of_views), 'view')}")
    return unwritten


def world(given: argparse.Namespace) -> int:
    from bench.report.calibration import world_page

    _one_source(given, given.points, "a table of points (CSV)")
    pair = bench.read_part(given.cameras)
    if given.rig:
        if not given.board:
            raise ConfigError.plain(
                "--rig needs --board: what both cameras see and the arm touches"
            )
        board, _ = bench.find_board(given.board)
        to_touch = given.rig, board, given.out
        given.points = bench.touch_points(*to_touch, known=pair.part, **_live(given))
    result = bench.calibrate_world(bench.read_points(given.points), pair.part, **_noise(given))
    page = partial(world_page, result)
    unwritten = _finish(given, result.part, page, inputs=(given.points,), pair=pair)
    fit = result.fit
    missed = f"missed by {fit.comparison.rigid.fre_mm:.3f} mm rms"
    lengths = f"lengths {fit.scale:.5f} ± {fit.scale_sd:.5f} of the arm's"
    show(f"{plural(len(fit.touched_mm), 'point')}: {missed}, {lengths}")
    code = _say(result.findings)
    return unwritten or code


def merge(given: argparse.Namespace) -> None:
    _finish(given, partial(bench.merge_parts, [bench.read_part(path) for path in given.parts]))


def check(given: argparse.Namespace) -> int:
    from bench.report.calibration import LEAST_LOOKED_AT

    part = bench.read_part(given.calibration).part
    # whose pictures are kept beside the calibration that they check
    given.by, given.out = "", given.calibration
    if given.ends:
        return _check_ends(given, part)
    findings, looked_at, unwritten = (_check_points if given.points else _check_board)(given, part)
    if not findings and looked_at < LEAST_LOOKED_AT:
        what = "points" if given.points else "views of the board"
        text = f"{looked_at} {what} tell nothing, at least {LEAST_LOOKED_AT} are needed"
        return complain(f"not checked: {text}", CODES.inconclusive)
    show("It still holds." if not findings else "It no longer holds.")
    code = _say(findings)
    return unwritten or code


def _check_board(given: argparse.Namespace, part: Part) -> tuple[Sequence[Any], int, int]:
    """Findings, how many views were looked at, and an exit code where the page isn't written."""
    from bench.report.calibration import check_page

    others = ", touched points (--points CSV), touched ends (--ends DIR),"
    wanted = bench.ViewsRequest(guided=(), most=CHECK_VIEWS)
    views, paths, _ = _views_of(given, part, wanted, others)
    again, findings = bench.check_pair(part, views)
    scale, sd = again.scale
    show(
        f"{plural(len(again.views), 'view')}: lengths {scale:.5f} ± {sd:.5f} of the print, rows"
        f" {again.epipolar_rms_px:.2f} px rms"
    )
    unwritten = _finish(given, None, partial(check_page, again, findings), inputs=paths)
    return findings, len(again.views), unwritten


def _check_points(given: argparse.Namespace, part: Part) -> tuple[Sequence[Any], int, int]:
    """As `_check_board`, of points."""
    from bench.report.calibration import check_points_page

    if given.frames or given.rig:
        raise ConfigError.plain("--points is in the place of pictures and --rig: give one of them")
    again, findings = bench.check_points(part, bench.read_points(given.points), **_noise(given))
    rms = float(np.sqrt(np.mean(np.sum(again.missed_mm**2, axis=1))))
    show(
        f"{plural(len(again.missed_mm), 'point')}: missed by {rms:.2f} mm rms,"
        f" {np.sqrt(np.mean(again.expected_mm**2)):.2f} mm is to be expected"
    )
    page = partial(check_points_page, again, findings)
    unwritten = _finish(given, None, page, inputs=(given.points,))
    return findings, len(again.missed_mm), unwritten


def _check_ends(given: argparse.Namespace, part: Part) -> int:
    """Whether the cameras show touched teat ends where the calibration says."""
    from bench.report.calibration import check_ends_page

    if given.frames or given.points or given.board:
        raise ConfigError.plain("--ends is in the place of pictures, --points and --board")
    calibration = read_calibration(given.calibration)
    anew: list[Any] = []
    if given.rig:
        say(f"The phantom has to stand as in the last trial of {given.ends}.")
        how = {"known": part, "seed": given.seed, "capture": given.capture}
        with bench.open_cameras_of(given.rig, **how) as (rig, _):
            for _ in range(CHECK_VIEWS):
                rig.clock.sleep(rig.loaded.rig.cameras.settle_s)
                anew.append(bench.with_retries(rig.cameras.capture)())
    with working("looking for the ends in the pictures"):
        found = bench.check_ends(given.ends, calibration, anew)
    if anew and not found.thermal:
        show("no end in the thermal picture: it is not checked while the phantom is cold")
        found = replace(found, thermal=None)
    decision = found.decision
    show(f"{found.measured} of {found.ends} ends measured")
    for one in found.offsets:
        show(f"{one.text}, over {one.poses} {'ends' if anew else 'poses'}")
    unwritten = _finish(given, None, partial(check_ends_page, found, decision))
    if decision.verdict is bench.Verdict.MET:
        show("It still holds.")
        return unwritten
    if decision.verdict is bench.Verdict.NOT_MET:
        show("It no longer holds.")
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
    request: bench.ViewsRequest | None = None,
    others: str = "",
) -> tuple[bench.BoardViews, tuple[Path, ...], dict[str, str]]:
    """The board as the cameras of ``request`` see it, in the pictures named or taken live; the
    files that this came from; and of a rig the cameras' identities. Raises ConfigError,
    InstrumentError, OperatorAbort.
    """
    request = request or bench.ViewsRequest()
    _one_source(given, given.frames, FOLDERS + others)
    board, files = bench.find_board(given.board)
    identity: dict[str, str] = {}
    if given.rig:
        wanted = given.rig, board, given.out, request
        try:
            folder, identity = bench.take_views(*wanted, known=known, **_live(given))
        except bench.NoPlaceError as error:  # of the emulated operator
            raise ConfigError.plain(f"--board {given.board}: {error}") from error
        given.frames = [folder]
    found = bench.find_pictures(given.frames, request.cameras)
    with working("finding the board in the pictures") as report:
        views = bench.find_views(
            found,
            board,
            report=report,
            window_px=given.window,
            max_views=given.max_views,
            mirrored=request.mirrored,
        )
    for one in views.refused[:SHOWN]:
        show(f"left out: {one.camera} {one.view}: {one.reason}")
    if (more := len(views.refused) - SHOWN) > 0:
        show(f"left out: {more} more")
    paths = (*files, *(path for views_of in found.values() for path in views_of.values()))
    return views, paths, identity


def _finish(
    given: argparse.Namespace,
    part: Callable[[Record], Part | Calibration] | None,
    page: Callable[[], PageOf] | None = None,
    **known: Any,
) -> int:
    """The end of each step and check, with what its record says: the step's file, whole or not at
    all, and its page beside it; a check's page where it is wanted. Of a rig it says what its
    instruments are. A page that can't be written keeps back no figure: an exit code, else 0.
    """
    record, folder = bench.calibration_record(by=given.by, **known), getattr(given, "page", None)
    if part is not None:
        bench.write_calibration(part(record), given.out, command_line())
        show(f"written: {given.out}")
        folder = given.out.with_suffix(".page")
    if page is not None and folder:
        from bench.report.calibration import with_kind
        from reports.render import write_report

        made = page()(record, command_line())
        if given.rig:
            used = {"cameras", "arm"} if given.called == "calibrate world" else {"cameras"}
            made = with_kind(made, used, bench.load_rig(given.rig).rig.emulated)
        try:
            show(f"page: {write_report(made, folder)}")
        except OSError as error:
            why = refusal(error, "Name another place.")
            return complain(f"{folder}: the page can't be written: {why}", CODES.fault)
    return CODES.met


def _say(findings: Sequence[Any], *, on_page: bool = False) -> int:
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


def _noise(given: argparse.Namespace) -> dict[str, float]:
    return {"pixel_sd_px": given.pixel_sd, "touch_sd_mm": given.touch_sd}


def _live(given: argparse.Namespace) -> dict[str, Any]:
    return {"seed": given.seed, "capture": given.capture, "say": say}


# Boards, other tools, the stage


def board(given: argparse.Namespace) -> None:
    refuse_existing(given.pdf, replace=True, option="--pdf")
    write_synced(given.pdf, bench.board_pdf(bench.find_board(given.board)[0], given.paper))
    show(f"written: {given.pdf}; print it at 100 % and measure the line at its foot")


def export(given: argparse.Namespace) -> None:
    part = bench.read_part(given.calibration).part
    if given.format == "ros":
        bench.write_ros(part, given.out, given.camera)
    else:
        write = bench.write_opencv if given.format == "opencv" else bench.write_bouguet
        write(part, given.out)
    show(f"written: {given.out}")


def take_over(given: argparse.Namespace) -> None:
    _one_source(given, given.file, "the other tool's files")
    if given.rig:
        part = bench.makers_calibration(given.rig, by=given.by)
        said = "stated with standard deviations" if part.covariance else "WITHOUT any uncertainty"
        who = part.record.cameras["left"] if part.record else "unknown cameras"
        show(f"the maker's calibration of {who}, {said}")
    elif given.format is None:
        raise ConfigError.plain("which tool's files are they? Name it with --format")
    else:
        part = bench.read_foreign(given.file, given.format, given.image_size)
    made = (lambda _: part) if given.rig else (lambda record: replace(part, record=record))
    _finish(given, made, inputs=given.file)
    for fault in part.pair_faults:
        complain(f"look at T before you go on: {fault}", CODES.met)


def stage(given: argparse.Namespace) -> int:
    more = {"layout": given.layout, "teat": given.teat, "readings": given.readings}
    rig = bench.load_rig(given.rig)
    found = bench.calibrate_stage(rig, at_mm=given.at, **more, **_live(given))
    bench.write_registration(given.out, found)
    show(f"{len(found.stations)} positions, touches good for {found.u_mm:.2f} mm along an axis")
    for fit in found.comparison.fits:
        held_out_mm = found.comparison.held_out_mm[fit.model]
        held_out = "too few positions to hold one out"
        if held_out_mm is not None:
            held_out = f"held out {held_out_mm:.2f} mm"
        show(f"{fit.model}: residual {fit.fre_mm:.2f} mm rms, {held_out}")
    show(f"expected residual of the rigid fit: {found.expected_fre_mm:.2f} mm")
    for one in found.diagnostics:
        significant = ", SIGNIFICANT" if one.significant else ""
        show(f"{one.name}: {one.value:+.5f} (u {one.u:.5f}){significant}")
    show(
        f'Written: {given.out}. Name it in a script, beside which it lies: [truth] mode = "carry",'
        f' registration = "{given.out.name}"'
    )
    for fault in found.faults:
        complain(fault, CODES.not_met)
    return CODES.not_met if found.faults else CODES.met
