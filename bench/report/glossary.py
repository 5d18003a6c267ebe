"""The terms that reports and docs explain: one table. `python -m bench.report.glossary` writes
docs/glossary.md from it.
"""

from __future__ import annotations

from pathlib import Path

from reports.glossary import Term

TERMS = (
    Term(
        "acceptance limit",
        "A measured value up to here is accepted: the limit less the guard band.",
        ("accepted up to",),
    ),
    Term("apex", "The outermost point of the teat's rounded end, on the teat's own axis."),
    Term(
        "AP, RP, AD, RD",
        "Pose accuracy, pose repeatability, distance accuracy, distance repeatability of ISO 9283:"
        " how far the mean is off, and how far repeats scatter.",
        ("ISO 9283", "AP", "RP", "AD and RD"),
    ),
    Term("baseline run", "The older run that this one is compared with.", ("baseline",)),
    Term(
        "bias",
        "The mean error with its sign: what is left when chance has averaged out.",
    ),
    Term("calibration", "The cameras' lenses and places, as numbers, with what is known of them."),
    Term(
        "camera axes",
        "x across the picture, y down, z along the view (depth), of the right camera.",
        ("camera x", "camera y", "camera z"),
    ),
    Term(
        "carried truth",
        "A teat end touched once, then moved along by the stage's known motion.",
        ("carry", "carried"),
    ),
    Term(
        "confidence",
        "How often such a statement is right, when the test is done over and over.",
    ),
    Term(
        "confidence interval",
        "A range that holds the true value with the stated confidence. Few poses, wide range.",
        ("95 % interval", "intervals", "interval", "Clopper-Pearson"),
    ),
    Term(
        "covariance",
        "How unsure a point is in each direction, and which directions go together.",
        ("covariances", "stated covariances"),
    ),
    Term(
        "depth error",
        "The part of an error along the camera's view. A stereo pair is weakest there.",
        ("depth",),
    ),
    Term(
        "disparity",
        "By how many pixels left and right picture differ in a point's place; it tells the depth.",
    ),
    Term("drift", "A slow change over the time of the run."),
    Term(
        "ellipsoid",
        "A body that holds the next pose's error with 95 %; its longest axis is the worst"
        " direction.",
        ("ellipsoids", "95 % ellipsoids"),
    ),
    Term(
        "expanded uncertainty",
        "Twice the standard uncertainty: the true value is within ± this in about 95 of 100 cases.",
        ("k = 2",),
    ),
    Term("false teat", "An answer where there is no teat end.", ("false teats", "false answers")),
    Term(
        "frame set",
        "The left, right and thermal picture of one trial, taken together.",
        ("frame sets",),
    ),
    Term(
        "FRE",
        "Fiducial registration error: what the fit leaves at the points that were touched.",
    ),
    Term(
        "gage R&R",
        "How much of the scatter is the measuring itself: repeatability and reproducibility.",
        ("Gage R&R",),
    ),
    Term(
        "gate",
        "An answer counts for a teat end only within this distance: 25 mm, or half the least"
        " spacing of the ends.",
    ),
    Term(
        "GOSPA",
        "One number a scene, mm: distances of the found teats, with a charge for each missed and"
        " each false one.",
    ),
    Term(
        "guard band",
        "What is taken off a limit because the truth itself is not exactly known.",
    ),
    Term(
        "guardian",
        "A second program that puts the bath in standby when the bench itself can't.",
    ),
    Term(
        "hidden",
        "A teat end that a camera can't see. It counts as neither missed nor false.",
        ("hidden ends", "hidden count"),
    ),
    Term(
        "homography",
        "A map from picture to picture that is right for the points of one plane.",
        ("homographies", "Homographies"),
    ),
    Term("Hotelling's T²", "A test whether a mean error in three axes could be zero.", ("T²",)),
    Term("inconclusive", "The poses tried are too few to say met or not met."),
    Term(
        "interlock",
        "A rule that puts the bench in its safe state when a reading leaves its range.",
        ("interlocks",),
    ),
    Term("lateral error", "The part of an error across the camera's view.", ("lateral",)),
    Term(
        "limit",
        "The largest value that the requirement allows.",
    ),
    Term(
        "McNemar",
        "A test that looks only at the poses that one of two got right.",
        ("exact McNemar",),
    ),
    Term("measurand", "The quantity that is measured, defined in words.", ("Measurand",)),
    Term("missed", "A visible teat end without an answer within the gate."),
    Term(
        "nomination",
        "A place in the thermal picture that a detector takes for a teat, before it looks closer.",
        ("thermal nomination", "nominations", "nominated"),
    ),
    Term(
        "p-value",
        "How likely chance alone makes so large a difference. Below 0.05 it is taken as real.",
        ("p-values",),
    ),
    Term(
        "p95",
        "95 of 100 values are at or below it; p99: 99 of 100.",
        ("p99", "percentiles", "Percentiles"),
    ),
    Term(
        "pose",
        "One place and turn of the phantom. Repeats of a pose count once.",
        ("poses",),
    ),
    Term("precision, teats", "Of all answers, the share that are teat ends.", ("precision",)),
    Term(
        "radial error",
        "The distance from the answer to the teat end, in space.",
        ("Radial error", "radial errors"),
    ),
    Term("recall, teats", "Of all visible teat ends, the share that was found.", ("recall",)),
    Term(
        "refusal limit",
        "A measured value from here on is not met, whatever the truth's uncertainty.",
    ),
    Term(
        "registration",
        "The motion that takes positions of the stage to the world's axes.",
        ("Registration",),
    ),
    Term(
        "repeatability",
        "Scatter when nothing is changed between two tries. Its standard deviation is s_r.",
        ("s_r",),
    ),
    Term(
        "reproducibility",
        "Scatter when the set-up is made anew between two tries. Its standard deviation is s_R.",
        ("s_R",),
    ),
    Term(
        "reprojection error",
        "How far a point of the calibrated model lies from the same point in the picture, px.",
        ("Reprojection error", "residual"),
    ),
    Term("rms", "Root mean square: of errors, their size with bias and scatter together."),
    Term(
        "scene success",
        "Every visible teat end found within the limit, nothing false, and in time.",
    ),
    Term("sd", "Standard deviation: the size of the scatter about the mean."),
    Term("search region", "The part of a picture in which a detector looks for the end."),
    Term("set point", "The temperature that the bath is told to hold."),
    Term("situation", "A named kind of scene, such as overlapping teats.", ("situations",)),
    Term("stable", "The bath was within its band for the whole window before the capture."),
    Term(
        "standard uncertainty",
        "u: how unsure a value is, as one standard deviation.",
        ("standard uncertainties", "u"),
    ),
    Term("teat end", "What is measured: the apex of the teat's rounded end.", ("teat ends",)),
    Term(
        "tolerance limit",
        "A value that a stated share of all poses stays below, with the stated confidence.",
        ("Tolerance limits", "tolerance limits"),
    ),
    Term(
        "TRE",
        "Target registration error: how far a point is off that was not touched for the fit.",
        ("target error", "Expected target error"),
    ),
    Term("trend", "Errors that grow or shrink with place, time or temperature.", ("Trends",)),
    Term(
        "truth",
        "Where the teat ends are by the MicroScribe arm, or as the recording states.",
        ("ground truth",),
    ),
    Term(
        "uncertainty budget",
        "The list of what makes a value unsure, each with its share.",
        ("Uncertainty budget",),
    ),
    Term("world axes", "The table's: x to the right, y away from the cameras, z up.",
         ("world frame", "world x", "world y", "world z", "world's axes")),
)  # fmt: skip


def markdown() -> str:
    """docs/glossary.md."""
    rows = (f"| {term.name} | {term.says} |" for term in TERMS)
    return "\n".join(
        [
            "# Glossary",
            "",
            "What reports and these pages mean by a word. A report shows the same text when the",
            "pointer or the keyboard is on a term.",
            "",
            "| Term | Meaning |",
            "|---|---|",
            *rows,
            "",
        ]
    )


if __name__ == "__main__":
    page = Path(__file__).resolve().parents[2] / "docs" / "glossary.md"
    page.write_text(markdown(), encoding="utf-8", newline="\n")
