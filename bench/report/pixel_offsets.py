"""The sensitivity test: its run folder and its report, what each known pixel offset does to a known
point, beside what the thesis printed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bench import __version__
from bench.config import ConfigError, read_calibration, read_text
from bench.files import write_synced
from bench.record.schema import SCRIPT
from bench.record.writer import new_run_folder
from bench.report.thesis import (
    components_table,
    elsewhere_table,
    first_test_table,
    second_test_table,
)
from bench.results.thesis_figures import Thesis, thesis
from bench.rig.loading import LoadedRig
from bench.script.pixel_offsets import (
    LoadedOffsets,
    Offset,
    Outcome,
    is_offset_script,
    load_offsets,
    outcomes,
)
from instruments.clock import wall_time
from reports.figures import error_histogram
from reports.page import Banner, Page, Section
from reports.parts import (
    Figure,
    Paragraph,
    Part,
    Requirement,
    Requirements,
    Table,
    Verdict,
    columns,
)
from reports.render import write_report

NOT_SAID = "not printed"


def offset_verdict(loaded: LoadedOffsets, found: Sequence[Outcome]) -> Verdict:
    """Met where no direction of any offset leads beyond the limit."""
    return "met" if all(one.worst_mm <= loaded.script.limit_mm for one in found) else "not met"


def offset_page(loaded: LoadedOffsets, found: Sequence[Outcome], calibration_sha256: str) -> Page:
    """The whole report."""
    script = loaded.script
    sections = (
        Section("requirements", "Requirements", (_requirements(loaded, found),)),
        Section(
            "results", "What the offsets do", (_table(loaded, found), *_figures(loaded, found))
        ),
        Section("published", "Beside the thesis", tuple(_published(loaded, found))),
        Section("provenance", "How it was done", tuple(_method(loaded, calibration_sha256))),
    )
    return Page(
        script.title,
        script.about,
        _banner(loaded, found),
        sections,
        footer=(f"teatbench {__version__}",),
    )


def _banner(loaded: LoadedOffsets, found: Sequence[Outcome]) -> Banner:
    verdict, limit = offset_verdict(loaded, found), loaded.script.limit_mm
    worst = max(found, key=lambda one: one.worst_mm)
    tried = sum(len(one.errors_mm) for one in found)
    return Banner(
        kind="computed",
        verdict=verdict,
        tested=(
            f"{loaded.script.title}: {len(found)} offsets of known points, {tried} directions in"
            " all."
        ),
        sentence=(
            f"{offset_told(worst.offset)} moves teat {worst.offset.teat} by up to"
            f" {worst.worst_mm:.1f} mm; the limit is {limit:g} mm."
        ),
        confidence="Computed from the calibration alone: no noise, no chance, nothing to repeat.",
        next_action=(
            "Choose longer lenses, a wider base, or a detector that picks to a fraction of a pixel."
            if verdict == "not met"
            else "A picking error of this size is no reason to change the cameras."
        ),
    )


def _requirements(loaded: LoadedOffsets, found: Sequence[Outcome]) -> Requirements:
    limit = loaded.script.limit_mm
    rows = [
        Requirement(
            name=f"teat {one.offset.teat}, {offset_told(one.offset)}",
            rule="the largest error of all directions is at most the limit",
            n=len(one.errors_mm),
            measured=f"{one.worst_mm:.2f} mm",
            limit=f"{limit:g} mm",
            margin=f"{limit - one.worst_mm:+.2f} mm",
            verdict="met" if one.worst_mm <= limit else "not met",
            source=loaded.script.source,
        )
        for one in found
    ]
    return Requirements("Error below the limit, whatever the direction of the offset", tuple(rows))


def _table(loaded: LoadedOffsets, found: Sequence[Outcome]) -> Table:
    limit = loaded.script.limit_mm
    heads = columns(
        ">teat | offset | >directions | >least [mm] | >median [mm] | >most [mm]",
        f">most along x [mm] | >along y [mm] | >along z [mm] | >above {limit:g} mm",
    )
    rows = []
    for one in found:
        far = one.distances_mm
        figures = (far.min(), np.median(far), far.max(), *one.most_mm)
        above = f"{int((far > limit).sum())} of {len(far)}"
        rows.append(
            (
                str(one.offset.teat),
                offset_told(one.offset),
                str(len(far)),
                *(f"{value:.2f}" for value in figures),
                above,
            )
        )
    return Table(
        "Errors over all directions, world frame",
        heads,
        tuple(rows),
        "Each axis in its own worst direction.",
    )


def _figures(loaded: LoadedOffsets, found: Sequence[Outcome]) -> Iterator[Figure]:
    for number, one in enumerate(found, 1):
        within = int((one.distances_mm <= loaded.script.limit_mm).sum())
        svg = error_histogram(one.distances_mm, loaded.script.limit_mm, name=f"offset-{number}")
        yield Figure(
            svg,
            f"Teat {one.offset.teat}, {offset_told(one.offset)}: error over all directions",
            f"{within} of {len(one.distances_mm)} within",
        )


def _published(loaded: LoadedOffsets, found: Sequence[Outcome]) -> Iterator[Part]:
    figures = thesis()
    heads = columns(
        ">teat | offset | >published: x, y, z [mm] | >most possible: x, y, z [mm]",
        ">published against the truth [mm] | beyond every direction",
    )
    rows = [_published_row(loaded, one) for one in found]
    note = (
        "Published: the point with the offset less the point without, both as printed. Most"
        " possible: each axis in its worst direction."
    )
    yield Table("The thesis's figures", heads, tuple(rows), note)
    beyond = [one.offset.teat for one in found if beyond_axes(one)]
    if beyond:
        teats = ", ".join(str(teat) for teat in beyond)
        yield Paragraph(
            f"For teat {teats} no direction of the stated offset gives what was printed, under this"
            " calibration; other causes than the offset must have been in those figures.",
            tone="info",
        )
    if _of_thesis(loaded, figures):
        yield second_test_table(figures, found)
        yield first_test_table(figures, {})
        yield components_table(figures)
        yield _one_pixel(figures, found)
        yield elsewhere_table(figures, "offsets")


def _of_thesis(loaded: LoadedOffsets, figures: Thesis) -> bool:
    """Whether the script's offsets are of the thesis's own printed ends, all of them."""
    return (
        tuple(one.published_mm for one in loaded.script.offsets) == figures.test_2.triangulated_mm
    )


def _one_pixel(figures: Thesis, found: Sequence[Outcome]) -> Table:
    """Section 6.1's figure beside every offset of one pixel in one picture."""
    one = [
        outcome
        for outcome in found
        if {outcome.offset.left_px, outcome.offset.right_px} == {0.0, 1.0}
    ]
    heads = columns("figure | section | >thesis [mm] | >median [mm] | >most [mm]")
    rows = tuple(
        (
            f"teat {outcome.offset.teat}, {offset_told(outcome.offset)}",
            figures.one_pixel.section,
            f"{figures.one_pixel.error_mm:g}",
            f"{outcome.median_mm:.2f}",
            f"{outcome.worst_mm:.2f}",
        )
        for outcome in one
    )
    return Table(
        "What one pixel is worth, over all directions", heads, rows, figures.one_pixel.wrong
    )


