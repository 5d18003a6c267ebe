"""A small but complete page with its images, for the tests and for looking at: six situations, four
requirements, every kind of part.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from reports.figures.course import bath_curve, found_bars, latency_strip
from reports.figures.errors import error_histogram, error_scatter, per_axis_errors
from reports.frames import Circle, Cross, ImageView, Label, Overlay, Polyline, Rect
from reports.page import (
    Banner,
    Cell,
    Code,
    Column,
    Figure,
    KeyValues,
    Notes,
    Page,
    Paragraph,
    Requirement,
    Requirements,
    Result,
    Section,
    Table,
    Tone,
    TrialPart,
    Verdict,
)

SITUATIONS = (
    "Not vertical",
    "Overlapping",
    "Spurious teat",
    "Hot body at the base",
    "Hot body at the ends",
    "Cooler bodies",
)
THESIS_FOUND = (4, 3, 4, 4, 0, 3)
ENDS_PX = ((190.0, 250.0), (285.0, 215.0), (380.0, 255.0), (470.0, 225.0))
SIZE = (640, 480)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the sample says of one trial."""

    number: int
    situation: str
    errors_mm: NDArray[np.float64]  # (found, 3)
    seconds: float

    @property
    def anchor(self) -> str:
        return f"trial-{self.number:03}"


def outcomes(repeats: int) -> list[Outcome]:
    rng = np.random.default_rng(20)
    return [
        Outcome(
            1 + k * repeats + repeat,
            situation,
            rng.normal((0.2, -0.4, 0.1), (0.7, 1.9, 0.6), (found, 3)),
            float(rng.uniform(0.3, 0.7)),
        )
        for k, (situation, found) in enumerate(zip(SITUATIONS, THESIS_FOUND, strict=True))
        for repeat in range(repeats)
    ]


@cache
def frames() -> dict[str, bytes]:
    """A PNG a camera, 640 x 480: four pale teats on a dark ground."""
    files = {}
    for number, camera in enumerate(("left", "right", "thermal")):
        picture = np.full((SIZE[1], SIZE[0]), 40 + 15 * number, np.uint8)
        for x, y in ENDS_PX:
            middle, pale = (int(x) + 4 * number, int(y) - 60), 190 - 30 * number
            cv2.ellipse(picture, (middle, (44, 124), 0), pale, -1, cv2.LINE_AA)
        encoded = cv2.imencode(".png", cv2.GaussianBlur(picture, (0, 0), 1.5))[1]
        files[f"{camera}.png"] = encoded.tobytes()
    return files


def frame_views(anchor: str) -> tuple[ImageView, ...]:
    ends = list(enumerate(ENDS_PX, 1))
    rings = tuple(Circle(x, y, 9, title=f"teat {k}") for k, (x, y) in ends)
    final = tuple(Cross(x + 2, y - 1, 9, turned=True) for x, y in ENDS_PX)
    searched = tuple(Rect(x - 20.5, y - 20.5, 41, 41) for x, y in ENDS_PX)
    warm = tuple(Cross(x - 6, y + 5, 8) for x, y in ENDS_PX)
    numbers = tuple(Label(x + 14, y + 14, str(k)) for k, (x, y) in ends)
    both = (Overlay("truth", "truth", rings), Overlay("nomination", "thermal nomination", warm))
    optical = (
        *both,
        Overlay("region", "region searched", searched),
        Overlay("point", "final point", final),
        Overlay("other", "numbers", numbers),
    )
    line = Overlay("model", "lower edge", (Polyline(ENDS_PX, title="lower edge"),))
    left, right, thermal = (f"frames/{anchor}/{file}" for file in frames())
    warm_label, part = "Thermal camera, un-mirrored", (140, 100, 400, 240)
    return (
        ImageView("Left camera", left, *SIZE, "Four teats from the left", optical, part),
        ImageView("Right camera", right, *SIZE, "Four teats from the right", optical, part),
        ImageView(warm_label, thermal, *SIZE, "Four warm teats", (*both, line)),
    )


