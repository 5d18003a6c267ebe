"""The bench's own health over all runs of a rig: what each run says of arm, bath, cameras and
detectors, as control charts, and what a person should know before the next run.

What was measured of a run is kept beside the runs, so that a run is read once. It is no evidence:
the records are, and it is made anew from them where it is missing.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from itertools import groupby
from pathlib import Path

import numpy as np

from bench.config import ConfigError
from bench.files import write_synced
from bench.record.reader import RunRecord, read_run
from bench.record.recording import Recording, RecordingError
from bench.record.schema import DATABASE
from bench.record.state import State, holder_of
from bench.results.cameras_agree import cameras_of
from bench.results.stated_arm import STATED_FACT, check_touches
from bench.results.verdicts import scored
from bench.scoring.control_chart import FAR, ChartTrend, ControlLimits, broken, limits_of, trend
from bench.script.calibration_age import CALIBRATION_FACT
from bench.truth.arm_check import BEFORE, CHECK_FACT, location_of, shift_mm
from instruments.camera.quality import edge_blur_px, level_dn
from textfiles.text import in_command, plural

KEPT = ".health.json"  # in the folder of runs
VERSION = 2  # of what is measured
MOST_NEW = 20  # runs that are read before a run begins
LOOKED_AT = 3  # trials whose pictures are looked at
BRIGHTEST = 0.995  # share of the pixels that are darker
MOST_WARNINGS = 3


@dataclass(frozen=True, slots=True)
class HealthQuantity:
    """``what`` is said of it, its unit, digits, and the smallest scatter that means anything;
    without ``limits`` it is shown only.
    """

    what: str
    unit: str
    digits: int
    least: float
    limits: bool = True


QUANTITIES: Mapping[str, HealthQuantity] = {
    "check_offset_mm": HealthQuantity("check point: off by", "mm", 2, 0.02),
    "check_scatter_mm": HealthQuantity("check touches: scatter", "mm", 2, 0.01),
    "arm_ratio": HealthQuantity("arm: scatter over what is stated of it", "", 2, 0.05),
    "stable_min": HealthQuantity("bath: time to stability", "min", 1, 0.2),
    "overshoot_k": HealthQuantity("bath: overshoot", "K", 2, 0.01),
    "disparity_px": HealthQuantity("cameras: disparity of the known ends", "px", 2, 0.02),
    "left_blur_px": HealthQuantity("left camera: blur", "px", 2, 0.05),
    "right_blur_px": HealthQuantity("right camera: blur", "px", 2, 0.05),
    "left_level": HealthQuantity("left camera: brightest grey level", "", 0, 1.0),
    "right_level": HealthQuantity("right camera: brightest grey level", "", 0, 1.0),
    "calibration_days": HealthQuantity("calibration: age", "days", 0, 1.0, limits=False),
}
FOUND = "found by {}, {}:"  # detector, script: of the visible ends
RATE = HealthQuantity("", "%", 1, 1.0)


@dataclass(frozen=True, slots=True)
class RunHealth:
    """One run's ``values`` by quantity. ``stamp``: of the record that they were measured of."""

    run: str
    started: str
    rig: str
    kind: str
    values: Mapping[str, float]
    stamp: int

    @property
    def day(self) -> float:
        return datetime.fromisoformat(self.started).timestamp() / 86400.0


@dataclass(frozen=True, slots=True)
class Chart:
    """One quantity of one rig over its runs, oldest first; ``rules``: what each value breaks."""

    rig: str
    name: str
    unit: str
    digits: int
    dates: tuple[str, ...]
    values: tuple[float, ...]
    limits: ControlLimits | None
    rules: tuple[str, ...]
    trend: ChartTrend | None

    @property
    def last(self) -> str:
        """``check point: off by 0.31 mm``."""
        return f"{self.name} {self.values[-1]:.{self.digits}f} {self.unit}".strip()

    @property
    def warning(self) -> str:
        """What the last month says, the last run alone where it is far off, or the last two that
        both break a rule; "" for nothing.
        """
        if self.trend:
            way = "grown" if self.trend.a_week > 0.0 else "fallen"
            figure = f"{abs(self.trend.a_week):.{self.digits}f} {self.unit}".strip()
            over = f"{self.trend.days:.0f} days ({plural(self.trend.values, 'run')})"
            return f"{self.last}: it has {way} by {figure} a week for {over}"
        if self.limits and (self.rules[-1] == FAR or all(self.rules[-2:])):
            usual = f"{self.limits.centre:.{self.digits}f} {self.unit}".strip()
            return f"{self.last}, usually {usual}: {self.rules[-1]}"
        return ""


