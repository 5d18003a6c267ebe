"""Pictures of a board to views: one pose of the board each, with the same name in every camera.

Pictures are folders by camera, files named by camera, or a recording; or they are taken from a rig
while the operator holds the board, until nothing is missing or the operator has had enough.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import count, repeat
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.config import ConfigError, check_within
from bench.files import png_bytes, write_synced
from bench.record.recording import RecordingError, read_grey
from bench.rig.loading import drawn
from bench.rig.reconnecting import is_loss
from detector.calibration.boards import Board
from detector.calibration.cameras import (
    COLUMNS,
    LEAST_CORNERS,
    ROWS,
    BoardView,
    Coverage,
    coverage,
    rough_poses,
)
from detector.calibration.corners import (
    DetectedBoard,
    SubPixel,
    ViewRefusedError,
    counted_corners,
    find_board,
    order_alike,
)
from detector.calibration.diagnosis import PairView
from instruments.camera.frame import Grey
from instruments.errors import InstrumentError
from instruments.operators.operator import BoardPose, Operator, OperatorEnough
from instruments.world.boards import Pattern
from textfiles.bounds import COUNT
from textfiles.text import plural

CAMERAS = ("left", "right", "thermal")
ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
LAYOUT = (
    "left/NAME.png and right/NAME.png (and thermal/NAME.png), or leftNAME.png and rightNAME.png, or"
    " a recording's frames/NAME/left.png"
)


# paths by camera, then by the name of the view; every camera has at least one picture
Pictures = Mapping[str, Mapping[str, Path]]
Size = tuple[int, int]  # columns, rows
DetectionOrRefusal = DetectedBoard | ViewRefusedError


def find_pictures(places: Sequence[Path | str], cameras: Sequence[str]) -> Pictures:
    """Pictures of these cameras. Raises ConfigError for no folder, no picture, a view twice."""
    found: dict[str, dict[str, Path]] = {}
    for place in map(Path, places):
        if not place.is_dir():
            raise ConfigError.plain(
                f"{place}: no such folder; a set of pictures is a folder with {LAYOUT}"
            )
        pictures = _in_folder(place)
        if not pictures:
            raise ConfigError.plain(f"{place}: no picture found; wanted: {LAYOUT}")
        for camera, view, path in pictures:
            name = f"{place.name}/{view}" if len(places) > 1 else view
            first = found.setdefault(camera, {}).setdefault(name, path)
            if first is not path:
                raise ConfigError.plain(
                    f"{path}: view {name!r} of the {camera} camera is there twice (also {first})"
                )
    if missing := [camera for camera in cameras if camera not in found]:
        raise ConfigError.plain(
            f"no picture of the {missing[0]} camera was found; wanted: {LAYOUT}"
        )
    return {camera: dict(sorted(found[camera].items())) for camera in cameras}


def _in_folder(place: Path) -> list[tuple[str, str, Path]]:
    """Camera, view and path of each picture in one folder, by whichever of the layouts it keeps."""
    if (place / "frames").is_dir():
        place = place / "frames"
    by_camera = [
        (camera, path.stem, path) for camera in CAMERAS for path in _pictures(place / camera)
    ]
    by_frame = [
        (path.stem, frame.name, path)
        for frame in sorted(place.iterdir())
        if frame.name not in CAMERAS
        for path in _pictures(frame)
        if path.stem in CAMERAS
    ]
    by_name = [
        (camera, path.stem.removeprefix(camera), path)
        for path in _pictures(place)
        for camera in CAMERAS
        if path.stem.startswith(camera)
    ]
    return by_camera or by_frame or by_name


def _pictures(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*") if path.suffix.lower() in ENDINGS)


@dataclass(frozen=True, slots=True, eq=False)
class RefusedPicture:
    camera: str
    view: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class BoardViews:
    """``found`` by camera and view; ``image_size`` (columns, rows) px by camera."""

    board: Board
    found: Mapping[str, Mapping[str, DetectedBoard]]
    image_size: Mapping[str, tuple[int, int]]
    refused: tuple[RefusedPicture, ...]

    def views(self, camera: str) -> list[BoardView]:
        """The views of one camera, as the solver takes them."""
        return [
            BoardView(name, self.board.points_mm[found.ids], found.pixels_px)
            for name, found in self.found[camera].items()
        ]

    def pairs(self) -> list[PairView]:
        """The points that left and right saw in the same view."""
        pairs = []
        for name, left in self.found["left"].items():
            if right := self.found["right"].get(name):
                ids, in_left, in_right = np.intersect1d(left.ids, right.ids, return_indices=True)
                if len(ids) >= 4:
                    pixels = left.pixels_px[in_left], right.pixels_px[in_right]
                    pairs.append(PairView(name, ids, *pixels))
        return pairs


def refuse_missing(views: BoardViews, *cameras: str) -> None:
    """Raises ConfigError where there are no views of one of ``cameras``."""
    if missing := [camera for camera in cameras if camera not in views.found]:
        raise ConfigError.plain(f"views: none of the {' and the '.join(missing)} camera")


def find_views(
    pictures: Pictures,
    board: Board,
    *,
    report: Callable[[int, int], None] = lambda _done, _of: None,
    window_px: int | None = None,
    max_views: int | None = None,
    mirrored: frozenset[str] = frozenset(),
) -> BoardViews:
    """The board in at most ``max_views`` pictures; ``mirrored`` are turned. Raises ConfigError."""
    check_within(COUNT, max_views=max_views, window_px=window_px)
    chosen_views = {camera: _spread(views, max_views) for camera, views in pictures.items()}
    done, total = count(), sum(map(len, chosen_views.values()))
    found: dict[str, dict[str, DetectedBoard]] = {}
    sizes: dict[str, tuple[int, int]] = {}
    refused: list[RefusedPicture] = []

    def look(path: Path, turn: bool) -> tuple[Size | None, DetectionOrRefusal]:
        try:
            image = _picture(path, turn=turn)
        except ConfigError as why:
            return None, ViewRefusedError(str(why))
        size = image.shape[1], image.shape[0]
        try:
            return size, find_board(image, board, sub_pixel=SubPixel(window_px))
        except ViewRefusedError as why:
            return size, why

    threads = ThreadPoolExecutor()  # OpenCV looks for most of a board on one core
    try:
        for camera, chosen in chosen_views.items():
            found[camera], turn, readable = {}, camera in mirrored, dict(chosen)
            looked = threads.map(look, chosen.values(), repeat(turn))
            for name in chosen:
                report(next(done), total)
                size, seen = next(looked)
                if size is None:
                    del readable[name]
                else:
                    _refuse_other_size(camera, size, sizes, readable)
                if isinstance(seen, ViewRefusedError):
                    refused.append(RefusedPicture(camera, name, str(seen)))
                else:
                    found[camera][name] = seen
                if len(found[camera]) == 0 and name == [*chosen][:LOOKED_AT][-1]:
                    _refuse_other_count(camera, readable, found, board, turn=turn)
            if not readable:
                raise ConfigError.plain(f"no {camera} picture can be read: {refused[-1].reason}")
            _refuse_other_count(camera, readable, found, board, turn=turn)
    finally:
        threads.shutdown(cancel_futures=True)
    _order_alike(found, board)
    return BoardViews(board, found, sizes, (*refused, *_alone(found, chosen_views)))


def _picture(path: Path, *, turn: bool) -> Grey:
    """A picture in grey, mirrored where ``turn`` says so. Raises ConfigError."""
    try:
        image = read_grey(path)
    except RecordingError as error:
        raise ConfigError.plain(str(error)) from error
    return image[:, ::-1].copy() if turn else image


def _order_alike(found: dict[str, dict[str, DetectedBoard]], board: Board) -> None:
    """Boards that read the same when turned: all cameras count from the first camera's end."""
    first, *others = found
    for camera in others:
        for name, other in found[camera].items():
            if reference := found[first].get(name):
                found[camera][name] = order_alike(reference, other, board)