def _published_row(loaded: LoadedOffsets, one: Outcome) -> tuple[str, ...]:
    moved, end = published_move_mm(one.offset), one.offset.published_mm
    against = (
        NOT_SAID
        if end is None
        else f"{float(np.linalg.norm(np.subtract(end, loaded.points_mm[one.offset.teat - 1]))):.2f}"
    )
    printed = NOT_SAID if moved is None else ", ".join(f"{value:+.1f}" for value in moved)
    possible = ", ".join(f"{value:.1f}" for value in one.most_mm)
    return (
        str(one.offset.teat),
        offset_told(one.offset),
        printed,
        possible,
        against,
        ", ".join(beyond_axes(one)) or "no",
    )


def _method(loaded: LoadedOffsets, calibration_sha256: str) -> Iterator[Part]:
    yield Paragraph(
        "Each known point is projected into both pictures, its pixels are put off, and the pair is"
        " triangulated with the same calibration: what differs is the offset's doing alone. All"
        " directions are tried, since the thesis doesn't state its own."
    )
    heads = columns("what | value")
    rows = (
        ("layout", loaded.layout.name),
        ("directions a picture", str(loaded.script.directions)),
        ("calibration SHA-256", calibration_sha256),
        ("script", loaded.path.name),
    )
    yield Table("Inputs", heads, rows)


