"""A run's folder, read and never written, for those who watch the run: snapshot, new events,
frames, and trials with their scores.

A detection comes from the record, which has a trial with its truth: no one touches where it is.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bench.config import ConfigError, read_calibration
from bench.record.reader import opened, points_mm, read_facts, read_run
from bench.record.schema import DATABASE, GUARDIAN_FILES
from bench.report.runs import run_thumbnails
from bench.report.trials import project_all
from bench.results.exports import has_report
from bench.results.status import LIVE, RUN_JSON, RunStatus, live_status, read_status, under_way
from bench.rig.practice import SHOWN as PRACTICE
from bench.run.events import EVENTS_FILE
from bench.run.set_up_picture import FOLDER as SET_UP
from bench.safety.latch import latch_beside
from instruments.camera.cameras import KNOWN as CAMERAS
from instruments.operators.mailbox import FOLDER, read_prompt
from reports.frames import places_of

TAIL_BYTES = 1 << 16  # of the events, for who has seen none
PIECE_BYTES = 1 << 16  # read at a time
CURVE = 600  # points of the bath's curve


class NoRunError(LookupError):
    """No run has this name."""


def run_folder(runs: Path, name: str) -> Path:
    """The run's folder: one of those in ``runs``, by its name alone. Raises NoRunError."""
    with suppress(OSError):
        for folder in runs.iterdir():
            if folder.name == name and (folder / DATABASE).is_file():
                return folder
    raise NoRunError(f"there is no run {name!r} here")


def listed(runs: Path) -> list[dict[str, Any]]:
    """All runs, newest first: what each is, and how it stands."""
    found = []
    with suppress(OSError):
        for folder in runs.iterdir():
            if (folder / DATABASE).is_file():
                with suppress(ConfigError, OSError):
                    found.append(_card(folder))
    # not by its name alone: a folder may have been renamed
    return sorted(found, key=lambda card: (card["started"], card["name"]), reverse=True)


def _card(folder: Path) -> dict[str, Any]:
    facts, found = read_facts(folder), status(folder)
    return {
        "name": folder.name,
        **{key: facts.get(key, "") for key in ("title", "script", "rig", "kind", "set_point_c")},
        "detectors": facts["detectors"],
        "started": facts["wall_started"],
        "report": has_report(folder, found["damage"]),
        "status": found,
    }


def reported(folder: Path) -> bool:
    """Whether a page can be shown that says what the record says."""
    return has_report(folder, status(folder)["damage"])


def status(folder: Path) -> dict[str, Any]:
    """How the run stands, as JSON; of one under way by what it says of itself."""
    if under_way(folder) and (found := live_status(folder)):
        return found.as_dict()
    files = [*(folder / name for name in (DATABASE, f"{DATABASE}-wal", RUN_JSON)), _latch(folder)]
    marks = map(_mark, (*files, *sorted(folder.glob(GUARDIAN_FILES))))
    return _read(folder, under_way(folder), *marks).as_dict()


@lru_cache(maxsize=512)
def _read(folder: Path, *_: float) -> RunStatus:
    return read_status(folder)


@lru_cache(maxsize=512)
def _latch(folder: Path) -> Path:
    """That of the rig on which the run was begun."""
    asked = read_facts(folder).get("asked") or {}
    return latch_beside(Path(asked.get("rig") or folder))


