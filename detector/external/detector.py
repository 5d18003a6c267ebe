"""A child process as a detector: started on demand, asked frame by frame, restarted after a fault,
given up in the end.

`prepare` writes pictures and calibration to files, outside of the measured time. A fault of the
line (silence, end, nonsense, memory) ends the process; a whole answer with wrong values doesn't.
"""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from detector.calibration import Calibration, dump_calibration
from detector.external import lines
from detector.external.process import Child, ChildFault, ChildSilent
from detector.protocol import (
    Context,
    Detection,
    DetectionFailure,
    Frames,
    Image,
    Outcome,
    TrainedOn,
    depth_of,
)

_GRACE_S = 2.0  # to end by itself, once its input is closed
_PNG_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)


@dataclass(frozen=True, slots=True)
class ProcessLimits:
    """Seconds until it is ready, seconds for an answer, MiB of memory with all children (None: any
    amount). ``restarts``: at most, in a run; ``in_a_row``: faults, one after the other, after which
    the program is given up.
    """

    start_s: float = 30.0
    answer_s: float = 30.0
    memory_mib: float | None = 1024.0
    restarts: int = 10
    in_a_row: int = 3


class ExternalDetector:
    """``command`` run in ``folder`` (None: the bench's). ``stopwatch``: real seconds.
    ``environment``: variables that it sees beside the ones every program needs.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        stopwatch: Callable[[], float],
        *,
        folder: Path | None = None,
        limits: ProcessLimits | None = None,
        version: str | None = None,
        environment: Sequence[str] = (),
    ) -> None:
        self.name = name
        self._command, self._folder = tuple(command), folder
        self._environment = tuple(environment)
        self._stopwatch, self._limits = stopwatch, limits or ProcessLimits()
        files = {part: digest for part in self._command if (digest := _digest(part, folder))}
        # as given; else made from the bytes of the files that its command names
        of_files = hashlib.sha256("".join(files.values()).encode()).hexdigest()[:12]
        self.version = version or of_files
        passed = {"environment": list(environment)} if environment else {}
        self.parameters: Mapping[str, Any] = {
            "command": list(command),
            "limits": asdict(self._limits),
            "files_sha256": files,
            **passed,
        }
        self.patience_s = self._limits.start_s + self._limits.answer_s + 10.0
        self.start_up_s: float | None = None
        self.most_s = math.inf
        self._ready = lines.Ready()
        self._started_s: float | None = None  # of a start that no call has had yet
        self._not_started: DetectionFailure | None = None
        self._child: Child | None = None
        self._exchange: _ExchangeFolder | None = None
        self._asked = self._off = self._last_stderr = ""
        self._starts = self._faults_in_a_row = 0

    @property
    def trained_on(self) -> TrainedOn:
        """As its first line says; empty before it was started."""
        return self._ready.trained_on

    @property
    def device(self) -> str:
        """What computes its answers, as its first line says."""
        return self._ready.device

    def introduce(self) -> None:
        """Start the process if none runs, so that what it says of itself is known. Where it can't
        be started, the next `prepare` says why.
        """
        if self._child is None and self._not_started is None and not self._off:
            try:
                self._start()
            except DetectionFailure as failure:
                self._not_started = failure

    def prepare(self, frames: Frames, calibration: Calibration) -> None:
        """Start the process if none runs, and write the pictures. Raises DetectionFailure."""
        self.start_up_s, self._asked = None, ""
        if self._not_started is not None:
            failure, self._not_started = self._not_started, None
            raise failure
        if self._off:
            raise DetectionFailure(self._off, Outcome.OFF)
        if self._exchange is None:
            self._exchange = _ExchangeFolder()
        self._exchange.replace(frames, calibration)
        if self._child is None:
            self._start()
        self.start_up_s, self._started_s = self._started_s, None
        self._asked = self._exchange.frame

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        """Ask about the frames that were prepared, or prepare them. Raises DetectionFailure."""
        return self.detect_with(frames, calibration, None)

    def detect_with(
        self, frames: Frames, calibration: Calibration, context: Context | None
    ) -> Detection:
        """As `detect`; the question has the ``context``."""
        if not self._asked:
            self.prepare(frames, calibration)
        asked, self._asked = self._asked, ""
        child, exchange = self._child, self._exchange
        if child is None or exchange is None:
            raise DetectionFailure("it was closed")
        limit_s = min(self._limits.answer_s, max(0.0, self.most_s - (self.start_up_s or 0.0)))
        with self._ended_on_faults(f"gave no answer within {limit_s:g} s"):
            child.ask(lines.request_line(asked, exchange.pictures, exchange.calibration, context))
            line = child.line(limit_s)
            try:
                detection = lines.parse_answer(line, asked, calibration)
            except lines.BadAnswer as fault:
                self._faults_in_a_row = 0
                raise DetectionFailure(str(fault)) from None
        self._faults_in_a_row = 0
        return detection

    def check(self) -> None:
        """Check memory between calls. Raises DetectionFailure for too much; then restarted."""
        with self._ended_on_faults(""):
            if self._child is not None:
                self._child.check_limits()

    def said(self) -> str:
        """Its standard error since this was last asked."""
        words = [self._last_stderr, self._child.stderr() if self._child else ""]
        self._last_stderr = ""
        return "\n".join(word for word in words if word)

    def close(self) -> None:
        """Close its input, end it with all that it started, and remove the pictures."""
        self._end(_GRACE_S)
        if self._exchange:
            self._exchange.clear()
            self._exchange = None

    def _start(self) -> None:
        start_s, limit_s = self._stopwatch(), min(self._limits.start_s, self.most_s)
        self._starts += 1
        how = self._limits.memory_mib, self._stopwatch, self._environment
        try:
            late = f"was not ready within {limit_s:g} s of its start"
            with self._ended_on_faults(late, " before it was ready"):
                self._child = Child(self._command, self._folder, *how)
                self._ready = lines.check_ready(self._child.line(limit_s))
        except OSError as error:
            raise self._fault(f"it can't be started: {error.strerror or error}") from None
        self._started_s = self._stopwatch() - start_s

    @contextmanager
    def _ended_on_faults(self, late: str, when: str = "") -> Iterator[None]:
        """Faults of the child and of its lines end it. Raises DetectionFailure."""
        try:
            yield
        except ChildSilent as silent:
            raise self._fault(f"it {late}{silent}", Outcome.TIMEOUT) from None
        except ChildFault as fault:
            raise self._fault(f"it {fault}{when}") from None
        except lines.GarbledLine as fault:
            raise self._fault(str(fault)) from None

    def _fault(self, reason: str, outcome: Outcome = Outcome.FAILED) -> DetectionFailure:
        """End the process, and perhaps give it up; gives back what to raise."""
        self._end()
        self._faults_in_a_row += 1
        if self._faults_in_a_row >= self._limits.in_a_row:
            why = f"{self._faults_in_a_row} faults in a row"
        elif self._starts > self._limits.restarts:
            why = f"{self._starts} starts"
        else:
            return DetectionFailure(reason, outcome)
        off = "switched off for the rest of the run"
        self._off = f"{off} after {why}; the last: {reason}"
        return DetectionFailure(f"{reason}. After {why} it is {off}", outcome)

    def _end(self, grace_s: float = 0.0) -> None:
        if self._child is not None:
            child, self._child = self._child, None
            child.end(grace_s)
            words = self._last_stderr, child.stderr()
            self._last_stderr = "\n".join(word for word in words if word)


class _ExchangeFolder:
    """A folder with one frame set's pictures and the calibration, under neutral names."""

    def __init__(self) -> None:
        self._held = tempfile.TemporaryDirectory(prefix="teatbench-")
        self._folder = Path(self._held.name)
        self.calibration = self._folder / "calibration.toml"
        self.pictures: dict[str, Path] = {}
        self._known: Calibration | None = None
        self.frame = "0"  # the name of the frame set that lies there

    def replace(self, frames: Frames, calibration: Calibration) -> None:
        """Replace the frame set. Raises DetectionFailure where PNG or disk can't hold it."""
        self.frame = str(int(self.frame) + 1)
        try:
            for path in self.pictures.values():
                path.unlink(missing_ok=True)
            # folder and calibration are the program's to read, and it may have removed them
            if calibration is not self._known or not self.calibration.is_file():
                self._folder.mkdir(exist_ok=True)
                text = dump_calibration(calibration)
                self.calibration.write_text(text, encoding="utf-8", newline="\n")
                self._known = calibration
            self.pictures = {name: self._write(name, one) for name, one in _images(frames).items()}
        except OSError as error:
            what = f"its pictures can't be put into {self._folder}"
            raise DetectionFailure(f"{what}: {error.strerror or error}") from None

    def clear(self) -> None:
        self._held.cleanup()

    def _write(self, name: str, image: Image) -> Path:
        path = self._folder / f"{self.frame}-{name}.png"
        try:
            _, data = cv2.imencode(".png", image, _PNG_FAST)
        except cv2.error:
            what = f"the {name} picture ({image.shape}, {image.dtype})"
            raise DetectionFailure(f"{what} can't be written as PNG") from None
        path.write_bytes(data.tobytes())
        return path


def _images(frames: Frames) -> dict[str, Image]:
    """The pictures that there are, kelvin in hundredths, depth in tenths of a mm, 0 unmeasured."""
    images = {name: getattr(frames, name) for name in ("left", "right", "thermal")}
    if frames.thermal_k is not None:
        hundredths = np.rint(np.clip(frames.thermal_k * 100.0, 0.0, 65535.0))
        images["thermal_radiometric"] = hundredths.astype(np.uint16)
    depth_mm, images["depth_amplitude"] = depth_of(frames)
    if depth_mm is not None:
        tenths = np.rint(np.nan_to_num(depth_mm) * 10.0)
        images["depth"] = np.where(tenths <= 65535.0, tenths, 0.0).astype(np.uint16)
    return {name: image for name, image in images.items() if image is not None}


def _digest(part: str, folder: Path | None) -> str | None:
    path = (folder or Path()) / part
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None
    except OSError:
        return None
