"""A recording whose calibration can't be: refused, or not decided and charged to no detector."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from bench.record.reader import read_run
from bench.record.recording import Recording, TruthRow
from bench.results.doubts import doubts_of
from detector.calibration import CalibrationError, load_calibration
from tests.bench.commands import Said
from tests.bench.small_recording import write_recording
from tests.conftest import ROOT
from tests.examples import examples
from textfiles.documents import read_toml

pytestmark = pytest.mark.slow

CASES = ROOT / "tests" / "data" / "cases"
SHIPPED = ROOT / "bench" / "rigs" / "calibration.toml"
DRAWN = [Phase.generate]  # to shrink a calibration takes minutes
Table = dict[str, Any]
Change = Callable[[Table, st.DataObject], None]


def written(table: Table) -> str:
    """TOML of a calibration's tables."""
    lines = []
    for name, block in table.items():
        blocks = block if name == "cameras" else {"": block}
        for own, keys in blocks.items():
            lines += [f"[{name}{f'.{own}' if own else ''}]"]
            lines += [f"{key} = {json.dumps(one)}" for key, one in keys.items()]
    return "\n".join(lines)


def of(camera: Callable[[Table, st.DataObject], None]) -> Change:
    """A change of the left or the right camera."""
    return lambda table, draw: camera(
        table["cameras"][draw.draw(st.sampled_from(["left", "right"]))], draw
    )


def _oblong(block: Table, draw: st.DataObject) -> None:
    block["fc"][0] *= draw.draw(st.floats(1.3, 40.0))


def _folded(block: Table, draw: st.DataObject) -> None:
    which = draw.draw(
        st.sampled_from([(0, -1.2, -40.0), (1, -3.0, -90.0), (2, 0.6, 30.0), (4, -9.0, -300.0)])
    )
    block["kc"][which[0]] = draw.draw(st.floats(min(which[1:]), max(which[1:])))


