"""The terms that reports and docs explain: one table. `python -m bench.report.glossary` writes
docs/glossary.md from it.
"""

from __future__ import annotations

import re
from pathlib import Path

from reports.glossary import Term

# term | how else it is spelt in texts: what it means; an indented line goes on with it
TABLE = """
acceptance limit | accepted up to: A measured value up to here is accepted: the limit less the guard
  band.
apex: The outermost point of the teat's rounded end, on the teat's own axis.
AP, RP, AD, RD | ISO 9283 | AP | RP | AD and RD: Pose accuracy, pose repeatability, distance
  accuracy, distance repeatability of ISO 9283: how far the mean is off, and how far repeats
  scatter.
baseline run | baseline: The older run that this one is compared with.
bias: The mean error with its sign: what is left when chance has averaged out.
calibration: The cameras' lenses and places, as numbers, with what is known of them.
camera axes | camera x | camera y | camera z: x across the picture, y down, z along the view
  (depth), of the right camera.
carried truth | carry | carried: A teat end touched once, then moved along by the stage's known
  motion.
confidence: How often such a statement is right, when the test is done over and over.
confidence interval | 95 % interval | intervals | interval | Clopper-Pearson: A range that holds the
  true value with the stated confidence. Few poses, wide range.
covariance | covariances | stated covariances: How unsure a point is in each direction, and which
  directions go together.
depth error | depth: The part of an error along the camera's view. A stereo pair is weakest there.
disparity: By how many pixels left and right picture differ in a point's place; it gives the
  depth.
drift: A slow change over the time of the run.
ellipsoid | ellipsoids | 95 % ellipsoids: A body that holds the next pose's error with 95 %; its
  longest axis is the worst direction.
expanded uncertainty | k = 2: Twice the standard uncertainty: the true value is within ± this in
  about 95 of 100 cases.
false teat | false teats | false answers: An answer where there is no teat end.
frame set | frame sets: The left, right and thermal picture of one trial, taken together.
FRE: Fiducial registration error: what the fit leaves at the points that were touched.
gage R&R | Gage R&R: How much of the scatter is the measuring itself: repeatability and
  reproducibility.
gate: An answer counts for a teat end only within this distance: 25 mm, or half the least spacing of
  the ends.
GOSPA: One number a scene, mm: distances of the found teats, with a charge for each missed and each
  false one.
guard band: What is taken off a limit because the truth itself is not exactly known.
guardian: A second program that puts the bath in standby when the bench itself can't.
hidden | hidden ends | hidden count: A teat end that a camera can't see. It counts as neither missed
  nor false.
homography | homographies | Homographies: A map from picture to picture that is right for the points
  of one plane.
Hotelling's T² | T²: A test whether a mean error in three axes could be zero.
inconclusive: The poses tried are too few to say met or not met.
interlock | interlocks: A rule that puts the bench in its safe state when a reading leaves its
  range.
lateral error | lateral: The part of an error across the camera's view.
limit: The largest value that the requirement allows.
McNemar | exact McNemar: A test that looks only at the poses that one of two got right.
measurand | Measurand: The quantity that is measured, defined in words.
missed: A visible teat end without an answer within the gate.
nomination | thermal nomination | nominations | nominated: A place in the thermal picture that a
  detector takes for a teat, before it looks closer.
p-value | p-values: How likely chance alone makes so large a difference. Below 0.05 it is taken as
  real.
p95 | p99 | percentiles | Percentiles: 95 of 100 values are at or below it; p99: 99 of 100.
pose | poses: One place and turn of the phantom. Repeats of a pose count once.
precision, teats | precision: Of all answers, the share that are teat ends.
radial error | Radial error | radial errors: The distance from the answer to the teat end, in space.
recall, teats | recall: Of all visible teat ends, the share that was found.
refusal limit: A measured value from here on is not met, whatever the truth's uncertainty.
registration | Registration: The motion that takes positions of the stage to the world's axes.
repeatability | s_r: Scatter when nothing is changed between two tries. Its standard deviation is
  s_r.
reproducibility | s_R: Scatter when the set-up is made anew between two tries. Its standard
  deviation is s_R.
reprojection error | Reprojection error | residual: How far a point of the calibrated model lies
  from the same point in the picture, px.
rms: Root mean square: of errors, their size with bias and scatter together.
scene success: Every visible teat end found within the limit, nothing false, and in time.
sd: Standard deviation: the size of the scatter about the mean.
search region: The part of a picture in which a detector looks for the end.
set point: The temperature that the bath has to hold.
situation | situations: A named kind of scene, such as overlapping teats.
stable: The bath was within its band for the whole window before the capture.
standard uncertainty | standard uncertainties | u: u: how unsure a value is, as one standard
  deviation.
teat end | teat ends: What is measured: the apex of the teat's rounded end.
tolerance limit | Tolerance limits | tolerance limits: A value that a stated share of all poses
  stays below, with the stated confidence.
TRE | target error | Expected target error: Target registration error: how far a point is off that
  was not touched for the fit.
trend | Trends: Errors that grow or shrink with place, time or temperature.
truth | ground truth: Where the teat ends are by the MicroScribe arm, or as the recording states.
uncertainty budget | Uncertainty budget: The list of what makes a value unsure, each with its share.
world axes | world frame | world x | world y | world z | world's axes: The table's: x to the right,
  y away from the cameras, z up.
"""


def _terms() -> tuple[Term, ...]:
    lines = re.sub(r"\n +", " ", TABLE.strip()).splitlines()
    parts = (line.partition(": ") for line in lines)
    names = ((spelt.split(" | "), meaning) for spelt, _, meaning in parts)
    return tuple(Term(name, meaning, tuple(also)) for (name, *also), meaning in names)


TERMS = _terms()
HEAD = """# Glossary

What reports and these pages mean by a word. A report shows the same text when the
pointer or the keyboard is on a term.

| Term | Meaning |
|---|---|
"""


def markdown() -> str:
    """docs/glossary.md."""
    return HEAD + "".join(f"| {term.name} | {term.meaning} |\n" for term in TERMS)


if __name__ == "__main__":
    page = Path(__file__).resolve().parents[2] / "docs" / "glossary.md"
    page.write_text(markdown(), encoding="utf-8", newline="\n")
