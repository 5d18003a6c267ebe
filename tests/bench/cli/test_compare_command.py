"""`teatbench compare`: frames scored by a detector and by the same with a fault."""

from __future__ import annotations

import itertools
import json
import shutil
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
import pytest

from bench.config import ConfigError
from bench.record.reader import read_run
from bench.report.comparison import notes
from bench.report.wording import hints
from bench.results.comparison import compare_folders, scored_together
from bench.scoring.decisions import Verdict
from detector import registry
from detector.calibration import Calibration
from detector.external.serve import Pictures
from detector.protocol import Detection, Detector, Frames, Teat
from tests.bench.commands import Said, teatbench
from tests.bench.small_run import written_anew
from tests.plain_text import plain_text

pytestmark = pytest.mark.slow

SCENES = 3
WIDER = "UPDATE scores SET score = replace(score, '\"limit_mm\": 5.0', '\"limit_mm\": 9.0')"


class Faulted:
    """A detector with a fault: it takes the left picture for one moved by so many pixels."""

    def __init__(self, inner: Detector, fault_px: float) -> None:
        self._inner, self._fault_px = inner, fault_px
        self.name, self.version = inner.name, f"{inner.version}-faulted"
        self.parameters = {**inner.parameters, "fault_px": fault_px}

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        motion = np.array([[1.0, 0.0, self._fault_px], [0.0, 1.0, 0.0]])
        size = frames.left.shape[::-1]
        left = cv2.warpAffine(
            frames.left, motion, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )
        pictures = Pictures(left, frames.right, frames.thermal, frames.thermal_k)
        return self._inner.detect(pictures, calibration)


@pytest.fixture(scope="module", autouse=True)
def each_detection_takes_a_quarter_of_a_second() -> Iterator[None]:
    """Whatever the machine takes: the times of detections are judged too."""
    quarters = itertools.count(0.0, 0.25)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bench.results.answers.stopwatch_s", lambda: next(quarters))
        yield


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording") / "scenes"
    teatbench("scene record --situation ideal --seeds {} --out {}", SCENES, folder)
    return folder


