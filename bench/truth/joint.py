"""A run's truth as one covariance over all its ends, derived from the record.

What ends share: the arm's error, the table frame's three touches, the stage's registration (turn
and axes), the touch that a carried end rests on, the stage's place at it, and a ball tip at one
teat. Independent: hand, rounding and scatter of each touch, and each move of the stage. Where a
record doesn't say what an uncertainty is made of, its ends are taken to share it: that makes no
test significant.

The arm's stated u is that of any one point; how alike its error is at two is not stated. A jointed
arm's changes by its own size over some `ARM_LENGTH_MM`: a constant part and one linear in place,
weighted so that each end has u.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bench.config import ConfigError
from bench.record.reader import RunRecord, TrialRecord, points_mm
from bench.record.schema import Row
from bench.rig.arm_files import TableFrame, load_frame
from bench.scoring.errors import Floats
from bench.scoring.joint import JointCovariance
from bench.truth.registration import registration_from_facts
from bench.truth.uncertainty import ARM, CARRY, REGISTRATION, TIP_RADIUS, TruthMethod

# rms gradient of the emulated arms' kinematic errors over their sd along an axis: 0.0025 a mm
ARM_LENGTH_MM = 400.0
# of a frame whose touches the record lacks: they are seldom nearer together
FRAME_LENGTH_MM = 200.0
FRAME_FACT = "arm frame"
UNSAID = "not said"  # of an uncertainty without a budget
_RESTS_ON = re.compile(r"from the touches of (?P<trial>.+?): registration")
_CHECK = re.compile(r"check touch (\d+)")

End = tuple[TrialRecord, Row]


def joint_truth(run: RunRecord, ends: Sequence[End]) -> JointCovariance:
    """Of these ends, each a row of the truth of a trial of ``run``."""
    if not ends:
        return JointCovariance.exact(0)
    return _Ends(run, ends).covariance()


@dataclass(slots=True)
class _Columns:
    """Columns (n, 3, k) of sources, made one after the other."""

    n: int
    blocks: list[Floats] = field(default_factory=list)
    sources: list[str] = field(default_factory=list)

    def add(self, source: str, block: Floats) -> None:
        if block.any():
            self.blocks.append(block)
            self.sources += [source] * block.shape[2]

    def alike(self, source: str, keys: Sequence[object], u_mm: Floats) -> None:
        """Ends of one key share an error of ``u_mm`` (n,) along each axis; those of None don't."""
        for key in dict.fromkeys(key for key in keys if key is not None):
            of_key = np.array([one == key for one in keys])
            self.add(source, (of_key * u_mm)[:, None, None] * np.eye(3))

    def field(self, source: str, places_mm: Floats, u_mm: Floats, length_mm: float) -> None:
        """An error field of ``u_mm`` (n,) along each axis that changes over ``length_mm``."""
        if not u_mm.any():
            return
        off = (places_mm - places_mm[u_mm > 0.0].mean(axis=0)) / length_mm
        parts = np.column_stack([np.ones(self.n), off])
        parts *= (u_mm / np.linalg.norm(parts, axis=1))[:, None]
        # for each part three columns, one an axis
        block = np.einsum("np,ab->napb", parts, np.eye(3)).reshape(self.n, 3, -1)
        self.add(source, block)