def _alone(
    found: Mapping[str, Mapping[str, DetectedBoard]], pictures: Pictures
) -> Iterator[RefusedPicture]:
    """Views of one camera that the other has no picture of."""
    for camera, views in found.items():
        for other, theirs in pictures.items():
            for view in views.keys() - theirs.keys():
                why = f"it has no partner {other} {view}, so it is no pair"
                yield RefusedPicture(camera, view, why)


def _refuse_other_size(
    camera: str, size: Size, known: dict[str, Size], pictures: Mapping[str, Path]
) -> None:
    """Raise ConfigError where pictures of a camera, or left and right, differ in ``size``."""
    if known.setdefault(camera, size) == size:
        if camera == "right" and size != known.get("left", size):
            left, right = ("{} x {}".format(*known[one]) for one in ("left", "right"))
            raise ConfigError.plain(
                f"left and right pictures differ in size, {left} and {right} px: are they from the"
                " same pair?"
            )
        return
    sizes = dict[Path, tuple[int, ...]]()
    for path in pictures.values():
        with suppress(RecordingError):
            sizes[path] = read_grey(path).shape[::-1]
    (usual, count), *_ = Counter(sizes.values()).most_common()
    odd, other = next((path, size) for path, size in sizes.items() if size != usual)
    raise ConfigError.plain(
        f"{odd}: {other[0]} x {other[1]} px, but {count} of the {len(sizes)} {camera} pictures have"
        f" {usual[0]} x {usual[1]}: one camera's pictures have one size. Take it out, or deliver it"
        " as the others"
    )


