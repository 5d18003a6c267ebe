"""The sensitivity test's run folder and report: what each known pixel offset does to a known point,
beside what the thesis printed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from bench.config import ConfigError, read_calibration, read_text
from bench.files import sha256_of, write_synced
from bench.record.schema import SCRIPT
from bench.record.writer import new_run_folder
from bench.report.thesis import Row, components_table, elsewhere_table, figures_table, rows_of_test
from bench.report.wording import listed, table
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
from bench.version import __version__
from instruments.clock import wall_time
from reports.figures.errors import error_histogram
from reports.page import (
    Banner,
    Figure,
    Page,
    Paragraph,
    Part,
    Requirement,
    Requirements,
    Section,
    Table,
    Verdict,
)
from reports.render import write_report

NOT_SAID = "not printed"
METHOD = (
    "Each known point is projected into both pictures, its pixels are put off, and the pair is"
    " triangulated with the same calibration: what differs is the offset's doing alone. All"
    " directions are tried, since the thesis doesn't state its own."
)


def offset_verdict(loaded: LoadedOffsets, found: Sequence[Outcome]) -> Verdict:
    """Met where no direction of any offset leads beyond the limit."""
    return "met" if all(one.worst_mm <= loaded.script.limit_mm for one in found) else "not met"


def offset_page(loaded: LoadedOffsets, found: Sequence[Outcome], calibration_sha256: str) -> Page:
    """The whole report."""
    script, verdict, limit = loaded.script, offset_verdict(loaded, found), loaded.script.limit_mm
    worst = max(found, key=lambda one: one.worst_mm)
    banner = Banner(
        kind="computed",
        verdict=verdict,
        tested=(
            f"{script.title}: {len(found)} offsets of known points,"
            f" {sum(len(one.errors_mm) for one in found)} directions in all."
        ),
        sentence=(
            f"{offset_text(worst.offset)} moves teat {worst.offset.teat} by up to"
            f" {worst.worst_mm:.1f} mm; the limit is {limit:g} mm."
        ),
        confidence="Computed from the calibration alone: no noise, no chance, nothing to repeat.",
        next_action=(
            "Choose longer lenses, a wider base, or a detector that picks to a fraction of a pixel."
            if verdict == "not met"
            else "A picking error of this size is no reason to change the cameras."
        ),
    )
    results: tuple[Part, ...] = (_directions(found, limit), *_figures(found, limit))
    inputs = {
        "layout": loaded.layout.name,
        "directions a picture": script.directions,
        "calibration SHA-256": calibration_sha256,
        "script": loaded.path.name,
    }
    method = (Paragraph(METHOD), table("Inputs", "what | value", list(inputs.items())))
    sections = (
        Section("requirements", "Requirements", (_requirements(loaded, found),)),
        Section("results", "What the offsets do", results),
        Section("published", "Beside the thesis", tuple(_published(loaded, found))),
        Section("provenance", "How it was done", method),
    )
    footer = (f"teatbench {__version__}",)
    return Page(script.title, script.about, banner, sections, footer=footer)


def _requirements(loaded: LoadedOffsets, found: Sequence[Outcome]) -> Requirements:
    limit = loaded.script.limit_mm
    rows = tuple(
        Requirement(
            name=f"teat {one.offset.teat}, {offset_text(one.offset)}",
            rule="the largest error of all directions is at most the limit",
            n=len(one.errors_mm),
            measured=f"{one.worst_mm:.2f} mm",
            limit=f"{limit:g} mm",
            margin=f"{limit - one.worst_mm:+.2f} mm",
            verdict="met" if one.worst_mm <= limit else "not met",
            source=loaded.script.source,
        )
        for one in found
    )
    return Requirements("Error below the limit, whatever the direction of the offset", rows)


def _directions(found: Sequence[Outcome], limit: float) -> Table:
    rows = []
    for one in found:
        far, who = one.distances_mm, (one.offset.teat, offset_text(one.offset))
        figures = (far.min(), np.median(far), far.max(), *one.most_mm)
        above = f"{int((far > limit).sum())} of {len(far)}"
        rows.append((*who, len(far), *figures, above))
    heads = (
        ">teat | offset | >directions | >least [mm] ~.2f | >median [mm] ~.2f | >most [mm] ~.2f"
        " | >most along x [mm] ~.2f | >along y [mm] ~.2f | >along z [mm] ~.2f"
        f" | >above {limit:g} mm"
    )
    note = "Each axis in its own worst direction."
    return table("Errors over all directions, world frame", heads, rows, note)


def _figures(found: Sequence[Outcome], limit: float) -> Iterator[Figure]:
    for at, one in enumerate(found, 1):
        svg, off = error_histogram(one.distances_mm, limit, name=f"offset-{at}"), one.offset
        caption = f"Teat {off.teat}, {offset_text(off)}: error over all directions"
        within = int((one.distances_mm <= limit).sum())
        yield Figure(svg, caption, f"{within} of {len(one.distances_mm)} within")


def _published(loaded: LoadedOffsets, found: Sequence[Outcome]) -> Iterator[Part]:
    figures, offsets = thesis(), loaded.script.offsets
    rows = []
    for one in found:
        moved, end = published_move_mm(one.offset), one.offset.published_mm
        truth_mm = loaded.points_mm[one.offset.teat - 1]
        off = NOT_SAID if end is None else f"{np.linalg.norm(np.subtract(end, truth_mm)):.2f}"
        printed = NOT_SAID if moved is None else listed(moved, "+.1f")
        beyond = ", ".join(beyond_axes(one)) or "no"
        rows.append((one.offset.teat, offset_text(one.offset), printed, one.most_mm, off, beyond))
    yield table(
        "The thesis's figures",
        ">teat | offset | >published: x, y, z [mm] | >most possible: x, y, z [mm] ~.1f"
        " | >published against the truth [mm] | beyond every direction",
        rows,
        "Published: the point with the offset less the point without, both as printed. Most"
        " possible: each axis in its worst direction.",
    )
    teats = ", ".join(str(one.offset.teat) for one in found if beyond_axes(one))
    if teats:
        yield Paragraph(
            f"For teat {teats} no direction of the stated offset gives what was printed, under this"
            " calibration; other causes than the offset must have been in those figures.",
            tone="info",
        )
    # the script's offsets are of the thesis's own printed ends, all of them
    if tuple(one.published_mm for one in offsets) == figures.test_2.triangulated_mm:
        yield figures_table(_beside(figures, found))
        yield components_table(figures)
        yield elsewhere_table(figures, "offsets")


def _beside(figures: Thesis, found: Sequence[Outcome]) -> Iterator[Row]:
    """Both tests, and section 6.1's figure beside every offset of one pixel in one picture."""
    every = np.concatenate([outcome.errors_mm for outcome in found])
    yield from rows_of_test(figures, 2, {"every direction": every})
    yield from rows_of_test(figures, 1, {})
    one = figures.one_pixel
    for outcome in found:
        if {outcome.offset.left_px, outcome.offset.right_px} == {0.0, 1.0}:
            what = f"one pixel: teat {outcome.offset.teat}, {offset_text(outcome.offset)}"
            sentence = f"median {outcome.median_mm:.2f} mm, at most {outcome.worst_mm:.2f} mm"
            yield what, one.section, f"{one.error_mm:g} mm", "", sentence, one.wrong


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
    pairs = zip("xyz", np.abs(moved), one.most_mm, strict=True)
    return [axis for axis, value, most in pairs if value > most]