def columns(*heads: tuple[str, str]) -> tuple[Column, ...]:
    """The first to the left, the others with their units to the right."""
    return tuple(
        Column(title, "right" if at else "left", unit) for at, (title, unit) in enumerate(heads)
    )


def trial_part(outcome: Outcome) -> TrialPart:
    radial = np.linalg.norm(outcome.errors_mm, axis=1)
    rows: list[tuple[str | Cell, ...]] = []
    for k, (error, r) in enumerate(zip(outcome.errors_mm, radial, strict=True), 1):
        axes = (f"{value:+.2f}".replace("-", "−") for value in error)
        rows.append((f"teat {k}", *axes, Cell(f"{r:.2f}", "bad" if r > 5 else "plain")))
    found = len(rows)
    refused = "The detector refused: no vertical line ends in the thermal image."
    measured = ((axis, "mm") for axis in ("x error", "y error", "z error", "radial"))
    tone: Tone = "bad" if not found else "warn" if found < 4 else "good"
    return TrialPart(
        id=outcome.anchor,
        heading=f"Trial {outcome.number}",
        situation=outcome.situation,
        results=(Result(f"{found} of 4 found", tone),),
        summary=(
            ("Found, missed, false", f"{found}, {4 - found}, 0"),
            ("Time", f"{outcome.seconds:.3f} s"),
        ),
        images=frame_views(outcome.anchor),
        tables=(Table("Errors of the teats found", columns(("teat", ""), *measured), tuple(rows)),),
        notes=() if rows else (refused,),
    )


def trial_table(runs: list[Outcome]) -> Table:
    rows = []
    for run in runs:
        link, far = Cell(run.anchor, href=f"#{run.anchor}"), np.linalg.norm(run.errors_mm, axis=1)
        found = Cell(f"{len(far)} of 4", "good" if len(far) == 4 else "warn", sort=len(far))
        worst = Cell(f"{far.max():.2f}") if len(far) else Cell("not measured", "muted")
        rows.append((link, run.situation, found, worst, f"{run.seconds:.3f}"))
    measured = columns(("Trial", ""), ("Found", ""), ("Worst error", "mm"), ("Time", "s"))
    heads = (measured[0], Column("Situation"), *measured[1:])
    note = "Click a column's title to sort."
    return Table("Every trial", heads, tuple(rows), note, searchable=True)


def requirements() -> Requirements:
    source = "thesis, section 1.4.3"
    radial = "Largest of n poses at most 4.611 mm (limit less the guard band, u = 0.23 mm)"
    rate = "Success rate of at least 95 % shown with 95 % confidence (Clopper-Pearson)"
    few, many = "3.92 mm (at most 4.31 mm)", "50.0 % (at most 70.8 %)"
    rows: list[tuple[str, str, int, str, str, str, Verdict, str]] = [
        ("Radial error below 5 mm", radial, 15, few, "5 mm", "+0.69 mm", "inconclusive", source),
        ("Every visible teat found", rate, 18, many, "95 %", "−45.0 %", "not met", source),
        ("Detection in 1 s", "p95 of the times", 18, "0.71 s", "1 s", "+0.29 s", "met", ""),
    ]
    return Requirements(
        "Requirements, fixed in the script before the run",
        tuple(Requirement(*row) for row in rows),
        "Frames of one pose are not independent trials: n counts poses.",
    )


def accuracy_section(runs: list[Outcome]) -> Section:
    errors = np.concatenate([run.errors_mm for run in runs])
    by_situation = [
        np.concatenate([run.errors_mm for run in runs if run.situation == name])
        for name in SITUATIONS
    ]
    links = [f"#{run.anchor}" for run in runs for _ in run.errors_mm]
    scatter = error_scatter(errors[:, 0], errors[:, 1], 5.0, accept_mm=4.611, links=links)
    histogram = error_histogram(np.linalg.norm(errors, axis=1), 5.0, accept_mm=4.611)
    strips = per_axis_errors(SITUATIONS, by_situation, 5.0)
    parts = (
        Figure(scatter, "Teats found; a click opens the trial.", "Lateral and depth errors"),
        Figure(histogram, "Radial errors and their share.", "Histogram of the radial errors"),
        Figure(strips, "Signed errors, world axes.", "Errors by axis", wide=True),
    )
    return Section("accuracy", "Accuracy", parts)