LOOKED_AT = 3  # pictures of a camera whose corners are counted, with the board and without
AGREE = 2  # of them, before a board's own count is doubted


def _refuse_other_count(
    camera: str,
    paths: Mapping[str, Path],
    found: Mapping[str, Mapping[str, DetectedBoard]],
    board: Board,
    *,
    turn: bool,
) -> None:
    """Raise ConfigError where the pictures hold a chessboard of another number of corners."""
    if board.kind != "chessboard":
        return
    wanted = sorted((board.columns, board.rows))
    without = [view for view in paths if view not in found[camera]]
    counts: dict[tuple[int, int], list[Path]] = {}
    for view in (*list(found[camera])[:LOOKED_AT], *without[:LOOKED_AT]):
        try:
            count = counted_corners(_picture(paths[view], turn=turn))
        except ConfigError:  # it is left out
            continue
        # where the board was found, less is a part of it
        if count and sorted(count) != wanted and (max(count) > wanted[1] or not found[camera]):
            counts.setdefault(count, []).append(paths[view])
    for (columns, rows), places in counts.items():
        if len(places) < min(AGREE, len(paths)):
            continue
        squares = sorted((columns + 1, rows + 1)) == wanted
        why = ": squares are counted there, inner corners are wanted" if squares else ""
        raise ConfigError.plain(
            f"{places[0]}: holds a chessboard of {columns} x {rows} inner corners, the board has"
            f" {board.columns} x {board.rows}{why}. Write columns = {columns}, rows = {rows}"
        )


def _spread(views: Mapping[str, Path], most: int | None) -> dict[str, Path]:
    """At most ``most``, evenly taken; the same where cameras have the same names."""
    names = sorted(views)
    if most is None or len(names) <= most:
        return dict(views)
    kept = {names[round(i * (len(names) - 1) / max(most - 1, 1))] for i in range(most)}
    return {name: path for name, path in views.items() if name in kept}


