"""Where pictures of a board come from: folders by camera, files named by camera, or a recording. Names of views are what pairs them.

Strategy: find which picture is whose before any is read; a view is one pose of the board, and its name is the same in every camera. May not
know boards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.config import ConfigError

CAMERAS = ("left", "right", "thermal")
ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
LAYOUT = "left/NAME.png and right/NAME.png (and thermal/NAME.png), or leftNAME.png and rightNAME.png, or a recording's frames/NAME/left.png"


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
                raise ConfigError.plain(f"no picture of the {camera} camera was found; wanted: {LAYOUT}")
        return PictureSet({camera: self.pictures[camera] for camera in cameras})


def find_pictures(places: Sequence[Path]) -> PictureSet:
    """All pictures in the folders ``places``. Raises ConfigError for a place that is none, or holds none, or has a view twice."""
    found: dict[str, dict[str, Path]] = {}
    for place in places:
        if not place.is_dir():
            raise ConfigError.plain(f"{place}: no such folder; a set of pictures is a folder with {LAYOUT}")
        prefix = f"{place.name}/" if len(places) > 1 else ""
        before = sum(map(len, found.values()))
        for camera, name, path in _in_folder(place):
            views = found.setdefault(camera, {})
            if prefix + name in views:
                raise ConfigError.plain(
                    f"{path}: view {prefix + name!r} of the {camera} camera is there twice (also {views[prefix + name]})"
                )
            views[prefix + name] = path
        if sum(map(len, found.values())) == before:
            raise ConfigError.plain(f"{place}: no picture found; wanted: {LAYOUT}")
    return PictureSet({camera: dict(sorted(found[camera].items())) for camera in CAMERAS if camera in found})


def _in_folder(place: Path) -> list[tuple[str, str, Path]]:
    """Camera, view and path of each picture in one folder, by whichever of the layouts it keeps."""
    if (place / "frames").is_dir():
        place = place / "frames"
    by_camera = [(camera, path.stem, path) for camera in CAMERAS for path in _pictures(place / camera)]
    by_name = [
        (camera, path.stem.removeprefix(camera), path) for path in _pictures(place) for camera in CAMERAS if path.stem.startswith(camera)
    ]
    by_frame = [(path.stem, frame.name, path) for frame in _folders(place) for path in _pictures(frame) if path.stem in CAMERAS]
    return by_camera or by_frame or by_name


def _pictures(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS) if folder.is_dir() else []


def _folders(place: Path) -> list[Path]:
    return sorted(path for path in place.iterdir() if path.is_dir() and path.name not in CAMERAS)
