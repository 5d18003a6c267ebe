"""Whoever opens a rig leaves it safe. What heats, moves or turns by an order of ours is made safe
at the end of the context, of the interpreter, and by a guardian of its own where the process dies.

A guardian is started before the first order that heats or moves is sent: what only reads pays
nothing, and leaves a bath as it was found. Emulators of this process need none: they die with it.
"""

from __future__ import annotations

import atexit
import json
import os
import sys
import tempfile
from collections.abc import Callable, Collection
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from bench.rig.by_hand import not_safe_text
from bench.rig.devices import Devices
from bench.rig.guardian_client import GuardianClient, GuardianTarget, Heartbeat
from bench.rig.guardian_stage import StageTarget
from bench.rig.loading import LoadedRig
from instruments.bath.profile import PUMP
from instruments.clock import wall_time
from instruments.drivers.protocols import Bath, Stage
from instruments.errors import InstrumentError, LimitError, LinkError

FED_TIMES = 5  # in the time after which a controller's own watchdog stops it
OF = {"pump": "bath"}  # what cannot be made safe without the other
LEFT = ".left-running.jsonl"  # beside the rig file


class NotSafeError(InstrumentError):
    """What heats or moves could not be made safe on the way out."""


def to_stderr(text: str) -> None:
    """Where there is one: a terminal that has gone keeps nothing from being closed."""
    with suppress(OSError, ValueError):
        print(f"teatbench: {text}", file=sys.stderr, flush=True)  # noqa: T201 - a script has no other


def target_of(rig: LoadedRig, *, bath: str = "", pump: str = "", stage: str = "") -> GuardianTarget:
    """What a guardian needs to make safe, in another process, what is at these URLs."""
    table, target = rig.rig.stage, GuardianTarget()
    if bath:
        inferred = rig.rig.bath.allow_inferred
        target = GuardianTarget(bath, rig.profile_source, pump, rig.relay_source, inferred)
    if stage and table:
        target = replace(target, stage=StageTarget(stage, table.baud, table.dialect, table.axes))
    return target


