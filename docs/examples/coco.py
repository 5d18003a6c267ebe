"""Masks and key points of simulated scenes in COCO's format, for training.

    python docs/examples/coco.py ideal 0 20 train

Draws members 0 to 19 of the family `ideal` into the recording `train` and writes `train.json`
beside it, so that no detector under test is shown it. Masks are uncompressed run lengths down the
columns; pixel centres are at whole numbers.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

import bench
from instruments import Labels

NOT_LABELLED, NOT_VISIBLE, VISIBLE = 0, 1, 2  # COCO's flags of a key point
PICTURES = ("left.png", "right.png", "thermal.png")
CATEGORY = {
    "id": 1,
    "name": "teat",
    "supercategory": "udder",
    "keypoints": ["end", "base"],
    "skeleton": [[1, 2]],
}


def main(family: str, first: int, count: int, folder: Path, rig: str = "emulated") -> Path:
    """Write the recording and its labels; gives back the file of labels."""
    loaded = bench.load_rig(rig)
    writer = bench.RecordingWriter(folder)
    writer.add_calibration(loaded.calibration_path.read_text(encoding="utf-8"))
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for number in range(first, first + count):
        shot = bench.draw(family, number, rig=loaded)
        frame = f"{family}-{number:04d}"
        writer.add(frame, shot.frames)
        writer.add_truth(frame, shot.truth)
        for labels, name in zip(bench.labels(shot, rig=loaded), PICTURES, strict=True):
            height, width = labels.shown.shape
            image = {
                "id": len(images) + 1,
                "file_name": f"frames/{frame}/{name}",
                "width": width,
                "height": height,
                "camera": labels.camera,
                "family": family,
                "member": number,
            }
            images.append(image)
            for one in teats(labels):
                one |= {"id": len(annotations) + 1, "image_id": image["id"]}
                annotations.append(one)
    info = {
        "description": "Teats of simulated scenes; file names are seen from the recording",
        "version": bench.__version__,
        "trained_on": {family: [[first, first + count - 1]]},
    }
    table = {"info": info, "categories": [CATEGORY], "images": images, "annotations": annotations}
    path = folder.with_suffix(".json")
    path.write_text(json.dumps(table, separators=(",", ":")), encoding="utf-8")
    return path


def teats(labels: Labels) -> list[dict[str, Any]]:
    """An annotation for each teat that shows in the picture."""
    found = []
    for teat in range(len(labels.ends_px)):
        mask = labels.shown == teat
        if not mask.any():
            continue
        rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        points = [
            *point(labels.ends_px[teat], labels.ends_seen[teat], mask.shape),
            *point(labels.bases_px[teat], labels.bases_seen[teat], mask.shape),
        ]
        wide, high = columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1
        found.append(
            {
                "category_id": CATEGORY["id"],
                "teat": teat + 1,
                "iscrowd": 0,
                "segmentation": {"size": [*mask.shape], "counts": run_lengths(mask)},
                "area": int(mask.sum()),
                "bbox": [int(columns[0]), int(rows[0]), int(wide), int(high)],
                "keypoints": points,
                "num_keypoints": sum(flag != NOT_LABELLED for flag in points[2::3]),
            }
        )
    return found


def run_lengths(mask: Any) -> list[int]:
    """COCO's counts of a mask (h, w): pixels outside and inside in turn, column by column."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    counts: list[int] = np.diff([0, *changes.tolist(), flat.size]).tolist()
    return [0, *counts] if flat[:1].any() else counts


def point(px: Any, seen: bool, shape: tuple[int, ...]) -> list[float]:
    """A key point; one outside of the picture isn't labelled."""
    height, width = shape
    column, row = px.tolist()
    if not (-0.5 <= column <= width - 0.5 and -0.5 <= row <= height - 0.5):
        return [0, 0, NOT_LABELLED]
    return [round(column, 2), round(row, 2), VISIBLE if seen else NOT_VISIBLE]


if __name__ == "__main__":
    with bench.program(__doc__, str, int, int, Path) as given:
        print(main(*given))
