"""junit.xml of every ending, read by a library that others use and held against the attributes and
children that Jenkins' xunit plug-in allows (its junit-10.xsd), typed from there.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from junitparser import Error, JUnitXml, Skipped

from bench.record.check import NOT_AS_WRITTEN
from bench.record.reader import RunRecord
from bench.results.doubts import DOUBTS_FACT
from bench.results.exports import write_exports
from bench.results.status import INSTRUMENTS_FACT, status_of
from bench.results.verdicts import Judgement
from bench.scoring.decisions import Decision, Verdict

SUREFIRE_TIME = re.compile(r"(([0-9]{0,3},)*[0-9]{3}|[0-9]{0,3})*(\.[0-9]{0,3})?")
# element: required attributes, other attributes, children
SCHEMA: dict[str, tuple[set[str], set[str], set[str]]] = {
    "testsuites": (set(), {"name", "time", "tests", "failures", "errors"}, {"testsuite"}),
    "testsuite": (
        {"name", "tests", "failures", "errors"},
        {"group", "time", "skipped", "timestamp", "hostname", "id", "package"},
        {"testsuite", "properties", "testcase", "system-out", "system-err"},
    ),
    "testcase": (
        {"name"},
        {"time", "classname", "group"},
        {"skipped", "error", "failure", "system-out", "system-err"},
    ),
    **{kind: (set(), {"type", "message"}, set()) for kind in ("skipped", "error", "failure")},
}
FACTS: dict[str, Any] = {
    "title": "Quick",
    "detectors": ["fused", "thesis"],
    "planned": 18,
    "wall_started": "2026-11-26T22:00:00+00:00",
}


def event(kind: str, text: str) -> dict[str, Any]:
    return {"kind": kind, "text": text, "wall_time": "2026-11-26T22:01:30.250+00:00"}


def decision(name: str, verdict: Verdict) -> Decision:
    words = f"{name} in words"
    return Decision(name=name, verdict=verdict, limit=5.0, rule="the rule", sentence=words)


JUDGED = (
    Judgement("fused", (decision("error", Verdict.MET), decision("false", Verdict.NOT_MET))),
    Judgement("thesis", (decision("error", Verdict.INCONCLUSIVE),)),
)
HOT = {
    "name": "bath",
    "link": "closed",
    "safe": "failed",
    "how": "no answer",
    "by_hand": "SWITCH OFF THE BATH",
}
CHAINED = "the chain is broken at link 3"
ENDINGS = {
    "finished": (RunRecord(Path("run"), FACTS | {"ending": "finished"}), ""),
    "faulted": (
        RunRecord(
            Path("run"),
            FACTS | {"ending": "faulted"},
            events=(event("fault", "bath: no answer for 12 s."),),
        ),
        "The run was faulted after 0 of 18 trials: bath: no answer for 12 s.",
    ),
    "aborted": (
        RunRecord(Path("run"), FACTS | {"ending": "aborted"}, events=(event("aborted", "Ctrl-C"),)),
        "The run was aborted after 0 of 18 trials: Ctrl-C.",
    ),
    "interrupted": (
        RunRecord(Path("run"), FACTS),
        "The bench died before the run was over; 0 of 18 trials are kept.",
    ),
    "tripped": (
        RunRecord(
            Path("run"),
            FACTS | {"ending": "faulted", INSTRUMENTS_FACT: {"session": 1, "instruments": [HOT]}},
            events=(
                event("trip", "over-temperature: 36.10 degC"),
                event("fault", "over-temperature: 36.10 degC."),
            ),
        ),
        (
            "The run was tripped after 0 of 18 trials: over-temperature: 36.10"
            " degC.\nSWITCH OFF THE BATH: no answer"
        ),
    ),
    "running": (
        RunRecord(Path("run"), FACTS, holder={"pid": 1}),
        "The run goes on: trial 1 of 18. Nothing is decided before its end.",
    ),
    "damaged": (
        RunRecord(Path("run"), FACTS | {"ending": "finished"}, damage=(CHAINED,)),
        f"{NOT_AS_WRITTEN}, so that nothing is decided by it. {CHAINED}.",
    ),
    "a recording of another calibration": (
        RunRecord(Path("run"), FACTS | {"ending": "finished", DOUBTS_FACT: ["the rows differ"]}),
        (
            "The calibration can't be that of these pictures, so nothing is charged to any"
            " detector: the rows differ."
        ),
    ),
}


def written(run: RunRecord, judgements: tuple[Judgement, ...], folder: Path) -> Path:
    write_exports(run, status_of(run, judgements), judgements, folder)
    return folder / "junit.xml"


@pytest.mark.parametrize("judged", [(), JUDGED], ids=["nothing scored", "scored"])
@pytest.mark.parametrize("ending", ENDINGS)
def test_a_reader_of_it_alone_sees_how_the_run_ended(
    ending: str, judged: tuple[Judgement, ...], tmp_path: Path
) -> None:
    run, why = ENDINGS[ending]
    path = written(run, judged, tmp_path)
    suites = list(JUnitXml.fromfile(str(path)))
    assert [suite.name for suite in suites] == ["fused", "thesis"]
    for suite in suites:
        cases = list(suite)
        assert cases
        assert suite.tests == len(cases)
        errors = [case.name for case in cases if any(isinstance(r, Error) for r in case.result)]
        assert suite.errors == len(errors) == (1 if why else 0)
        assert suite.skipped == sum(isinstance(r, Skipped) for c in cases for r in c.result)
        if why:
            assert {r.message for case in cases for r in case.result} == {why}
            assert all(case.result for case in cases)  # nothing has passed
        if not judged and not why:
            assert suite.skipped == len(cases)
        if judged and not why:
            counted = suite.failures, suite.skipped
            assert counted == {"fused": (1, 0), "thesis": (0, 1)}[suite.name]
    # as Jenkins' plug-in takes it, with its times
    root = ET.parse(path).getroot()
    assert root.tag == "testsuites"
    for element in root.iter():
        required, others, children = SCHEMA[element.tag]
        assert required <= set(element.attrib) <= required | others, element.attrib
        assert {child.tag for child in element} <= children
        if element.tag.startswith("test"):
            assert SUREFIRE_TIME.fullmatch(element.attrib["time"])
    for element in root:
        assert element.attrib["timestamp"] == FACTS["wall_started"]
        of_cases = sum(float(one.attrib["time"]) for one in element)
        assert of_cases == pytest.approx(float(element.attrib["time"]), abs=0.01)
    took_s = 90.25 if run.events else 0.0
    assert float(root.attrib["time"]) == took_s


def test_suites_of_two_runs_that_began_in_one_second_are_two(tmp_path: Path) -> None:
    """Jenkins takes suites of one name, id and time stamp for one and drops the second."""
    run = ENDINGS["finished"][0]
    twins = run, replace(run, folder=Path("run-2")), replace(run, first_link="another chain")
    suites = [
        tuple(map(suite.attrib.get, ("name", "id", "timestamp")))
        for number, one in enumerate(twins)
        for suite in ET.parse(written(one, JUDGED, tmp_path / str(number))).getroot()
    ]
    assert len(set(suites)) == len(suites) == 6