def _mark(path: Path) -> float:
    """Changes when the file does."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def snapshot(folder: Path) -> dict[str, Any]:
    """Everything that a page has to know of a run before it follows its events."""
    events = EventFile(folder)
    last = list(events.recent())
    return {
        "run": _card(folder),
        "status": status(folder),
        "live": live(folder),
        "prompt": prompt(folder),
        "practice": practice(folder),
        "curve": curve(folder),
        "events": last,
        "number": last[-1]["number"] if last else 0,
    }


def thumbnails(folder: Path) -> tuple[tuple[str, str], ...]:
    """Small frames of the worst trial that has its truth: what each is, and JPEG in base64."""
    return _thumbnails(folder, (folder / DATABASE).stat().st_mtime_ns)


@lru_cache(maxsize=256)
def _thumbnails(folder: Path, _: int) -> tuple[tuple[str, str], ...]:
    return tuple(run_thumbnails(read_run(folder)))


def live(folder: Path) -> dict[str, Any] | None:
    """Bath, interlocks, tip and frames as they are now; None where no run is under way: a
    killed bench leaves its last.
    """
    found = _now(folder, f"{FOLDER}/{LIVE}")
    return found and {key: value for key, value in found.items() if key != "status"}


def practice(folder: Path) -> dict[str, Any] | None:
    """How the emulated rig of a run in real time stands, and what can be done to it."""
    return _now(folder, PRACTICE)


def _now(folder: Path, name: str) -> dict[str, Any] | None:
    if under_way(folder):
        with suppress(OSError, ValueError, TypeError):
            return dict(json.loads((folder / name).read_bytes()))
    return None


def prompt(folder: Path) -> dict[str, Any] | None:
    """The prompt that waits for an answer; None while none does."""
    asked = read_prompt(folder)
    if not asked or not asked["open"] or not under_way(folder):
        return None
    return {**asked, "picture": asked["kind"] == "set up" and (folder / SET_UP).is_dir()}


def set_up_picture(folder: Path) -> Path | None:
    """The newest picture of a set-up; None where none was made."""
    made = list((folder / SET_UP).glob("*.png"))
    return max(made, key=lambda path: path.stat().st_mtime_ns, default=None)


def curve(folder: Path) -> list[list[float]]:
    """Time and temperature of the bath, thinned: [[t_s, ...], [degC, ...]]."""
    with opened(folder) as db:
        rows = db.execute("SELECT t_s, temp_c FROM bath ORDER BY t_s").fetchall()
    rows = rows[:: -max(1, len(rows) // CURVE)][::-1]  # with the last one
    return [[float(t) for t, _ in rows], [float(c) for _, c in rows]]


def trials(folder: Path) -> list[dict[str, Any]]:
    """The trials with their truth: scores, and truth and answers in each camera's pixels."""
    run = read_run(folder)
    calibration = read_calibration(folder / "calibration.toml", doubtful=True)
    found = []
    for trial in run.trials:
        points = points_mm([*trial.truth, *trial.found])
        seen = {
            camera: None if px is None else np.round(px, 1).tolist()
            for camera, px in project_all(calibration, points).items()
        }
        found.append(
            {
                "id": trial.id,
                "name": trial.pose,
                "situation": trial.head["situation"],
                "invalid": trial.invalid,
                "cameras": [row["camera"] for row in trial.frames if row["camera"] in CAMERAS],
                "marks": [
                    *({"of": "truth", "text": str(row["teat"])} for row in trial.truth),
                    *({"of": str(row["detector"]), "text": ""} for row in trial.found),
                ],
                "px": seen,
                "places": places_of(trial.scores),
                "mirrored": ["thermal"] if calibration.thermal.mirrored else [],
                "scores": {
                    name: {
                        "visible": score.counts.visible,
                        "found": score.counts.matched,
                        "false": score.counts.false,
                        "max_error_mm": max(
                            (float(np.linalg.norm(e)) for e in score.errors_mm), default=None
                        ),
                    }
                    for name, score in trial.scores.items()
                },
            }
        )
    return found


def frame(folder: Path, trial: str, camera: str) -> Path | None:
    """The picture of a stored trial; None where there is none."""
    with opened(folder) as db:
        row = db.execute(
            "SELECT path FROM frames WHERE trial = ? AND camera = ?", (trial, camera)
        ).fetchone()
    return folder / row[0] if row and (folder / row[0]).is_file() else None


def live_frame(folder: Path, camera: str) -> Path | None:
    """The last picture of a run under way; None where there is none."""
    path = folder / FOLDER / f"{camera}.jpg"
    return path if camera in CAMERAS and path.is_file() and under_way(folder) else None


@dataclass(slots=True)
class EventFile:
    """Reads on in the events of a run, a piece at a time; ``offset`` is how far it has read."""

    folder: Path
    offset: int = 0

    def recent(self) -> Iterator[dict[str, Any]]:
        """The last ones, and on from there."""
        path = self.folder / EVENTS_FILE
        with suppress(OSError):
            size = path.stat().st_size
            self.offset = max(0, size - TAIL_BYTES)
            if self.offset:
                with path.open("rb") as file:
                    file.seek(self.offset)
                    self.offset += len(file.readline())
        return self.new()

    def new(self) -> Iterator[dict[str, Any]]:
        """Those that came since, at most a piece of them; half a line waits for its end."""
        try:
            with (self.folder / EVENTS_FILE).open("rb") as file:
                file.seek(self.offset)
                data = file.read(PIECE_BYTES)
        except OSError:
            return
        whole = data[: data.rfind(b"\n") + 1]
        self.offset += len(whole)
        for line in whole.splitlines():
            with suppress(ValueError):
                yield json.loads(line)