def _sized(block: Table, draw: st.DataObject) -> None:
    columns, rows = block["image_size"]
    by = draw.draw(st.floats(1.05, 4.0))
    block["image_size"] = draw.draw(
        st.sampled_from(
            [[rows, columns], [columns // 2, rows // 2], [int(columns * by), int(rows * by)]]
        )
    )


def _metres(table: Table, draw: st.DataObject) -> None:
    by = draw.draw(st.floats(0.001, 0.02))
    table["stereo"]["T"] = [by * one for one in table["stereo"]["T"]]


def _world(table: Table, draw: st.DataObject) -> None:
    by = draw.draw(st.sampled_from([-1.0, 0.001, 1000.0, 25.4]))
    table["world"]["T"] = [by * one for one in table["world"]["T"]]


def _mirrored(table: Table, draw: st.DataObject) -> None:
    at = draw.draw(st.integers(0, 2))
    table["world"]["om"][at] += draw.draw(st.sampled_from([-1.0, 1.0])) * math.pi / 2


# each figure of a lens or a pair that can't be has its test beside the gate: tests/detector
IMPOSSIBLE: dict[str, Change] = {
    "fx and fy apart": of(_oblong),
    "a distortion that folds": of(_folded),
    "pictures of another size": of(_sized),
    "a baseline in metres": _metres,
    "a world in another unit": _world,
    "a world on its side": _mirrored,
}


@cache
def recording() -> Recording:
    import tempfile

    return Recording(write_recording(Path(tempfile.mkdtemp()) / "rec", whole=True))


def refused(table: Table) -> list[str]:
    """Why the loader or the doubts don't let a calibration be scored with; [] where they do."""
    path = recording().path / "calibration.toml"
    path.write_text(written(table), encoding="utf-8")
    try:
        return [*doubts_of(recording(), load_calibration(path, doubtful=True))]
    except CalibrationError as error:
        return [str(error)]


def shipped() -> Table:
    table = read_toml(SHIPPED.read_text(encoding="utf-8"))
    table.pop("homography")  # which follows, and would be the one that is refused
    return table


@pytest.mark.parametrize("kind", IMPOSSIBLE)
@settings(max_examples=examples(1), phases=DRAWN)
@given(draw=st.data())
def test_each_kind_of_calibration_that_cannot_be_is_found(kind: str, draw: st.DataObject) -> None:
    table = shipped()
    IMPOSSIBLE[kind](table, draw)
    assert refused(table), (kind, table)


def sound(draw: st.DataObject) -> Table:
    """The shipped one as another lab's cameras have it, each value over a range."""
    table = shipped()
    for name in ("left", "right"):
        block = table["cameras"][name]
        by = draw.draw(st.floats(0.8, 1.1))
        block["fc"] = [by * f for f in block["fc"]]
        block["cc"] = [c + draw.draw(st.floats(-60.0, 60.0)) for c in block["cc"]]
        much = draw.draw(st.floats(0.0, 1.2))
        block["kc"] = [much * k for k in block["kc"]]
    by = draw.draw(st.floats(0.25, 1.3))
    table["stereo"]["T"] = [by * t for t in table["stereo"]["T"]]
    table["stereo"]["om"] = [om + draw.draw(st.floats(-0.02, 0.02)) for om in table["stereo"]["om"]]
    table["world"]["T"] = [t + draw.draw(st.floats(-20.0, 20.0)) for t in table["world"]["T"]]
    return table


@settings(max_examples=examples(10), phases=DRAWN)
@given(st.data())
def test_no_sound_calibration_is_doubted(draw: st.DataObject) -> None:
    assert refused(sound(draw)) == []


@pytest.fixture
def metres(tmp_path: Path) -> Path:
    folder = write_recording(tmp_path / "rec", whole=True)
    shutil.copy(CASES / "metres.toml", folder / "calibration.toml")
    return folder


def test_a_baseline_in_metres_is_not_the_detectors_fault(
    metres: Path, tmp_path: Path, said: Said
) -> None:
    found = said(
        4, "score {} --detector fused --detector thesis --out {}", metres, tmp_path / "runs"
    )
    words = " ".join(found.out.split())
    assert (
        "inconclusive The calibration can't be that of these pictures, so nothing is charged to any"
        in words
    )
    assert "a baseline of 0.1003 mm looks like metres: 100.3 mm are meant" in words
    assert "has to become better" not in words
    (run,) = (tmp_path / "runs").iterdir()
    record = read_run(run)
    assert not any(trial.scores for trial in record.trials)
    page = (run / "report" / "index.html").read_text(encoding="utf-8")
    assert "looks like metres: 100.3 mm are meant" in page
    assert said(4, "report {} --no-pdf", run).out
    # commands that measure with it refuse it
    assert "looks like metres" in said(2, "detect {} --detector fused", metres).err


def test_exchanged_pictures_are_not_the_detectors_fault(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(ROOT / "tests" / "data" / "path_traced", tmp_path / "rec"))
    assert doubts_of(Recording(folder), load_calibration(folder / "calibration.toml")) == ()
    for frame in (one := sorted((folder / "frames").iterdir()))[-1:]:
        (frame / "left.png").rename(frame / "kept.png")
        (frame / "right.png").rename(frame / "left.png")
        (frame / "kept.png").rename(frame / "right.png")
    found = doubts_of(Recording(folder), load_calibration(folder / "calibration.toml"))
    why = f"frames/{one[-1].name}/left.png is exchanged with the right one: the calibration fits"
    assert why in "; ".join(found)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("image_size = [1360, 1024]->image_size = [1280, 960]", "left.png is 1360 x 1024 px (and 4 more), the calibration is for 1280 x 960"),
        ("-841.3102173->841.3102173", "10 of 10 visible ends have no place in the left picture, teat 1 of frame 0000"),
        ("[-100.317->[100.317", "100 mm to the left of the left one: left and right are exchanged"),
    ],
)  # fmt: skip
def test_sisters_of_it(change: str, why: str) -> None:
    path, (old, new) = recording().path / "calibration.toml", change.split("->")
    text = SHIPPED.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    found = doubts_of(recording(), load_calibration(path, doubtful=True))
    assert why in "; ".join(found)


def test_an_end_that_no_picture_can_show_is_truths_own(tmp_path: Path) -> None:
    """Hidden ends may lie anywhere; one visible end too far away is named."""
    made = recording()
    (made.path / "calibration.toml").write_text(
        SHIPPED.read_text(encoding="utf-8"), encoding="utf-8"
    )
    calibration = load_calibration(SHIPPED)
    far = Recording(made.path)
    for visible, count in ((False, 0), (True, 2)):
        far.truth = {"0001": (TruthRow("calm", "7", (-160.0, 99_000.0, 136.0), visible),)}
        found = doubts_of(far, calibration)
        assert len(found) == count
