"""A run, or a scored recording, beside what the thesis printed of the same tests, as Markdown:

    python docs/examples/thesis.py runs/RUN

`thesis.toml` has the figures as printed, each with its section and what is wrong in it;
`thesis_pictures.py` measures in pictures, `thesis_geometry.py` has the plane map and the rig. The
thesis judged one picture a situation by eye. Here a teat is found when an answer lies within the
gate of its end; "as many" are the frame sets with at least the thesis's share of visible teats.
"""

import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from thesis_geometry import plane, rig
from thesis_pictures import COUNTS, DISTANCES, by_teat, counted, pictured

import bench
from detector import load_calibration
from instruments import spoken

FIGURES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
PRINTED = {one["name"]: one for one in FIGURES["situations"]}
LAYOUT, PLANE = "table-5-1", "plane_map"  # whose ends those of test 1 are; the map's situation
COLUMNS = ("figure", "section", "printed", "by its tables", "this run", "wrong, or to be known")
ELSEWHERE = ("section", "what", "printed", "where")
# of errors (n, 3): what is worked out, how, and the name of what the thesis printed of it
STATISTICS: Sequence[tuple[str, Callable[[Any], Any], str]] = (
    ("mean of the signed components: its “average error”", np.mean, "average_mm"),
    ("mean of the components' amounts: that of test 2", lambda e: np.abs(e).mean(), ""),
    ("largest component: its “maximum error”", lambda e: np.abs(e).max(), "largest_mm"),
    ("mean distance to the teat end", lambda e: np.linalg.norm(e, axis=1).mean(), ""),
    ("largest distance to the teat end", lambda e: np.linalg.norm(e, axis=1).max(), ""),
)
Row = Iterable[object]  # of a table
Groups = Mapping[str, Sequence[str]]  # situations by the title of their row


def printed(names: Sequence[str]) -> str:
    """How many teats the thesis found in these situations."""
    found, present = (sum(PRINTED[name][of] for name in names) for of in ("found", "present"))
    return f"{found} of {present}"


def situations(trials: Sequence[Any], detector: str, groups: Groups) -> Iterator[Row]:
    """Teats found of the visible ones."""
    for title, names in groups.items():
        here = [one for one in trials if one.head["situation"] in names]
        each = [(PRINTED[one.head["situation"]], one.scores[detector].counts) for one in here]
        found, visible, false = (
            sum(getattr(of, what) for _, of in each) for what in ("matched", "visible", "false")
        )
        many = sum(of.matched * one["present"] >= one["found"] * of.visible for one, of in each)
        ours = f"{found} of {visible}, {false} false; as many in {many} of {len(each)}"
        one = PRINTED[names[0]] if title == spoken(names[0]) else {"section": "5.2", "seen": ""}
        yield f"teats found, {title}", one["section"], printed(names), "", ours, one["seen"]


def first_test(trials: Sequence[Any], detector: str) -> Iterator[Row]:
    """Test 1, whose points were picked by hand, beside a detector's errors at the same ends."""
    test = FIGURES["test_1"]
    theirs = np.subtract(test["triangulated_mm"], test["measured_mm"])
    ours = np.concatenate([np.empty((0, 3)), *(one.scores[detector].errors_mm for one in trials)])
    for what, figure, key in STATISTICS:
        form, said = ("+z.2f" if figure is np.mean else ".2f"), f"{test[key]:g} mm" if key else ""
        values = [
            f"{figure(errors):{form}} mm (n = {len(errors)})" if len(errors) else "not measured"
            for errors in (theirs, ours)
        ]
        wrong = test["wrong"] if key == "average_mm" else ""
        yield f"test 1: {what}", test["section"], said, *values, wrong


