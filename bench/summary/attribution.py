"""The report's table of whose it is that a teat was missed, off, or not judged. It says nothing that `bench.attribution` doesn't."""

from __future__ import annotations

from collections.abc import Iterator

from bench.attribution import Attributed, Cause, What, attributed, counted
from bench.record import RunRecord
from reports.page import Column, Notes, Part, Table

NOTE = (
    "Each missed or wrong teat is one party's. Truth: within the guard band of its uncertainty, or it was taken back. Bench: "
    "taken while the bath was not stable, or not come to. Not visible: some camera can't see the end; the detector need not find it. "
    "Verdicts count as their rules say; this table says where to look first."
)


def attribution_parts(run: RunRecord) -> Iterator[Part]:
    """A table for each detector that was scored; and what isn't the detector's, one by one."""
    for detector in run.detectors:
        found = attributed(run, detector)
        counts = counted(found)
        rows = tuple((what.value, *(str(counts[what, cause]) for cause in Cause)) for what in What)
        columns = (Column("what"), *(Column(cause.value, "right") for cause in Cause))
        yield Table(f"Whose it is, detector {detector}", columns, rows, NOTE)
        others = tuple(_told(one) for one in found if one.cause not in (Cause.DETECTOR, Cause.NOT_VISIBLE))
        if others:
            yield Notes(f"Not the detector's, {detector}", others)


def _told(one: Attributed) -> str:
    teat = f", teat {one.teat}" if one.teat else ""
    return f"{one.trial}{teat}: {one.what.value}: {one.cause.value}: {one.why}"
