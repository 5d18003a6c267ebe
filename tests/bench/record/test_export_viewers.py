"""A run's time line opened by a viewer's own reader: rerun shows the pictures, places, ties and
lenses that went in.

Needs rerun-sdk, which is no part of the tests' requirements for its size; docs/record.md says what
was opened by whom.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bench.record.writer import Store
from bench.rig.loading import RIGS
from instruments.clock import wall_time
from tests.bench.commands import teatbench
from tests.bench.record.test_record import facts, trial
from tests.bench.record.test_record_exports import TOUCH

rerun: Any = pytest.importorskip(
    "rerun.chunk", reason="rerun-sdk is not installed: no viewer to open the export with"
)

LEFT = np.arange(48, dtype=np.uint8).reshape(6, 8)
THERMAL = np.arange(29_000, 29_012, dtype=np.uint16).reshape(3, 4)
Shown = dict[str, list[dict[str, Any]]]  # rows of a topic's components


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    """What rerun makes of each topic."""
    folder = tmp_path_factory.mktemp("viewers")
    store = Store.create(
        folder / "run",
        {"calibration.toml": (RIGS / "calibration.toml").read_text(encoding="utf-8")},
    )
    facts(store)
    store.event(0.5, "fault", "the stage is gone", wall_time())
    made, times = trial(store, 1), {"captured_s": 1.0, "stage_mm": "[100.0, 0.0, -5.0]"}
    frames = store.frames("001-x-1", {"left": LEFT, "thermal_radiometric": THERMAL}, {"left": 1.0})
    touch = {"trial": "001-x-1", **TOUCH}
    store.finished(replace(made, head={**made.head, **times}, frames=frames, touches=[touch]))
    store.close()
    assert teatbench("store export {} --format mcap --out {}", folder / "run", folder) == 0
    found: Shown = {}
    for topic, row in rows(folder / "run.mcap"):
        found.setdefault(topic, []).append(row)
    return found


def rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Without what rerun tells of the file itself."""
    for chunk in rerun.McapReader(path).stream():
        for row in chunk.to_record_batch().to_pylist():
            kept = {
                name: value
                for name, value in row.items()
                if value and not name.startswith(("Mcap", "rerun."))
            }
            if any(":" in name for name in kept):
                yield chunk.entity_path, kept


def test_every_topic_is_drawn_and_none_is_left_as_bytes(shown: Shown) -> None:
    drawn = {
        topic: {name.partition(":")[0] for row in kept for name in row if ":" in name}
        for topic, kept in shown.items()
    }
    wanted = {
        "/tf": "Transform3D",
        "/lenses/left": "Pinhole",
        "/lenses/right": "Pinhole",
        "/cameras/left": "EncodedImage",
        "/cameras/thermal_radiometric": "Image",
        "/events": "TextLog",
        **dict.fromkeys(("/stage", "/arm", "/truth", "/detections/thesis"), "InstancePoses3D"),
        "/bath": "teatbench.Bath",
        "/trial": "teatbench.Trial",
        "/answers/thesis": "teatbench.Answer",
    }
    assert {topic for topic in drawn if not topic.startswith("/__")} == set(wanted)
    for topic, kind in wanted.items():
        assert kind in drawn[topic], drawn[topic]


def test_pictures_come_out_as_they_went_in(shown: Shown) -> None:
    (left,) = shown["/cameras/left"]
    png = np.frombuffer(bytes(left["EncodedImage:blob"][0]), np.uint8)
    assert np.array_equal(np.asarray(cv2.imdecode(png, cv2.IMREAD_UNCHANGED)), LEFT)
    (thermal,) = shown["/cameras/thermal_radiometric"]
    (shape,) = thermal["Image:format"]
    assert (shape["width"], shape["height"]) == (4, 3)
    pixels = np.frombuffer(bytes(thermal["Image:buffer"][0]), "<u2")
    assert np.array_equal(pixels.reshape(3, 4), THERMAL)


def test_places_are_where_they_were(shown: Shown) -> None:
    assert np.allclose(shown["/arm"][0]["InstancePoses3D:translations"], [[0.01, -0.02, 0.03]])
    assert np.allclose(shown["/stage"][0]["InstancePoses3D:translations"], [[0.1, 0.0, -0.005]])
    ties = [
        (*row["Transform3D:parent_frame"], *row["Transform3D:child_frame"]) for row in shown["/tf"]
    ]
    assert ties == [("world", "right"), ("right", "left"), ("left", "thermal")]
    (bath,) = shown["/bath"][0]["teatbench.Bath:message"]
    assert bath["temp_c"] == 33.0
    assert np.isnan(bath["external_c"])
