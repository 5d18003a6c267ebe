"""What steps of a calibration need of a rig, and how they are written; the fits are
`calibrate_pair`, `calibrate_thermal`, `map_pairs` and `calibrate_world`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from bench.api.loading import AnyRig
from bench.api.rigs import OpenRig, open_rig
from bench.calibrate.exchange import read_maker
from bench.calibrate.merge import calibration_record
from bench.calibrate.views import ViewsRequest, free_folder, gather
from bench.calibrate.world import POINTS_FILE, TouchSession, gather_points
from bench.config import ConfigError
from bench.rig.alone import TakePictures, pictures, with_retries
from bench.rig.reconnecting import Reconnecting
from bench.script.calibration_age import refuse_other_cameras
from detector.calibration import Part
from detector.calibration.boards import Board
from instruments.camera.frame import Grey
from instruments.captures.capture import CaptureFile
from instruments.operators.operator import Finish
from textfiles.text import plural

Say = Callable[[str], None]
STEREO = ViewsRequest()


@contextmanager
def open_cameras_of(
    rig: AnyRig,
    instruments: Sequence[str] = ("operator", "cameras"),
    *,
    known: Part | None = None,
    seed: int | None = None,
    capture: CaptureFile | None = None,
) -> Iterator[tuple[OpenRig, TakePictures]]:
    """A rig with cameras, and what takes each one's picture once all has come to rest. Raises
    LimitError for other cameras than ``known`` is of, and as `open_rig`.
    """
    with open_rig(rig, instruments, seed=seed, capture=capture) as opened:
        refuse_other_cameras(known.record if known else None, opened.cameras.identity)
        taken = with_retries(lambda: pictures(opened.cameras.capture()))

        def look() -> Mapping[str, Grey]:
            opened.clock.sleep(opened.loaded.rig.cameras.settle_s)
            return taken()

        yield opened, look


def take_views(
    rig: AnyRig,
    board: Board,
    out: Path | str,
    wanted: ViewsRequest = STEREO,
    *,
    known: Part | None = None,
    seed: int | None = None,
    capture: CaptureFile | None = None,
    say: Say = lambda _: None,
) -> tuple[Path, dict[str, str]]:
    """Have the operator show a board to a rig's cameras until it was everywhere in the pictures, or
    has been shown ``wanted.most`` times, or the operator has enough: the new folder of pictures,
    ``out`` with the ending ``.pictures``, numbered where that is there, and the identities of the
    cameras. Raises as `open_cameras_of`, and OperatorAbort, NoPlaceError.
    """
    folder = free_folder(Path(out))
    with open_cameras_of(rig, known=known, seed=seed, capture=capture) as (opened, look):
        who = opened.operator.ask, opened.clock, say, opened.loaded.rig.limits.away_s
        lost = Reconnecting({"cameras": look}, *who, "The views so far are kept.")
        kept = gather(look, opened.operator, board, wanted, folder, say, lost.wait)
        opened.operator.ask(Finish())
        identity = dict(opened.cameras.identity)
    say(f"{plural(kept, 'view')} in {folder}")
    return folder, {name: str(who) for name, who in identity.items() if name in wanted.cameras}


def touch_points(
    rig: AnyRig,
    board: Board,
    out: Path | str,
    *,
    known: Part | None = None,
    seed: int | None = None,
    capture: CaptureFile | None = None,
    say: Say = lambda _: None,
) -> Path:
    """Have the operator touch points of a board that both cameras see: a table of them for
    `read_points`, in a new folder beside ``out``. Raises as `take_views`.
    """
    folder, names = free_folder(Path(out)), ("arm", "operator", "cameras")
    with open_cameras_of(rig, names, known=known, seed=seed, capture=capture) as (opened, look):
        try:
            opened.home()
            radius_mm = opened.loaded.rig.arm.tip_radius_mm
            who = opened.arm, opened.operator.ask, opened.clock, say
            lost = Reconnecting.of_arm(*who, opened.loaded.rig.limits.away_s, look=look)
            asking = TouchSession(look, opened.operator, opened.tip, radius_mm, say, lost.wait)
            gather_points(asking, board, folder)
            opened.operator.ask(Finish())
        finally:
            opened.arm.safe()
    return folder / POINTS_FILE


def makers_calibration(rig: AnyRig, *, by: str = "") -> Part:
    """What the maker of a rig's cameras states of them, by their driver. Raises ConfigError."""
    with open_rig(rig, ("cameras",)) as opened:
        ask = getattr(opened.cameras, "makers_calibration", None)
        stated = ask() if ask else None
        if stated is None:
            raise ConfigError.plain(
                f"{opened.loaded.path}: its cameras' driver has no calibration of their maker;"
                " calibrate them with a board ('teatbench calibrate cameras')"
            )
        identity, shown = opened.cameras.identity, opened.cameras.capture()
    sizes = {"left": shown.left.shape[::-1], "right": shown.right.shape[::-1]}
    if shown.depth_dmm is not None:
        sizes["depth"] = shown.depth_dmm.shape[::-1]
    part = read_maker(stated, sizes, f"the calibration of {identity['left']}'s maker")
    record = calibration_record(by=by, cameras=identity)
    stated_by = f"the maker's own, read by {record.with_what}"
    return replace(part, record=replace(record, with_what=stated_by))