class _Ends:
    """Ends of one run, and what each rests on."""

    def __init__(self, run: RunRecord, ends: Sequence[End]) -> None:
        self._run = run
        self._trials = [trial for trial, _ in ends]
        self._rows = [row for _, row in ends]
        self._places_mm = points_mm(self._rows)
        self._budgets = [_budget(row.get("budget"), row.get("u_mm")) for row in self._rows]
        self._by_id = {trial.id: trial for trial in run.trials}
        carried = any(row.get("how") == TruthMethod.CARRIED for row in self._rows)
        self._registration = registration_from_facts(run.facts) if carried else None
        self._rests_on = [self._reference(k) for k in range(len(ends))]

    def covariance(self) -> JointCovariance:
        n = len(self._rows)
        columns = _Columns(n)
        # where the arm touched it
        touched_mm = self._places_mm.copy()
        carried = np.array([row.get("how") == TruthMethod.CARRIED for row in self._rows])
        fresh = np.zeros((n, 3, 3))
        touch_mm = np.sqrt(self._u(*_OF_A_TOUCH, squared=True))
        references = {one for k, one in enumerate(self._rests_on) if carried[k]}
        if carried.any():
            self._carry(columns, touched_mm, fresh, carried)
        columns.field("arm", touched_mm, self._u(ARM), ARM_LENGTH_MM)
        self._frame(columns, self._u(REGISTRATION))
        columns.field(UNSAID, self._places_mm, self._u(UNSAID), ARM_LENGTH_MM)
        teats = [str(row["teat"]) for row in self._rows]
        columns.alike("tip radius", teats, self._u(TIP_RADIUS))
        keys = [
            (one, teat) if one in references else None
            for one, teat in zip(self._rests_on, teats, strict=True)
        ]
        columns.alike("reference touch", keys, touch_mm)
        own = np.array([key is None for key in keys])
        fresh += (own * touch_mm**2)[:, None, None] * np.eye(3)
        common = np.concatenate([np.zeros((n, 3, 0)), *columns.blocks], axis=2)
        return JointCovariance(common, fresh, tuple(columns.sources))

    def _u(self, *names: str, squared: bool = False) -> Floats:
        """Of each end, along an axis (n,)."""
        each = [[budget.get(name, 0.0) ** 2 for budget in self._budgets] for name in names]
        squares: Floats = np.array(each, dtype=np.float64).sum(axis=0)
        return squares if squared else np.sqrt(squares)

    def _reference(self, k: int) -> str:
        """What an end rests on: the trial, or the check, in which it was touched."""
        row = self._rows[k]
        if row.get("how") == TruthMethod.CARRIED:
            for line in json.loads(row.get("budget") or "{}").get("components", ()):
                if line["name"] == CARRY and (found := _RESTS_ON.search(line["source"])):
                    return found["trial"]
        return self._trials[k].id

    def _stage_mm(self, reference: str) -> Floats | None:
        """Where the stage stood when it was touched; None where the record doesn't say."""
        trial = self._by_id.get(reference)
        if check := _CHECK.fullmatch(reference):
            number = int(check[1])
            after = (row["after_trial"] for row in self._run.checks if row["number"] == number)
            trial = self._by_id.get(str(next(after, "")))
        return None if trial is None else _stage_mm(trial)

    def _carry(self, columns: _Columns, touched_mm: Floats, fresh: Floats, carried: Any) -> None:
        """The registration's turn and axes, the stage's place at the reference, and each move."""
        n, found = len(self._rows), self._registration
        ways, known = np.zeros((n, 3)), np.zeros(n, dtype=np.bool_)
        at = {one: self._stage_mm(one) for one in set(self._rests_on)}
        for k in np.flatnonzero(carried):
            begun, ended = at[self._rests_on[k]], _stage_mm(self._trials[k])
            if found is not None and begun is not None and ended is not None:
                ways[k], known[k] = ended - begun, True
        lost = carried & ~known
        if lost.any():  # a record that lacks where the stage stood: all of it is shared
            u_mm = self._u(CARRY) * lost
            columns.field(UNSAID, self._places_mm, u_mm, FRAME_LENGTH_MM)
        if found is None or not known.any():
            return
        touched_mm[known] -= ways[known] @ found.world_from_stage.R.T
        columns.add("registration", found.carry_parts_mm(ways) * known[:, None, None])
        repeat_mm = found.stated.repeatability_mm
        stands = [one if known[k] else None for k, one in enumerate(self._rests_on)]
        columns.alike("registration", stands, np.full(n, repeat_mm))
        fresh += (known * repeat_mm**2)[:, None, None] * np.eye(3)

    def _frame(self, columns: _Columns, u_mm: Floats) -> None:
        """The table frame's touches, each coordinate with the arm's uncertainty."""
        if not u_mm.any():
            return
        if (frame := frame_of(self._run)) is None:
            columns.field("table frame", self._places_mm, u_mm, FRAME_LENGTH_MM)
            return
        parts = frame.parts(self._places_mm)
        columns.add("table frame", parts * self._u(ARM)[:, None, None])


_OF_A_TOUCH = ("definition", "resolution", "scatter")
_KNOWN = {*_OF_A_TOUCH, ARM, REGISTRATION, TIP_RADIUS, CARRY}


@lru_cache(maxsize=1 << 13)  # a report asks for those of one end a dozen times
def _budget(text: str | None, u_mm: float | None) -> Mapping[str, float]:
    """Standard uncertainty along an axis by component; one that isn't known is not said."""
    if not text:
        return {UNSAID: float(u_mm or 0.0)}
    found: dict[str, float] = {}
    for line in json.loads(text)["components"]:
        name = line["name"] if line["name"] in _KNOWN else UNSAID
        found[name] = float(np.hypot(found.get(name, 0.0), line["u_mm"]))
    return found


def _stage_mm(trial: TrialRecord) -> Floats | None:
    said = trial.head.get("stage_mm")
    return np.array(json.loads(said), dtype=np.float64) if said else None


def frame_of(run: RunRecord) -> TableFrame | None:
    """The table frame of a run, out of its folder; None where there is none, or it is gone."""
    fact: Mapping[str, Any] | None = run.facts.get(FRAME_FACT)
    if fact is None:
        return None
    try:
        return load_frame(run.folder / Path(str(fact["file"])).name)
    except ConfigError:
        return None