def asked(run: bench.RunRecord, trials: Sequence[Any], detector: str) -> Iterator[Row]:
    """What the thesis asked of a detector."""
    theirs = FIGURES["asked"]
    far = [mm for one in trials for mm in one.scores[detector].radial_mm]
    said = f"below {theirs['error_mm']:g} mm asked; none measured"
    ours = f"{max(far):.2f} mm" if far else "not measured"
    yield "largest error", theirs["section"], said, "", ours, theirs["wrong_error"]
    poses: dict[str, bool] = {}
    for one in trials:
        poses[one.pose] = poses.get(one.pose, True) and one.scores[detector].success
    good, of = sum(poses.values()), len(poses)
    ours = f"{good} of {of} poses succeeded ({good / of:.1%})" if of else "not measured"
    said = f"“100 % or near” asked; {printed([*PRINTED])} teats found in section 5.2"
    yield "reliability", theirs["section"], said, "", ours, theirs["wrong_reliability"]
    calls = (row for one in run.counted for row in one.detections if row["detector"] == detector)
    timed = (row for row in calls if row["outcome"] in ("answered", "timeout"))
    seconds = [row["wall_seconds"] for row in timed if not row["cold"]]
    said = "{:g} s, at most {:g} s asked; none measured".format(*theirs["time_s"])
    ours = "not measured"
    if seconds:
        p95_s = np.percentile(seconds, 95, method="inverted_cdf")
        ours = f"p95 {p95_s:.3f} s, longest {max(seconds):.3f} s"
    yield "time of a detection", theirs["section"], said, "", ours, theirs["wrong_time"]


def figures(run: bench.RunRecord, detector: str, groups: Groups) -> Iterator[Row]:
    """Of a detector: what the run has of the thesis's tests, and what was asked."""
    trials = [one for one in run.counted if detector in one.scores]
    yield from situations(trials, detector, groups)
    script = run.folder / "script.toml"  # a recording has none
    planned = tomllib.loads(script.read_text("utf-8"))["trials"] if script.exists() else []
    others = {one["situation"] for one in planned if one.get("layout") != LAYOUT}
    if groups and (same := {one["situation"] for one in planned} - others):
        yield from first_test([t for t in trials if t.head["situation"] in same], detector)
    if flat := [one for one in trials if one.head["situation"] == PLANE]:
        yield from plane(flat, detector, FIGURES["earlier_system"])
    yield from asked(run, trials, detector)


def table(title: str, columns: Sequence[str], rows: Iterable[Row]) -> None:
    """Print it as Markdown."""
    print(f"\n{title}\n\n| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    for row in rows:
        print(f"| {' | '.join(map(str, row))} |")


def main(folder: Path) -> None:
    """Print the tables of a run: of each detector, then of the rig, then of what has none."""
    run, calibration = bench.read_run(folder), load_calibration(folder / "calibration.toml")
    if not run.trials:
        print(f"{folder} has no trials: nothing was measured.", file=sys.stderr)
        sys.exit(4)
    there = {one.head["situation"] for one in run.trials}
    known = [name for name in PRINTED if name in there]
    groups = {spoken(one): [one] for one in known} | ({f"all {len(known)}": known} if known else {})
    for detector in run.detectors:
        table(f"## The thesis and {detector}", COLUMNS, figures(run, detector, groups))
        trials = [one for one in run.counted if one.head["situation"] in known]
        if found := [one for trial in trials if (one := pictured(trial, detector, calibration))]:
            rows = (
                (title, printed(names), *counted([one for one in found if one.situation in names]))
                for title, names in groups.items()
            )
            table("Ends found in the pictures, as the thesis judged them:", COUNTS, rows)
            table("Refined against unrefined ends, medians:", DISTANCES, by_teat(found))
    table("## The thesis and the rig", COLUMNS, rig(run, calibration, FIGURES))
    shown = {*(["situations"] if known else []), *(["plane"] if PLANE in there else [])}
    rest = [one for one in FIGURES["elsewhere"] if not shown & {*one["shown"]}]
    table("## Without a counterpart here", ELSEWHERE, ([one[k] for k in ELSEWHERE] for one in rest))


if __name__ == "__main__":
    with bench.program(__doc__, Path) as (folder,):
        main(folder)