@pytest.fixture(scope="module")
def baseline(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return score(recording, tmp_path_factory.mktemp("old"), "fused")


def score(recording: Path, out: Path, *detectors: str) -> Path:
    """Score the recording; the run's folder."""
    named = [word for name in detectors for word in ("--detector", name)]
    teatbench("score {} --out {} {}", recording, out, named)
    (folder,) = out.iterdir()
    return folder


def test_a_fault_of_a_fifth_of_a_pixel_turns_the_gate_red(
    recording: Path, baseline: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    create = registry.create
    monkeypatch.setattr(registry, "create", lambda name: Faulted(create(name), 0.2))
    new = score(recording, tmp_path, "fused")
    text = " ".join(said(1, "compare {} {} --gate", baseline, new).out.split())
    assert "THE NEW ONE IS WORSE" in text
    assert f"{SCENES} scenes, each in the very same frames." in text
    assert "the mean distance to the teat end grew by 1." in text
    assert teatbench("compare {} {}", baseline, new) == 0  # without --gate it only tells
    # nothing got worse, but three poses can't show that
    assert teatbench("compare {} {} --gate", new, baseline) == 4
    # who allows so much is told nothing red
    assert teatbench("compare {} {} --gate --margin-mm 5", baseline, new) != 1


def test_of_too_few_poses_the_gate_says_how_many_it_takes(
    baseline: Path, tmp_path: Path, said: Said
) -> None:
    again = changed(baseline, tmp_path / "again")
    text = " ".join(said(0, "compare {} {} --gate", baseline, again).out.split())
    assert "…" not in text
    assert (
        "identical answers in all 3 frame sets: nothing changed in these; of other poses at most"
        " 70.8 % have another answer" in text
    )
    text = " ".join(said(0, "compare {} {} --gate --margin-mm 4", baseline, again).out.split())
    assert (
        "The new one is not worse: no scene lost, no false or missed teat more over all poses the"
        " mean distance grew by at most" in text
    )
    assert (
        "at most 70.8 % of poses are lost anew (3 poses, 97.5 % confidence each, one-sided)" in text
    )


class Elsewhere:
    """A detector whose one end is nowhere near a teat, ``x_mm`` beside."""

    name, version = "elsewhere", "1"
    parameters: Mapping[str, object] = MappingProxyType({})

    def __init__(self, x_mm: float) -> None:
        self.x_mm = x_mm

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        return Detection((Teat(np.array([self.x_mm, 60.0, 400.0])),))


def test_other_answers_of_the_same_score_are_no_identical_answers(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    runs = []
    for name, x_mm in (("old", 0.0), ("new", 30.0), ("same", 30.0)):
        with monkeypatch.context() as patch:
            patch.setattr(registry, "create", lambda _, x_mm=x_mm: Elsewhere(x_mm))
            runs.append(score(recording, tmp_path / name, "fused"))
    old, new, same = runs
    assert "identical answers" not in said(4, "compare {} {} --gate", old, new).out
    assert "identical answers in all 3" in said(0, "compare {} {} --gate", new, same).out


@pytest.mark.weekly
def test_two_detectors_of_one_run_and_the_page(recording: Path, tmp_path: Path, said: Said) -> None:
    run = score(recording, tmp_path / "runs", "fused", "thesis")
    found = json.loads(said(1, "compare {} --gate --json --out {}", run, tmp_path / "page").out)
    (text,) = found["comparisons"]
    assert (text["old"]["detector"], text["new"]["detector"]) == ("fused", "thesis")
    assert text["gate"]["verdict"] == "worse"
    assert text["rows"][0]["scenes"] == text["same_frames"] == SCENES
    assert text["rows"][0]["success"]["only_old"] == SCENES
    page = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    assert "THE NEW ONE IS WORSE" in page
    assert '<span class="word-text">worse</span>' in page
    assert "passed and now fails" in page
    first = page[: page.index("<details>")]
    worse = f"thesis is worse than fused. Of {SCENES} poses fused got {SCENES} right"
    read = plain_text(first)
    assert worse in read
    assert f"in the report of {run.name}, before thesis is used" in read
    assert "how much farther thesis's points lie from the teat ends than fused's" in read
    assert "new one" not in read, "detectors of one run have names"
    assert all(f">{name}</span>" in first for name in list(hints("comparison"))[:-1]), (
        "one situation"
    )
    assert page.count("<details>") == 4  # the glossary is the last
    assert json.loads((tmp_path / "page" / "comparison.json").read_text(encoding="utf-8")) == found


def test_trials_without_a_counterpart_leave_the_gate_open_and_other_frames_are_told(
    baseline: Path, tmp_path: Path
) -> None:
    fewer = changed(baseline, tmp_path / "fewer", "DELETE FROM scores WHERE trial LIKE '001-%'")
    (found,) = compare_folders([baseline, fewer])
    assert (found.only_old, found.only_new, len(found.pairs)) == (1, 0, SCENES - 1)
    assert found.compared.gate.verdict is Verdict.INCONCLUSIVE
    assert teatbench("compare {} {} --gate", baseline, fewer) == 4
    other = changed(baseline, tmp_path / "other", other_frames=True)
    (found,) = compare_folders([baseline, other])
    assert (len(found.pairs), found.same_frames) == (SCENES, 0)


def changed(run: Path, to: Path, *statements: str, other_frames: bool = False) -> Path:
    """A copy of a run whose record says something else, as a bench would have written it."""
    shutil.copytree(run, to)
    for picture in to.rglob("frames/*/*.png") if other_frames else ():
        picture.write_bytes(picture.read_bytes() + b"other")
    with closing(sqlite3.connect(to / "run.sqlite")) as db:
        for statement in statements:
            db.execute(statement)
        db.commit()
    return written_anew(to)


def test_a_namesake_at_another_place_is_not_the_same_scene(
    baseline: Path, tmp_path: Path, said: Said
) -> None:
    def moved(name: str, by_mm: str) -> Path:
        statement = f"UPDATE truth SET x_mm = x_mm + {by_mm}"
        return changed(baseline, tmp_path / name, statement, other_frames=True)

    near, far = moved("near", "5"), moved("far", "25 WHERE trial LIKE '001-%'")
    assert len(compare_folders([baseline, near])[0].pairs) == SCENES
    (found,) = compare_folders([baseline, far])
    assert (len(found.pairs), found.only_old, found.elsewhere) == (SCENES - 1, 1, 1)
    text = " ".join(said(4, "compare {} {} --gate", baseline, far).out.split())
    assert "teats are elsewhere, and not compared: 1 trial of the old run." in text
    why = said(2, "compare {} {}", baseline, moved("nowhere", "25")).err
    assert f"{SCENES} have the same name, but their teats stood at other places" in why


def test_what_was_held_against_other_limits_is_not_compared(baseline: Path, tmp_path: Path) -> None:
    wider = changed(baseline, tmp_path / "wider", WIDER)
    with pytest.raises(ConfigError, match=r"different limits \(5 and 9 mm\).*by the same rules"):
        compare_folders([baseline, wider])
    slower = changed(baseline, tmp_path / "slower")
    rules = slower / "rules.toml"
    text = rules.read_text(encoding="utf-8").replace("time_limit_s = 2.0", "time_limit_s = 4.0")
    rules.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"different limits \(2 and 4 s\)"):
        compare_folders([baseline, slower])


def test_what_else_differs_is_reported(baseline: Path, tmp_path: Path) -> None:
    other = changed(
        baseline, tmp_path / "other", "UPDATE facts SET value = '\"emulated\"' WHERE key = 'kind'"
    )
    (found,) = compare_folders([baseline, other])
    assert "The runs also differ in kind: recorded (old), emulated (new)." in list(notes(found))
    assert "also differ" not in " ".join(notes(compare_folders([baseline, baseline])[0]))


def test_runs_are_judged_together_by_their_counts(
    baseline: Path, tmp_path: Path, said: Said
) -> None:
    again = changed(baseline, tmp_path / "again")
    together = scored_together([read_run(baseline), read_run(again)], "fused")
    # one recording scored twice is the same poses
    assert (together.success.trials, len(together.scores)) == (SCENES, 2 * SCENES)
    about = "UPDATE facts SET value = '\"another recording\"' WHERE key = 'about'"
    other = changed(baseline, tmp_path / "other", about)
    for second, poses in ((again, SCENES), (other, 2 * SCENES)):
        whole = json.loads(said(0, "compare {} {} --together --json", baseline, second).out)
        (text,) = whole["together"]
        counts = {one["n"] for one in text["decisions"] if one["unit"] in ("mm", "%", "")}
        assert counts == {poses}
    # six poses show little
    seen = said(4, "compare {} {} --together --gate", baseline, other).out
    assert "fused, all runs together: inconclusive" in seen
    assert f"0 in {2 * SCENES} scenes" in seen
    assert "of 6 poses succeeded" in seen


@pytest.mark.parametrize(
    ("others", "options", "says"),
    [
        ([], "", "name a second run"),
        ([], "--detector fusedd", 'did you mean "fused"'),
        (["empty"], "--gate", "no scored trial: 'teatbench runs' says how its run stands"),
        (["nowhere"], "", "is no run"),
        (["same"], "--detector thesis", "no detector of those named is in both runs"),
        (["wider"], "--together", "different limits"),
        (["wider"], "--together --detector thesis", "no detector of those named is in all runs"),
    ],
)
def test_what_cannot_be_compared(
    baseline: Path, others: list[str], options: str, says: str, tmp_path: Path, said: Said
) -> None:
    made = {"same": (), "wider": (WIDER,), "empty": ("DELETE FROM scores",)}
    runs = [
        changed(baseline, tmp_path / name, *made[name]) if name in made else tmp_path / name
        for name in others
    ]
    assert says in said(2, f"compare {{}} {{}} {options}", baseline, runs).err