def history(folder: Path, most: int | None = None, rig: str = "") -> list[RunHealth]:
    """What each ended run on a rig in ``folder`` says, oldest first; of those that were never read
    only the last ``most``, and those of ``rig`` where that is named. Raises nothing.
    """
    kept: dict[str, RunHealth] = {}
    with suppress(OSError, ValueError, TypeError, KeyError):
        text = json.loads((folder / KEPT).read_text(encoding="utf-8"))
        if text["version"] == VERSION:
            kept = {row["run"]: RunHealth(**row) for row in text["runs"]}
    found: dict[str, RunHealth] = {}
    with suppress(OSError):
        left = most
        for path in sorted(folder.glob(f"*/{DATABASE}"), reverse=True):
            run, stamp = path.parent, path.stat().st_mtime_ns
            there = kept.get(run.name)
            if there and there.stamp == stamp:
                found[run.name] = there
            elif left != 0 and not holder_of(run):
                with suppress(ConfigError, OSError):
                    if rig and read_run(run, whole=False).facts.get("rig") != rig:
                        continue
                    left, record = left and left - 1, read_run(run)
                    values = {k: round(v, 4) for k, v in _values(record) if np.isfinite(v)}
                    started, kind = (str(record.facts[key]) for key in ("wall_started", "kind"))
                    on = str(record.facts.get("rig", ""))
                    found[run.name] = RunHealth(run.name, started, on, kind, values, stamp)
    if found != kept:
        text = json.dumps({"version": VERSION, "runs": [asdict(one) for one in found.values()]})
        with suppress(OSError, ConfigError):
            write_synced(folder / KEPT, text.encode())
    return sorted((one for one in found.values() if one.rig), key=lambda one: (one.day, one.run))


def _values(run: RunRecord) -> Iterator[tuple[str, float]]:
    facts = run.facts
    if check := facts.get(CHECK_FACT.format(BEFORE)):
        test = location_of(check, "")
        yield "check_offset_mm", shift_mm(check)
        yield "check_scatter_mm", float(np.sqrt((test.deviations_mm**2).mean()))
        if stated := facts.get(STATED_FACT):
            yield "arm_ratio", check_touches("", stated, test).ratio
    yield from _of_bath(run)
    if disparity := cameras_of(run).disparity:
        yield "disparity_px", disparity.value
    # Medians over the first trials, whose set-up a script repeats
    seen: dict[str, list[float]] = {}
    with suppress(RecordingError, ConfigError, OSError):
        recording = Recording(run.folder)
        for frame in recording.frames[:LOOKED_AT]:
            frames = recording.load(frame)
            for camera, picture in (("left", frames.left), ("right", frames.right)):
                if (blur_px := edge_blur_px(picture)) is not None:
                    seen.setdefault(f"{camera}_blur_px", []).append(blur_px)
                seen.setdefault(f"{camera}_level", []).append(level_dn(picture, BRIGHTEST))
    yield from ((key, float(np.median(values))) for key, values in seen.items())
    age_days = facts.get(CALIBRATION_FACT, {}).get("age_days")
    if age_days is not None:
        yield "calibration_days", float(age_days)
    for name in run.detectors if run.ending == State.FINISHED else ():
        if visible := scored(run, name).counts.visible:
            script = facts.get("script") or facts["title"]
            found = scored(run, name).counts.matched
            yield FOUND.format(name, script), 100.0 * found / visible


def _of_bath(run: RunRecord) -> Iterator[tuple[str, float]]:
    set_point_c, stable = run.facts.get("set_point_c"), "stable" in run.bath_states
    warm = run.facts.get("asked", {}).get("warm")  # it took over a rig that another script heated
    if set_point_c is None or not stable or run.sessions > 1 or warm:
        return
    t_s, temp_c = run.bath[:, 0], run.bath[:, 1]
    yield "stable_min", float(t_s[run.bath_states.index("stable")] - t_s[0]) / 60.0
    if (temp_c[0] < set_point_c) and (temp_c >= set_point_c).any():
        yield "overshoot_k", float(np.nanmax(temp_c)) - set_point_c


def charts(runs: Sequence[RunHealth]) -> Iterator[Chart]:
    """A chart for each quantity of each rig that at least two runs measured."""
    by_rig = sorted(runs, key=lambda one: (one.rig, one.kind, one.day))
    for (rig, kind), of in groupby(by_rig, key=lambda one: (one.rig, one.kind)):
        there = list(of)
        names = dict.fromkeys(key for one in there for key in one.values)
        order = [*QUANTITIES, *(name for name in names if name not in QUANTITIES)]
        for key in (name for name in order if name in names):
            having = [one for one in there if key in one.values]
            if len(having) < 2:
                continue
            quantity = QUANTITIES.get(key, RATE)
            values = tuple(one.values[key] for one in having)
            limits = limits_of(values, quantity.least) if quantity.limits else None
            days = [one.day for one in having]
            yield Chart(
                rig=f"{rig} ({kind})",
                name=quantity.what or key,
                unit=quantity.unit,
                digits=quantity.digits,
                dates=tuple(one.started[:19].replace("T", " ") for one in having),
                values=values,
                limits=limits,
                rules=tuple(broken(values, limits)) if limits else (),
                trend=trend(days, values) if quantity.limits else None,
            )


def warnings(folder: Path, rig: str) -> list[str]:
    """What the runs in ``folder`` say of this rig before its next one, at most a few sentences."""
    of_rig = [one for one in history(folder, MOST_NEW, rig) if one.rig == rig]
    said = [chart.warning for chart in charts(of_rig) if chart.warning]
    more = len(said) - MOST_WARNINGS
    tail = [f"and {more} more: see 'teatbench runs {in_command(folder)}'"] if more > 0 else []
    return [*said[:MOST_WARNINGS], *tail]