def published_move_mm(offset: Offset) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]] | None:
    """What the printed offset moved the printed point by, (3,) mm; None where not stated."""
    if offset.published_mm is None or offset.published_plain_mm is None:
        return None
    return np.subtract(offset.published_mm, offset.published_plain_mm)


def beyond_axes(one: Outcome) -> list[str]:
    """The axes along which the printed move is more than any direction gives."""
    moved = published_move_mm(one.offset)
    if moved is None:
        return []
    return [
        axis
        for axis, value, most in zip("xyz", np.abs(moved), one.most_mm, strict=True)
        if value > most
    ]


def offset_told(offset: Offset) -> str:
    """``1 px left and 1 px right``."""
    parts = [
        f"{px:g} px {name}"
        for name, px in (("left", offset.left_px), ("right", offset.right_px))
        if px
    ]
    return " and ".join(parts)


CALIBRATION, REPORT = "calibration.toml", "report"


def is_offset_run(folder: Path) -> bool:
    """Whether ``folder`` is that of a sensitivity script's run."""
    return (folder / SCRIPT).is_file() and is_offset_script(folder / SCRIPT)


def run_offsets(rig: LoadedRig, path: Path, out: Path) -> Path:
    """Run the script on the rig's calibration; return the run's folder. Raises ConfigError."""
    loaded = load_offsets(path)
    outcomes(loaded, rig.calibration)  # what can't be computed is told before there is a folder
    files = {
        SCRIPT: loaded.text,
        "rig.toml": rig.text,
        CALIBRATION: read_text(rig.calibration_path),
    }
    if loaded.script.layout.endswith(".toml"):
        files[loaded.script.layout] = read_text(path.parent / loaded.script.layout)
    try:
        folder = new_run_folder(out, path.name.removesuffix(".toml"), wall_time())
        folder.mkdir(parents=True)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise ConfigError.plain(
            f"a run can't be kept in {out}: {error.strerror or error}. Name another folder with"
            " --out."
        ) from error
    return folder


def report_offsets(folder: Path) -> tuple[Path, LoadedOffsets, tuple[Outcome, ...], Verdict]:
    """(Re)write the report of such a run; return its path and results. Raises ConfigError."""
    loaded = load_offsets(folder / SCRIPT)
    found = outcomes(loaded, read_calibration(folder / CALIBRATION))
    digest = hashlib.sha256((folder / CALIBRATION).read_bytes()).hexdigest()
    path = write_report(offset_page(loaded, found, digest), folder / REPORT)
    verdict = offset_verdict(loaded, found)
    write_synced(folder / REPORT / "run.json", _json(loaded, found, verdict, digest).encode())
    return path, loaded, found, verdict


def _json(
    loaded: LoadedOffsets, found: Sequence[Outcome], verdict: Verdict, calibration_sha256: str
) -> str:
    rows = [
        {
            **one.offset.model_dump(),
            "directions": len(one.errors_mm),
            "least_mm": float(one.distances_mm.min()),
            "median_mm": one.median_mm,
            "most_mm": one.worst_mm,
            "most_along_axes_mm": one.most_mm.tolist(),
        }
        for one in found
    ]
    whole = {
        "title": loaded.script.title,
        "verdict": verdict,
        "limit_mm": loaded.script.limit_mm,
        "calibration_sha256": calibration_sha256,
    }
    return json.dumps({**whole, "offsets": rows}, indent=1)