MOST_VIEWS = 60
TRIES = 3  # of one view, where a camera gives none
SHOWN = 3  # of what is missing, in one instruction
GUIDE = "guide.png"
HEIGHT_PX = 480  # of each camera's part of the guide's picture
COVERED, MISSING, CORNER = (90, 170, 60), (60, 60, 200), (0, 200, 255)  # blue, green, red
TINT = 0.25


@dataclass(frozen=True, slots=True)
class ViewsRequest:
    """Cameras that see the board, and those that it must cover (none: ``most`` views)."""

    cameras: tuple[str, ...] = ("left", "right")
    guided: tuple[str, ...] = ("left", "right")
    heated: bool = False
    most: int = MOST_VIEWS
    mirrored: frozenset[str] = frozenset()


def gather(
    look: Callable[[], Mapping[str, Grey]],
    operator: Operator,
    board: Board,
    wanted: ViewsRequest,
    folder: Path,
    report: Callable[[str], None],
    reconnect: Callable[[InstrumentError], None] = lambda _: None,
) -> int:
    """Keep views as CAMERA/NN.png; returns how many. ``reconnect`` waits for a lost camera, or
    raises its fault. Raises OperatorAbort, ConfigError.
    """
    guide = CoverageGuide(board, wanted.guided)
    pattern, number, lost = pattern_of(board), 1, 0
    while number <= wanted.most:
        missing = guide.missing
        if wanted.guided and not missing:
            report("Nothing is missing any more.")
            return number - 1
        text = _instruction(wanted, missing)
        asked = BoardPose(pattern, text, number, wanted.cameras, wanted.heated)
        try:
            operator.ask(asked)
            seen, lost = look(), 0
        except OperatorEnough as enough:
            report(f"Enough: {enough}. Still missing: {'; '.join(missing) or 'nothing'}.")
            return number - 1
        except InstrumentError as error:
            lost += 1
            _await(error, lost, reconnect, lambda: _report_kept(number - 1, folder, report))  # noqa: B023
            report(f"view {number}: {error} The view is asked for again.")
            continue
        for camera in wanted.cameras:
            if camera not in seen:
                raise ConfigError.plain(
                    f"the rig has no {camera} camera: {', '.join(seen)} delivered pictures"
                )
        pictures = {camera: seen[camera] for camera in wanted.cameras}
        try:
            for camera, picture in pictures.items():
                write_picture(folder / camera / f"{number:02d}.png", picture)
            said = guide.add(
                {c: p[:, ::-1].copy() if c in wanted.mirrored else p for c, p in pictures.items()}
            )
            report(f"view {number}: " + "; ".join(f"{name} {text}" for name, text in said.items()))
            number += 1
            write_picture(folder / GUIDE, guide.picture())
        except OSError:  # of a full disk, for one
            _report_kept(number - 1, folder, report)
            raise
    report(
        f"{wanted.most} views are enough. Still missing: {'; '.join(guide.missing) or 'nothing'}."
    )
    return wanted.most


def _await(
    error: InstrumentError,
    lost: int,
    reconnect: Callable[[InstrumentError], None],
    report_kept: Callable[[], None],
) -> None:
    """Until a camera that was lost is back. Raises ``error`` where it stays away, and after
    `TRIES` in a row.
    """
    try:
        if lost == TRIES:
            raise error
        if is_loss(error):
            reconnect(error)
    except InstrumentError:
        report_kept()
        raise


def _report_kept(views: int, folder: Path, report: Callable[[str], None]) -> None:
    if views:
        report(
            f"Taken so far: {plural(views, 'view')}, in {folder}, to be given with further ones."
        )


def free_folder(out: Path) -> Path:
    """A folder beside ``out`` that isn't there yet: pictures are never overwritten."""
    place = first = out.with_suffix(".pictures")
    for n in count(2):
        if not place.exists():
            break
        place = first.with_name(f"{first.name}-{n}")
    return place


def pattern_of(board: Board) -> Pattern:
    return drawn(board, 0.5)


def write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    """A PNG, whole or not at all."""
    write_synced(path, png_bytes(image))