def offset_text(offset: Offset) -> str:
    """``1 px left and 1 px right``."""
    offsets = {"left": offset.left_px, "right": offset.right_px}
    return " and ".join(f"{px:g} px {name}" for name, px in offsets.items() if px)


CALIBRATION, REPORT = "calibration.toml", "report"


def is_offset_run(folder: Path) -> bool:
    """Whether ``folder`` is that of a sensitivity script's run."""
    return (folder / SCRIPT).is_file() and is_offset_script(folder / SCRIPT)


def run_offsets(rig: LoadedRig, path: Path, out: Path) -> Path:
    """Run the script on the rig's calibration; return the run's folder. Raises ConfigError."""
    loaded = load_offsets(path)
    outcomes(loaded, rig.calibration)  # refuses what can't be computed before there is a folder
    files = {SCRIPT: loaded.text, "rig.toml": rig.text}
    files[CALIBRATION] = read_text(rig.calibration_path)
    if loaded.script.layout.endswith(".toml"):
        files[loaded.script.layout] = read_text(path.parent / loaded.script.layout)
    try:
        folder = _new_folder(out, path.name.removesuffix(".toml"))
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise ConfigError.plain(
            f"a run can't be kept in {out}: {error.strerror or error}. Name another folder with"
            " --out."
        ) from error
    return folder


def _new_folder(out: Path, name: str) -> Path:
    """The next free one. Raises OSError."""
    out.mkdir(parents=True, exist_ok=True)
    now = wall_time()
    while True:
        folder = new_run_folder(out, name, now)
        with suppress(FileExistsError):  # another run took it meanwhile
            folder.mkdir()
            return folder


def report_offsets(folder: Path) -> tuple[Path, LoadedOffsets, tuple[Outcome, ...], Verdict]:
    """(Re)write the report of such a run; return its path and results. Raises ConfigError."""
    loaded = load_offsets(folder / SCRIPT)
    found = outcomes(loaded, read_calibration(folder / CALIBRATION))
    digest = sha256_of(folder / CALIBRATION)
    path = write_report(offset_page(loaded, found, digest), folder / REPORT)
    verdict = offset_verdict(loaded, found)
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
        "calibration_sha256": digest,
        "offsets": rows,
    }
    write_synced(folder / REPORT / "run.json", json.dumps(whole, indent=1).encode())
    return path, loaded, found, verdict
