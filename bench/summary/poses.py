"""The report's part on the poses: which they were and how they were chosen, the error over the plane, and what repeats of a pose tell."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from bench.dependence import ErrorRows, PosePlace, error_rows, pose_places
from bench.record import RunRecord
from bench.summary.anchors import id_of
from bench.summary.precision import precision_parts
from reports.figures import TeatPlaces, error_map, error_maps
from reports.page import Figure, Notes, Paragraph, Part

POSE_SET = "pose set"
MAP_FROM = 9  # places: fewer make no map


def pose_parts(run: RunRecord, limit_mm: float, anchors: Mapping[str, str]) -> Iterator[Part]:
    """How the poses were chosen; then for each detector what depends on the place; ``anchors`` is each trial's link by its id."""
    chosen = run.facts.get(POSE_SET)
    if chosen:
        yield Notes(f"How the poses were chosen (order: {chosen['order']}; seed of the script: {chosen['seed']})", tuple(chosen["chosen"]))
    else:
        yield Paragraph("The poses are those of the recording; how they were chosen isn't in it.")
    for detector in run.detectors:
        yield from _map(error_rows(run, detector), detector, limit_mm, anchors)
        yield from precision_parts(run, detector)


def _map(rows: ErrorRows, detector: str, limit_mm: float, anchors: Mapping[str, str]) -> Iterator[Part]:
    """Each pose once, with the worst of its repeats: beside each other they would look like places of their own."""
    places = pose_places(rows)
    if len(places) < MAP_FROM:
        yield Paragraph(f"Error over the places, {detector}: {len(places)} places of a teat are no map; {MAP_FROM} are the least.")
        return
    teats = [_teat_places(teat, [place for place in places if place.teat == teat], anchors) for teat in rows.teat_names]
    within, beyond = (
        sum(place.worst_mm is not None and (place.worst_mm <= limit_mm) is inside for place in places) for inside in (True, False)
    )
    missed = sum(place.found < place.repeats for place in places)
    alt = f"{len(places)} places: {within} within {limit_mm:g} mm, {beyond} beyond, {missed} not found"
    repeated = max(place.repeats for place in places) > 1
    more = " Of a pose's repeats the worst is drawn, and a triangle where any of them missed the teat." if repeated else ""
    caption = f"Error over the plane, {detector}; the area of a disc is the error, and each mark opens its trial. {alt}.{more}"
    if len(teats) == 1:
        svg = error_map(teats[0], limit_mm, name=f"map-{id_of(detector)}")
    else:
        svg = error_maps(teats, limit_mm, name=f"map-{id_of(detector)}")
        caption += " Each teat has a panel of its own, all on one scale; y points away from the cameras, z up."
    yield Figure(svg, caption, alt, wide=True)


def _teat_places(teat: str, places: Sequence[PosePlace], anchors: Mapping[str, str]) -> TeatPlaces:
    found = [place for place in places if place.worst_mm is not None]
    missed = [place.place_mm for place in places if place.found < place.repeats]
    return TeatPlaces(
        teat,
        np.array([place.place_mm for place in found], dtype=np.float64).reshape(-1, 3),
        np.array([place.worst_mm for place in found], dtype=np.float64),
        np.array(missed, dtype=np.float64).reshape(-1, 3),
        tuple(anchors[place.worst_trial] for place in found if place.worst_trial is not None),
        tuple(anchors[place.missed_trial] for place in places if place.missed_trial is not None),
    )
