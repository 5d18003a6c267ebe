"""The codec of external detectors: whatever comes is an answer or one of two refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from detector.calibration import Calibration
from detector.external.lines import (
    BadAnswer,
    GarbledLine,
    answer_line,
    check_ready,
    context_in,
    parse_answer,
    request_line,
)
from detector.protocol import CamerasOff, Context, Detection, Teat, Visit


def line(**answer: Any) -> bytes:
    return json.dumps({"frame": "7", "teats": [], **answer}).encode()


def test_a_question_names_the_pictures_that_there_are() -> None:
    pictures, calibration = {"left": Path("l.png"), "right": Path("r.png")}, Path("ü/c.toml")
    asked = json.loads(request_line("7", pictures, calibration))
    paths = {"left": "l.png", "right": "r.png", "calibration": str(calibration)}
    assert asked == {"frame": "7", **paths}
    assert request_line("7", {}, Path("x")).count(b"\n") == 1


def test_a_history_goes_with_the_question_and_predictions_come_apart(rig: Calibration) -> None:
    visit = Visit(
        30.5, 8.0, (1, 3), np.array([[1.0, 2, 3], [4, 5, 6]]), np.tile(np.eye(3), (2, 1, 1))
    )
    context = Context(9.25, 41.0, (visit,), CamerasOff(-1.0, 0.1, 4))
    asked = json.loads(request_line("7", {}, Path("x"), context))
    again = context_in(asked)
    assert again is not None
    assert (again.hours_since_milking, again.days_in_milk) == (9.25, 41.0)
    assert again.cameras == context.cameras
    (one,) = again.visits
    assert (one.hours_ago, one.hours_since_milking, one.teats) == (30.5, 8.0, (1, 3))
    assert one.ends_mm.tolist() == visit.ends_mm.tolist()
    assert one.covariances_mm2.shape == (2, 3, 3)
    assert context_in(json.loads(request_line("7", {}, Path("x")))) is None
    teats = Teat(np.ones(3)), Teat(np.array([1.0, 2.0, 3.0]), np.eye(3))
    said = Detection(teats, 1, "why", predicted=(Teat(np.zeros(3), np.eye(3)),))
    found = parse_answer(answer_line("7", said), "7", rig)
    assert [teat.world_mm.tolist() for teat in found.teats] == [[1.0, 1.0, 1.0], [1.0, 2.0, 3.0]]
    assert np.array_equal(np.asarray(found.teats[1].covariance_mm2), np.eye(3))
    assert (found.hidden, found.reason) == (1, "why")
    assert [teat.world_mm.tolist() for teat in found.predicted] == [[0.0, 0.0, 0.0]]
    with pytest.raises(BadAnswer, match='"predicted" of its answer is no list'):
        parse_answer(line(predicted=3), "7", rig)


def test_world_points_are_taken_as_they_are(rig: Calibration) -> None:
    spread = [[1.0, 0.1, 0], [0.1, 1, 0], [0, 0, 2]]
    teat = {"world_mm": [1, 2.5, -3], "covariance_mm2": spread, "colour": "pink"}
    found = parse_answer(line(teats=[teat], hidden=3, reason="one is dark"), "7", rig)
    assert (found.hidden, found.reason) == (3, "one is dark")
    assert found.teats[0].world_mm.tolist() == [1, 2.5, -3]
    assert found.teats[0].covariance_mm2 is not None
    assert found.teats[0].covariance_mm2.tolist() == spread


def test_pixel_pairs_are_triangulated(rig: Calibration) -> None:
    end = np.array([[-140.0, 205.0, 136.0]])
    left, right = rig.project(end)
    pair = {"left_px": left[0].tolist(), "right_px": right[0].tolist()}
    (teat,) = parse_answer(line(teats=[pair]), "7", rig).teats
    assert np.allclose(teat.world_mm, end[0], atol=1e-6)
    assert teat.left_px is not None
    assert np.allclose(teat.left_px, left[0])


@pytest.mark.parametrize("left", [[float("nan"), 1.0], [1e308, -1e308], [float("inf"), 0.0]])
def test_pixels_that_lead_nowhere_are_reported_as_pixels(
    rig: Calibration, left: list[float]
) -> None:
    note = r'"left_px" .* and "right_px" .* of teat 1 lead to no point in space'
    with pytest.raises(BadAnswer, match=note):
        parse_answer(line(teats=[{"left_px": left, "right_px": [1.0, 2.0]}]), "7", rig)


@pytest.mark.parametrize(
    ("sent", "note"),
    [
        (b"nonsense", "not JSON"),
        (b"\xff\xfe\n", "not JSON"),
        (b"", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"[1]", "no JSON object"),
        (line(frame="8"), "asked about frame"),
        (line(frame=7), 'asked about frame "7" .*; a frame\'s name is text'),
        (b'{"teats": []}', "asked about frame"),
    ],
)
def test_what_is_no_answer_is_garbled(rig: Calibration, sent: bytes, note: str) -> None:
    with pytest.raises(GarbledLine, match=note):
        parse_answer(sent, "7", rig)


@pytest.mark.parametrize(
    ("answer", "note"),
    [
        ({"teats": None}, 'no list "teats"'),
        ({"teats": {}}, 'no list "teats"'),
        ({"teats": [[1, 2, 3]]}, "teat 1 of its answer is no object"),
        ({"teats": [{}]}, 'neither "world_mm" nor'),
        ({"teats": [{"left_px": [1, 2]}]}, 'neither "world_mm" nor'),
        ({"teats": [{"world_mm": [1, 2]}]}, "not 3 numbers"),
        ({"teats": [{"world_mm": [1, 2, "x"]}]}, "not 3 numbers"),
        ({"teats": [{"world_mm": [True, False, True]}]}, "not 3 numbers"),
        ({"teats": [{"world_mm": [1, 2, None]}]}, "not 3 numbers"),
        ({"teats": [{"world_mm": [1, [2], 3]}]}, "not 3 numbers"),
        ({"teats": [{"world_mm": [1, 2, 10**400]}]}, "not 3 numbers"),
        ({"teats": [{"world_mm": [1, 2, 3], "covariance_mm2": [[1]]}]}, "not 3 x 3 numbers"),
        ({"hidden": "two"}, "not a whole number"),
        ({"hidden": True}, "not a whole number"),
        ({"hidden": 1.5}, "not a whole number"),
        ({"reason": 5}, "not text"),
    ],
)
def test_wrong_values_are_reported(rig: Calibration, answer: dict[str, Any], note: str) -> None:
    with pytest.raises(BadAnswer, match=note):
        parse_answer(line(**answer), "7", rig)


def test_the_first_line_says_ready() -> None:
    check_ready(b'{"ready": true, "name": "mine"}\n')
    note = r'its first line must be {"ready": true}, (is|but its line is)'
    for wrong in (b'{"ready": 1}', b"ready", b'{"frame": "1"}', b"null"):
        with pytest.raises(GarbledLine, match=note):
            check_ready(wrong)


def test_the_first_line_says_device_and_training() -> None:
    said = check_ready(
        b'{"ready": true, "device": "cpu", "trained_on": {"ideal": [[0, 19], 30], "mine": []}}'
    )
    assert said.device == "cpu"
    assert said.trained_on == {"ideal": ((0, 19), (30, 30)), "mine": ()}
    for wrong in ("[]", '{"ideal": 3}', '{"ideal": [[2, 1]]}', '{"ideal": [true]}', '{"a": ["x"]}'):
        with pytest.raises(GarbledLine, match='"trained_on" must be like'):
            check_ready(b'{"ready": true, "trained_on": %s}' % wrong.encode())
    with pytest.raises(GarbledLine, match='"device" of its first line is 3, not text'):
        check_ready(b'{"ready": true, "device": 3}')