def _instruction(wanted: ViewsRequest, missing: tuple[str, ...]) -> str:
    who = f"{' and '.join(wanted.cameras)} see{'s' if len(wanted.cameras) == 1 else ''}"
    hold = f"Hold the {'heated ' * wanted.heated}board still where {who} all of it"
    if not missing:
        return f"{hold}, another way each time: {wanted.most} views."
    more = f"; and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
    return f"{hold}. Missing: {'; '.join(missing[:SHOWN])}{more}."


class CoverageGuide:
    """Views of ``board`` so far; ``guided`` cameras must be covered. Pictures are un-mirrored."""

    def __init__(self, board: Board, guided: tuple[str, ...]) -> None:
        self._board = board
        self._guided = guided
        self._found: dict[str, list[DetectedBoard]] = {}
        self._latest: dict[str, tuple[Grey, DetectedBoard | None]] = {}

    def add(self, pictures: Mapping[str, Grey]) -> dict[str, str]:
        """One view; returns by camera: found, or refused with the reason."""
        said = {}
        for camera, picture in pictures.items():
            try:
                found = find_board(picture, self._board)
            except ViewRefusedError as why:
                self._latest[camera], said[camera] = (picture, None), f"refused: {why}"
                continue
            self._found.setdefault(camera, []).append(found)
            self._latest[camera], said[camera] = (picture, found), f"found, {len(found.ids)} points"
        return said

    @property
    def missing(self) -> tuple[str, ...]:
        """What is still to be shown, as instructions; one that two cameras share comes once."""
        note: dict[str, list[str]] = {}
        for camera in self._guided:
            for text in self._coverage(camera).missing:
                note.setdefault(text, []).append(camera)
        return tuple(f"{' and '.join(cameras)}: {text}" for text, cameras in note.items())

    def picture(self) -> NDArray[np.uint8]:
        """The last views side by side, BGR: points found, cells green where covered, else red."""
        parts = [self._drawn(camera, *self._latest[camera]) for camera in self._latest]
        return np.asarray(np.hstack(parts), dtype=np.uint8)

    def _coverage(self, camera: str) -> Coverage:
        found = self._found.get(camera, [])
        shape = self._latest[camera][0].shape if camera in self._latest else (1, 1)
        size = (shape[1], shape[0])
        pixels = [view.pixels_px for view in found]
        points = [self._board.points_mm[view.ids] for view in found]
        return coverage(pixels, size, rough_poses(points, pixels, size))

    def _drawn(self, camera: str, picture: Grey, found: DetectedBoard | None) -> NDArray[np.uint8]:
        scale = HEIGHT_PX / picture.shape[0]
        size = (round(picture.shape[1] * scale), HEIGHT_PX)
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        image = np.asarray(cv2.cvtColor(small, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        corners = self._coverage(camera).corners
        for row, column in np.ndindex(ROWS, COLUMNS) if camera in self._guided else ():
            ends = np.array([[row, column], [row + 1, column + 1]]) * image.shape[:2]
            (top, left), (bottom, right) = ends // (ROWS, COLUMNS)
            cell = image[top:bottom, left:right]
            colour = COVERED if corners[row, column] >= LEAST_CORNERS else MISSING
            cell[:] = np.rint((1.0 - TINT) * cell + TINT * np.array(colour)).astype(np.uint8)
            cv2.rectangle(image, (left, top), (right - 1, bottom - 1), colour, 1)
        if found is not None:
            for x, y in found.pixels_px * scale:
                cv2.circle(image, (round(x), round(y)), 3, CORNER, 1, cv2.LINE_AA)
        views = len(self._found.get(camera, []))
        text = f"{camera}: {'found' if found else 'refused'}, {views} views"
        for colour, width in (((0, 0, 0), 4), ((255, 255, 255), 1)):
            cv2.putText(
                image, text, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, width, cv2.LINE_AA
            )
        return image