@dataclass(eq=False)
class Leaving:
    """Watches the ``devices`` of ``rig`` from their opening to their closing. ``guards``: which of
    bath and stage outlive this process, and have guardians; ``leave_running``: they are left as
    they are, which is noted.
    """

    rig: LoadedRig
    devices: Devices
    guards: Collection[str]
    leave_running: bool
    warn: Callable[[str], None]

    def __post_init__(self) -> None:
        self._guardians: dict[str, GuardianClient] = {}
        self._folders: list[Path] = []
        self._heartbeat = Heartbeat()
        self._left = False
        bath: Bath | None = self.devices.bath  # of a rig opened in part
        if bath:
            bath.before_heating = partial(self._guard, "bath", bath, None)
            bath.watched = not self.leave_running
        if stage := self.devices.stage:
            stage.before_moving = partial(self._guard, "stage", None, stage)

    def leave(self) -> NotSafeError | None:
        """Make safe what is not; where that fails, the guardians go on trying."""
        self._left = True
        active = self.devices.active
        if self.leave_running:
            self._note(active)
            return None
        said: list[str] = []
        unsafe = self.devices.make_safe(said.append, only=active) if active else {}
        for name, guardian in self._guardians.items():
            (guardian.hand_over if name in unsafe else guardian.done)()
        for folder in self._folders:
            with suppress(OSError):  # it has acted, or goes on: its record stays
                folder.rmdir()
        if not unsafe:
            return None
        what = not_safe_text(unsafe)
        real = {OF.get(name, name) for name in unsafe} & {*self.guards}
        if self._guardians:
            what += "\nThe guardian goes on trying."
        if not real:
            what = f"{', '.join(unsafe)} of the emulated rig: {' '.join(said)}."
        self.warn(what)
        return NotSafeError("rig", what) if real else None

    def _guard(self, name: str, bath: Bath | None, stage: Stage | None) -> None:
        """Before what heats or moves. Raises LinkError without guardian, LimitError once left."""
        if self._left:
            what = "it was left: nothing is heated or moved any more"
            raise LimitError("rig", what, hint="Use it inside of its with block.")
        if bath:
            self._feed(bath)
        if name not in self.guards or self.leave_running:
            return
        guardian = self._guardians.get(name)
        if guardian is None:
            of_bath = {"bath": bath.url, "pump": bath.pump_url} if bath else {}
            target = target_of(self.rig, **of_bath, stage=stage.url if stage else "")
            guardian = GuardianClient(target, self._folder(), self._heartbeat)
            self._guardians[name] = guardian
            if guardian.taken_from:
                self.warn(f"{guardian.taken_from}; this process has it now")
        elif lost := guardian.lost:
            hint = "Open the rig anew."
            raise LinkError("guardian", f"nothing is heated or moved: {lost}", hint=hint)

    def _folder(self) -> Path:
        """For the guardian's record: beside the rig file, where there is one."""
        beside = self.rig.path.parent if self.rig.path.is_file() else None
        prefix = f"{self.rig.path.stem or 'teatbench'}.guardian-"
        try:
            folder = Path(tempfile.mkdtemp(prefix=prefix, dir=beside))
        except OSError:  # a folder that may not be written
            folder = Path(tempfile.mkdtemp(prefix=prefix))
        self._folders.append(folder)
        return folder

    def _feed(self, bath: Bath) -> None:
        """Keep a controller's own watchdog fed while this process runs, whatever else it does."""
        seconds = bath.profile.watchdog_s
        if seconds is None or not bath.watched:
            return
        clock = self.devices.clock

        def feed() -> None:
            if self._left or not bath.heats:
                return
            with suppress(InstrumentError):  # the next reading raises it
                bath.read()
            clock.call_at(clock.now() + seconds / FED_TIMES, feed)

        if not bath.heats:
            clock.call_at(clock.now() + seconds / FED_TIMES, feed)

    def _note(self, active: tuple[str, ...]) -> None:
        """Write down what is left running, beside the rig file."""
        bath: Bath | None = self.devices.bath
        if not active or not self.rig.path.is_file():
            return
        note: dict[str, object] = {
            "wall_time": wall_time().isoformat(timespec="seconds"),
            "left_running": list(active),
            "process": os.getpid(),
        }
        try:
            if bath and bath.heats:
                reading = bath.read()
                note |= {"running": reading.running, "set_point_c": reading.set_point_c}
                if bath.pump == "own":
                    note["pump"] = bath.profile.row(PUMP).label(bath.get(PUMP))
            path = self.rig.path.with_name(self.rig.path.stem + LEFT)
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(note) + "\n")
        except (InstrumentError, OSError) as error:
            self.warn(f"left running, and that could not be noted: {error}")


class OpenInstruments(AbstractContextManager[Devices]):
    """Open instruments that are left safe: at the context's end, and else at the interpreter's,
    where the context was entered and never left.
    """

    def __init__(
        self, opened: AbstractContextManager[Devices], leaving: Callable[[Devices], Leaving] | None
    ) -> None:
        self._opened = opened
        self._of = leaving
        self._leaving: Leaving | None = None
        self._process = 0

    def __enter__(self) -> Devices:
        devices = self._opened.__enter__()
        if self._of:
            self._leaving, self._process = self._of(devices), os.getpid()
            atexit.register(self._at_end)
        return devices

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> bool | None:
        atexit.unregister(self._at_end)
        if self._leaving and os.getpid() != self._process:
            return None  # in a forked process: the links are its parent's
        leaving, self._leaving = self._leaving, None
        unsafe = leaving.leave() if leaving else None
        if unsafe and error:
            error.add_note(str(unsafe))
        closed = self._opened.__exit__(kind, error, trace)
        if unsafe and not error:
            raise unsafe
        return closed

    def _at_end(self) -> None:
        with suppress(NotSafeError):  # said already
            self.__exit__(None, None, None)
