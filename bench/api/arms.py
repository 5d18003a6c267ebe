"""A measuring arm without a rig file, and the person beside it: where its tip is, where the arm
stands on the table, and how good it is. The person is asked at the terminal, or as ``operator``.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.arguments import lent
from bench.calibrate.arm import VerificationPlan, limits_of, read_touch, today, verify
from bench.calibrate.arm import open_arm as open_session
from bench.calibrate.arm import touch_frame as touch_points_of_frame
from bench.calibrate.simulated_arm import TouchStep
from bench.config import ConfigError, check_within, several, write_file
from bench.results.stated_arm import (
    check_verification,
    contradictions,
    length_limit_mm,
    location_limit_mm,
    stated_fact,
)
from bench.rig.arm_files import (
    LengthTest,
    TableFrame,
    Triple,
    Verification,
    VerificationLimits,
    frame_text,
    load_frame,
    unfinished_text,
    verification_text,
)
from bench.rig.leaving import to_stderr
from bench.rig.model import ArmTable, Baud
from bench.scoring.decisions import Verdict
from bench.scoring.stated_u import StatedCheck, refuted
from instruments.captures.capture import CaptureFile
from instruments.drivers.protocols import Arm
from instruments.microscribe.driver import ArmView
from instruments.operators.operator import Operator
from instruments.points import points_url
from textfiles.bounds import ABOVE_0, COUNT
from textfiles.text import plural

ARM = ArmTable.model_fields
BAUD, ANSWER_S = ARM["baud"].default, ARM["answer_s"].default


@dataclass(frozen=True, slots=True, eq=False)
class ArmReading:
    """One position of the tip (3,), mm, in the arm's frame, and in the world where a ``frame`` was
    named; ``axis`` (3,) up the stylus, where it is known; ``counts`` of the encoders.
    """

    serial_number: str
    tip_mm: NDArray[np.float64]
    world_mm: NDArray[np.float64] | None
    spread_mm: float
    axis: NDArray[np.float64] | None
    packets: int
    counts: Any
    frame: TableFrame | None


@dataclass(frozen=True, slots=True)
class VerifiedArm:
    """What `verify_arm` found: the touches, the limits that they are held against, limits of the
    script that contradict the stated ``u_mm`` of a point, and what the touches say of that.
    """

    verification: Verification
    limits: VerificationLimits
    u_mm: float
    contradictions: tuple[str, ...]
    checks: tuple[StatedCheck, ...]

    @property
    def refuted(self) -> Sequence[StatedCheck]:
        """Those of the checks that show a larger uncertainty than is stated."""
        return refuted(self.checks)

    @property
    def broken(self) -> tuple[str, ...]:
        """A sentence for each limit that isn't kept."""
        too_small = (f"{one.name}: u is too small" for one in self.refuted)
        return (*self.verification.broken(self.limits), *too_small)

    @property
    def gaps(self) -> tuple[str, ...]:
        """A sentence for each thing that the touches don't show."""
        return self.verification.gaps(self.limits)

    @property
    def verdict(self) -> Verdict:
        """Met, not met, or inconclusive where something was not shown."""
        if self.broken:
            return Verdict.NOT_MET
        return Verdict.INCONCLUSIVE if self.gaps else Verdict.MET


@contextmanager
def open_arm(
    url: str,
    *,
    baud: Baud = BAUD,
    answer_s: float = ANSWER_S,
    homed: bool = False,
    ask: bool = False,
    on_peg: bool | None = None,
    capture: CaptureFile | None = None,
) -> Iterator[Arm]:
    """The arm at ``url``, as in a rig file's [arm], signed on, in real time. ``homed``: its stylus
    was on its peg when it was switched on, or it was homed since; before, there is no position.
    ``ask`` the person at the terminal, where it isn't said. ``on_peg`` homes a MicroScribe: True
    where its stylus is there, False asks for that. Raises ConfigError, InstrumentError.
    """
    opened = open_session(url, baud, answer_s, capture, homed=homed, ask=ask, on_peg=on_peg)
    with opened as session, lent(session.arm, "arm") as arm:
        yield arm


def watch_arm(arm: Arm, every_s: float = 0.2) -> Generator[ArmView, None, None]:
    """Views of a homed arm, one each ``every_s``, until you leave. Raises InstrumentError, which is
    a LimitError for one whose position only its own software has.
    """
    check_within(ABOVE_0, every_s=every_s)
    yield from arm.watch(every_s)


def read_arm(
    url: str,
    packets: int = 8,
    *,
    frame: Path | str | None = None,
    homed: bool = False,
    baud: Baud = BAUD,
    answer_s: float = ANSWER_S,
    capture: CaptureFile | None = None,
    operator: Operator | None = None,
) -> ArmReading:
    """One position; ``frame``: a file of `write_arm_file`, of this arm. ``homed`` as in `open_arm`:
    without it the person is asked. Raises ConfigError, InstrumentError, OperatorAbort.
    """
    check_within(COUNT, packets=packets)
    found = load_frame(Path(frame)) if frame else None  # before anybody is asked
    with open_session(url, baud, answer_s, capture, homed=homed, operator=operator) as session:
        arm, world_mm = session.arm, None
        if frame:
            found = load_frame(Path(frame), serial_number=arm.identity.serial_number)
        step = TouchStep("point", 0, "Touch the point that is to be read.")
        seen = arm.read(packets) if arm.pedals else read_touch(session, step)
        if found:
            world_mm = found.world_from_arm.apply(seen.tip_mm)
        more = seen.spread_mm, seen.axis, seen.n, seen.evidence, found
        return ArmReading(arm.identity.serial_number, seen.tip_mm, world_mm, *more)