def rates_section(runs: list[Outcome]) -> Section:
    of = {name: [run for run in runs if run.situation == name] for name in SITUATIONS}
    found = [sum(len(run.errors_mm) for run in mine) for mine in of.values()]
    present = [4 * len(mine) for mine in of.values()]
    bars = found_bars(SITUATIONS, found, present, THESIS_FOUND)
    strip = latency_strip([run.seconds for run in runs], [1.0, 2.0])
    rows = tuple(
        (name, f"{f} of {p}", str(t))
        for name, f, p, t in zip(SITUATIONS, found, present, THESIS_FOUND, strict=True)
    )
    heads = columns(("Situation", ""), ("Found", "of visible"), ("Thesis", "of 4"))
    parts = (
        Figure(bars, "Teats found of teats visible.", "Bars of the share found"),
        Figure(strip, "Detection times against the limits.", "All detection times below 1 s"),
        Table("Found of present", heads, rows),
    )
    return Section("rates", "Rates, beside the thesis", parts)


def bath_section() -> Section:
    times = np.arange(0.0, 3600.0, 10.0)
    temps = 33.0 - 13.0 * np.exp(-times / 350.0) + 0.02 * np.sin(times / 70.0)
    captures = np.arange(2400.0, 3500.0, 60.0)
    svg = bath_curve(times, temps, 33.0, 0.1, captures, [(2300.0, 3600.0)])
    return Section("bath", "Bath", (Figure(svg, "Bath, captures marked.", "33 °C", wide=True),))


def provenance_section() -> Section:
    entries = (("Seed", "20260101"), ("Calibration", Cell("sha256:5f1d0a77c9e2", mono=True)))
    files = (
        ("Trials as CSV", Cell("trials.csv", href="trials.csv")),
        ("Run as JSON", Cell("run.json", href="run.json")),
    )
    command = "teatbench run six-situations --rig emulated --seed 20260101"
    parts = (
        KeyValues("Item and bench", entries),
        KeyValues("Files", files),
        Code("The command that repeats it", command),
        Notes("Deviations", ("Trial 13: the detector refused.", "The stage was homed twice.")),
        Notes("Exclusions", ()),
        Paragraph("The truth is the apex of the teat's rounded end on its own axis.", "info"),
    )
    return Section("provenance", "Provenance", parts)


def sample_page(folder: Path, repeats: int = 1) -> Page:
    """The page; its images are written into `folder`."""
    page = _page(repeats)
    for trial in page.trials:
        (folder / "frames" / trial.id).mkdir(parents=True)
        for name, data in frames().items():
            (folder / "frames" / trial.id / name).write_bytes(data)
    return page


@cache
def _page(repeats: int) -> Page:
    runs = outcomes(repeats)
    banner = Banner(
        "emulated",
        "not met",
        f"Detector thesis 1.0 on the thesis's six situations, {repeats} of each: {len(runs)} poses"
        " of the heated phantom, 4 teats each.",
        "9 of 18 scenes had every visible teat found; the requirement is 95 %. No teat's end was"
        " found where a hot body touched it.",
        "A success rate between 26 % and 74 % is shown with 95 % confidence; truth is known to"
        " 0.23 mm.",
        "Look at the trials of “Hot body at the ends” first: the detector refuses all of them.",
    )
    return Page(
        "Six situations",
        "Thesis detector on the emulated rig, 3 January 2026, run 20260103-1015-six-situations",
        banner,
        (
            Section("requirements", "Requirements", (requirements(),)),
            Section("trial-list", "Trials", (trial_table(runs),)),
            rates_section(runs),
            accuracy_section(runs),
            bath_section(),
            provenance_section(),
        ),
        tuple(trial_part(run) for run in runs),
        trials_note=(
            "What was seen, what was found, and where the truth is. Trials are data; the verdict is"
            " above."
        ),
        footer=("teatbench 0.1.0, run 20260103-1015-six-situations",),
    )
