"""Pictures of a board (folders by camera, files named by camera, or a recording) to views: one pose
of the board each, with the same name in every camera. The board is found in each, alike in all
cameras; what is refused has its reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.config import ConfigError
from detector.calibration.boards import Board
from detector.calibration.cameras import View
from detector.calibration.corners import Found, SubPixel, ViewRefusedError, find_board, order_alike
from detector.calibration.diagnosis import PairView
from instruments.camera.recording import RecordingError, read_grey

CAMERAS = ("left", "right", "thermal")
ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
LAYOUT = (
    "left/NAME.png and right/NAME.png (and thermal/NAME.png), or leftNAME.png and rightNAME.png, or"
    " a recording's frames/NAME/left.png"
)


@dataclass(frozen=True, slots=True)
class PictureSet:
    """Paths by camera, then by the name of the view. Every camera here has at least one picture."""

    pictures: Mapping[str, Mapping[str, Path]]

    @property
    def paths(self) -> tuple[Path, ...]:
        """All pictures, in the order of cameras and views."""
        return tuple(path for views in self.pictures.values() for path in views.values())

    def only(self, *cameras: str) -> PictureSet:
        """The pictures of some cameras. Raises ConfigError where one has none."""
        for camera in cameras:
            if camera not in self.pictures:
                raise ConfigError.plain(
                    f"no picture of the {camera} camera was found; wanted: {LAYOUT}"
                )
        return PictureSet({camera: self.pictures[camera] for camera in cameras})


def find_pictures(places: Sequence[Path]) -> PictureSet:
    """All pictures in the folders ``places``. Raises ConfigError for a place that is none, or holds
    none, or has a view twice.
    """
    found: dict[str, dict[str, Path]] = {}
    for place in places:
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
    return PictureSet(
        {camera: dict(sorted(found[camera].items())) for camera in CAMERAS if camera in found}
    )


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
    """Empty where it is no folder."""
    return sorted(path for path in folder.glob("*") if path.suffix.lower() in ENDINGS)


@dataclass(frozen=True, slots=True, eq=False)
class Refused:
    """A picture that was left out, and why."""

    camera: str
    view: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class BoardViews:
    """The board as each camera saw it: ``found`` by camera and view. ``image_size`` (columns, rows)
    px by camera.
    """

    board: Board
    found: Mapping[str, Mapping[str, Found]]
    image_size: Mapping[str, tuple[int, int]]
    refused: tuple[Refused, ...]

    def views(self, camera: str) -> list[View]:
        """What the solver wants of one camera."""
        return [
            View(name, self.board.points_mm[found.ids], found.pixels_px)
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


def find_views(
    pictures: PictureSet,
    board: Board,
    tell: Callable[[str], None],
    *,
    window_px: int | None = None,
    max_views: int | None = None,
    mirrored: frozenset[str] = frozenset(),
) -> BoardViews:
    """The board in every picture; ``max_views`` takes that many, spread over the set. Raises
    ConfigError for pictures that can't be.

    Pictures of cameras in ``mirrored`` are turned round first.
    """
    found: dict[str, dict[str, Found]] = {}
    sizes: dict[str, tuple[int, int]] = {}
    refused: list[Refused] = []
    for camera, all_views in pictures.pictures.items():
        found[camera] = {}
        chosen = _spread(all_views, max_views)
        for name, path in chosen.items():
            try:
                image = read_grey(path)
            except RecordingError as error:
                raise ConfigError.plain(str(error)) from error
            if camera in mirrored:
                image = image[:, ::-1].copy()
            rows, columns = image.shape[:2]
            known = sizes.setdefault(camera, (columns, rows))
            if known != (columns, rows):
                first = next(iter(chosen.values()))
                raise ConfigError.plain(
                    f"{path}: {columns} x {rows} px, but {first} has {known[0]} x {known[1]}: one"
                    " camera's pictures have one size"
                )
            try:
                found[camera][name] = find_board(image, board, sub_pixel=SubPixel(window_px))
            except ViewRefusedError as why:
                refused.append(Refused(camera, name, str(why)))
                tell(f"{path}: left out: {why}")
    # boards that read the same when turned: all cameras count from the first camera's end
    first_camera, *others = found
    for camera in others:
        for name, other in found[camera].items():
            if reference := found[first_camera].get(name):
                found[camera][name] = order_alike(reference, other, board)
    return BoardViews(board, found, sizes, tuple(refused))


def _spread(views: Mapping[str, Path], most: int | None) -> dict[str, Path]:
    """At most ``most`` views, evenly taken; the same ones in every camera whose views have the same
    names.
    """
    names = sorted(views)
    if most is None or len(names) <= most:
        return dict(views)
    kept = {names[round(i * (len(names) - 1) / max(most - 1, 1))] for i in range(most)}
    return {name: path for name, path in views.items() if name in kept}