def touch_frame(
    url: str,
    checks: Sequence[Triple | None] = (None,),
    *,
    homed: bool = False,
    baud: Baud = BAUD,
    answer_s: float = ANSWER_S,
    capture: CaptureFile | None = None,
    operator: Operator | None = None,
) -> TableFrame:
    """Where the arm stands on the table, by three touches (origin, on x, in the plane) and a check
    point for each of ``checks``: its place (3,), world mm, or None for any in the plane. Its
    ``residuals_mm`` say how far off each is, ``residual_mm`` the farthest, None without one. A
    person at the terminal is asked, or ``operator``. Raises as `read_arm`.
    """
    wanted = several("checks", checks)
    with open_session(url, baud, answer_s, capture, homed=homed, operator=operator) as session:
        return touch_points_of_frame(session, wanted, today())


def verify_arm(
    url: str,
    plan: VerificationPlan | None = None,
    *,
    script: Path | str | None = None,
    accuracy_mm: float | None = None,
    homed: bool = False,
    baud: Baud = BAUD,
    answer_s: float = ANSWER_S,
    capture: CaptureFile | None = None,
    operator: Operator | None = None,
    warn: Callable[[str], None] = to_stderr,
    unfinished: Path | str | None = None,
) -> VerifiedArm:
    """Have the person do what ``plan`` says (divots at three distances for None), and hold the
    touches against the requirement ``arm_verified`` of ``script`` (the shipped one) and the stated
    standard uncertainty of a point, ``accuracy_mm`` (a MicroScribe 3DX's 0.23 mm for None; a file
    of points needs its own). What can't be shown then is said to ``warn``. ``unfinished``
    keeps the divots and lengths that are done, until all are. Raises as `read_arm`.
    """
    check_within(ABOVE_0, accuracy_mm=accuracy_mm)
    plan, rule = plan or VerificationPlan(), limits_of(None if script is None else str(script))
    needed = rule.length_limit_mm is not None or rule.dated_required
    if plan.length_mm is None and needed:
        warn("Without `length_mm` no length is measured, and the arm can't be verified whole.")
    if accuracy_mm is None and points_url(url):
        what = "`accuracy_mm` is needed: the standard uncertainty of a point of this arm"
        raise ConfigError.plain(what)
    u_mm = accuracy_mm or float(ARM["accuracy_mm"].default)
    how: dict[str, Any] = {"homed": homed, "operator": operator, "length_mm": plan.length_mm}
    opened = open_session(url, baud, answer_s, capture, **how)
    with opened as session, _kept_in(unfinished, warn) as keep:
        found = verify(session, plan, today(), keep)
    stated = stated_fact(ArmTable.model_construct(url=url, accuracy_mm=u_mm))
    lengths: Sequence[LengthTest] = found.lengths
    if not lengths and rule.dated_required:  # none was measured, and one is asked for
        lengths = [LengthTest("", np.zeros(3), np.zeros(3), 0.0)]
    location_mm = location_limit_mm(rule, stated, [test.n for test in found.locations])
    limits = VerificationLimits(location_mm, length_limit_mm(rule, stated, lengths))
    against = tuple(contradictions(rule, stated, (), found))
    return VerifiedArm(found, limits, u_mm, against, tuple(check_verification(stated, found)))


@contextmanager
def _kept_in(
    path: Path | str | None, warn: Callable[[str], None]
) -> Iterator[Callable[[Verification], None]]:
    """Writes what it gets to ``path``, and says so where the verification doesn't end."""
    kept = "nothing is kept"

    def keep(found: Verification) -> None:
        nonlocal kept
        # a full disk: the touches go on, and the whole file may be written yet
        with suppress(ConfigError):
            if path is None:
                return
            write_file(Path(path), unfinished_text(found))
            kept = f"kept in {path}: {plural(len(found.locations), 'divot')}"
            kept += f", {plural(len(found.lengths), 'length')}" if found.lengths else ""

    try:
        yield keep
    except BaseException:
        warn(f"Not verified; {kept}. A verification is touched in one go: give the command again.")
        raise
    if path is not None:
        Path(path).unlink(missing_ok=True)


def write_arm_file(found: TableFrame | VerifiedArm, out: Path | str) -> None:
    """Write what `touch_frame` or `verify_arm` gave, for ``frame`` or ``verification`` under [arm]
    of a rig file. Raises ConfigError.
    """
    if isinstance(found, TableFrame):
        text = frame_text(found)
    else:
        text = verification_text(found.verification, found.limits)
    write_file(Path(out), text)
