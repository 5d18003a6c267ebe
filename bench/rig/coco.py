"""Masks and key points of a recording of simulated scenes, in COCO's format, for training.

A file of its own, written when it is asked for: no detector under test is shown it. Masks are
uncompressed run lengths down the columns (COCO's RLE); pixel centres are at whole numbers.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.config import ConfigError
from bench.files import write_synced
from bench.record.recording import FILES
from bench.version import __version__
from instruments.world.labels import Labeller, Labels
from instruments.world.scene import Renderer
from instruments.world.state import SceneState

NOT_LABELLED, NOT_VISIBLE, VISIBLE = 0, 1, 2  # COCO's flags of a key point
CATEGORY = {
    "id": 1,
    "name": "teat",
    "supercategory": "udder",
    "keypoints": ["end", "base"],
    "skeleton": [[1, 2]],
}


class CocoFile:
    """The file at ``path``, gathered frame by frame; `write` puts it there as a whole."""

    def __init__(self, path: Path, renderer: Renderer) -> None:
        self._path = path
        self._labeller = Labeller(renderer)
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []
        self._members: dict[str, list[int]] = {}

    def add(self, frame: str, family: str, member: int, state: SceneState) -> None:
        """A frame of the recording, and the scene that it was drawn of."""
        self._members.setdefault(family, []).append(member)
        for labels, name in zip(self._labeller.of(state), FILES, strict=False):
            height, width = labels.shown.shape
            image = len(self._images) + 1
            self._images.append(
                {
                    "id": image,
                    "file_name": f"frames/{frame}/{name}",
                    "width": width,
                    "height": height,
                    "frame": frame,
                    "camera": labels.camera,
                    "family": family,
                    "member": member,
                }
            )
            self._annotations += [
                {"id": len(self._annotations) + number, "image_id": image, **one}
                for number, one in enumerate(teats_shown(labels), 1)
            ]

    def write(self) -> None:
        """Raises ConfigError where it can't be written."""
        info = {
            "description": "Teats of simulated scenes; file names are seen from the recording",
            "version": __version__,
            "trained_on": {family: ranges(these) for family, these in self._members.items()},
        }
        table = {"info": info, "categories": [CATEGORY], "images": self._images}
        text = json.dumps({**table, "annotations": self._annotations}, separators=(",", ":"))
        try:
            write_synced(self._path, text.encode("utf-8"))
        except OSError as error:
            raise ConfigError.plain(f"--coco {self._path}: can't be written: {error}") from error


def teats_shown(labels: Labels) -> list[dict[str, Any]]:
    """One for each teat that shows in the picture, without the numbers of annotation and image."""
    found = []
    for teat in range(len(labels.ends_px)):
        mask = labels.shown == teat
        if not mask.any():
            continue
        rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        points = [
            *_point(labels.ends_px[teat], labels.ends_seen[teat], mask.shape),
            *_point(labels.bases_px[teat], labels.bases_seen[teat], mask.shape),
        ]
        low, high = (columns[0], rows[0]), (columns[-1], rows[-1])
        found.append(
            {
                "category_id": CATEGORY["id"],
                "teat": teat + 1,
                "iscrowd": 0,
                "segmentation": {"size": [*mask.shape], "counts": run_lengths(mask)},
                "area": int(mask.sum()),
                "bbox": [*map(int, low), *(int(b - a) + 1 for a, b in zip(low, high, strict=True))],
                "keypoints": points,
                "num_keypoints": sum(flag != NOT_LABELLED for flag in points[2::3]),
            }
        )
    return found


def run_lengths(mask: NDArray[np.bool_]) -> list[int]:
    """COCO's counts of a mask (h, w): pixels outside and inside in turn, column by column."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    counts: list[int] = np.diff([0, *changes.tolist(), flat.size]).tolist()
    return [0, *counts] if flat[:1].any() else counts


def ranges(numbers: list[int]) -> list[list[int]]:
    found: list[list[int]] = []
    for number in sorted(set(numbers)):
        if found and number == found[-1][1] + 1:
            found[-1][1] = number
        else:
            found.append([number, number])
    return found


def _point(px: NDArray[np.float64], seen: bool, shape: tuple[int, ...]) -> list[float]:
    """A key point; one outside of the picture isn't labelled."""
    height, width = shape
    column, row = px.tolist()
    if not (-0.5 <= column <= width - 0.5 and -0.5 <= row <= height - 0.5):
        return [0, 0, NOT_LABELLED]
    return [round(column, 2), round(row, 2), VISIBLE if seen else NOT_VISIBLE]
