"""The bath's driver: a controller of any family with a profile, polled and commanded through plain
calls that block.

Nothing is written before the controller has been looked at: family, order of bytes, unit, a
plausible temperature. Every write is checked against the profile, spaced, done only on change, and
read back. Standby alone is always tried. It is no safety function: when the PC dies, most
controllers hold their last set point.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import ClassVar, Literal, TypeVar

from instruments.bath.errors import BrokenError
from instruments.bath.profile import Profile
from instruments.bath.reading import BathReading, OrderError, Poll
from instruments.bath.register_access import WiredRows, identity_of, line_to, look, wire_to
from instruments.bath.registers import Row
from instruments.bath.relay import PUMP, PumpAt, Relay, with_pump
from instruments.clock import Clock
from instruments.errors import DeviceError, InstrumentError, LimitError
from instruments.tap import Tap

SAFE_TRIES = 3

T = TypeVar("T")


class Bath:
    """The controller at ``url`` (see `line`), connected and identified. May be shared by threads.

    ``identify=False`` puts the look at the controller off to the first call but ``safe``: for
    whoever cleans up. Calls raise LinkError (no answer, within 7 s; or the link stayed down),
    ProtocolError (nonsense), DeviceError (refused, or in the wrong state), LimitError (we did not
    send it, or the family has no such thing). A broken link is mended, and the controller looked at
    anew, within the next call. ``allow_inferred`` lets rows be polled and written whose evidence is
    INFERRED. ``tap`` sees the bytes of the link.
    """

    safe_state: ClassVar[str] = (
        "controller in standby: heater off, and the pump with it where it turns with run"
    )

    def __init__(
        self,
        url: str,
        profile: Profile,
        clock: Clock,
        *,
        allow_inferred: bool = False,
        identify: bool = True,
        tap: Tap | None = None,
        pump: PumpAt | None = None,
    ) -> None:
        self.url, self.pump_url = url, pump.url if pump else ""
        self.profile = with_pump(profile, pump.profile) if pump else profile
        self.who = f"bath at {url}"
        self._family = profile
        self._lock = threading.RLock()
        line = line_to(url, profile, self.who)
        self._wire = wire_to(line, profile, clock, who=self.who, tap=tap, inferred=allow_inferred)
        self._wired = WiredRows(
            profile,
            self._wire,
            line.unit_id or 1,
            clock,
            who=self.who,
            allow_inferred=allow_inferred,
        )
        self._relay = (
            Relay(pump, self._wire, clock, allow_inferred=allow_inferred) if pump else None
        )
        self._poll: Poll | None = None
        self._identity: Mapping[str, str] = {}
        self._started = False
        self._times_made_safe = 0
        if identify:
            self._meet()

    @property
    def identity(self) -> Mapping[str, str]:
        """Who answered: family, url, order of bytes; model, version, firmware and cut-out
        temperature where the family tells.
        """
        return dict(self._identity)

    @property
    def pump(self) -> Literal["none", "with run", "own"]:
        """``with run``: the controller's, which turns while started; ``own``: one with a switch of
        its own; ``none``: not fitted.
        """
        return self.profile.capabilities.pump

    def read(self) -> BathReading:
        """One poll.

        Raises DeviceError when the controller gives no temperature or has stopped by itself,
        ProtocolError when it can't be one.
        """
        return self._do(self._read)

    def get(self, name: str) -> float:
        """The value of any row of the profile; for one in degC only
        after a poll that makes sense.
        """
        if self._relay and name == PUMP:
            return self._switched(self._relay.get, self._relay)
        row = self._wired.row(name)
        return self._do(lambda: self._get(row))

    def set(self, name: str, value: float | str) -> None:
        """Write a row (a number, or one of its labels) where it is another, and see that it stands.

        A pump's relay is not switched off unless the controller stands by: that raises LimitError.
        """
        if self._relay and name == PUMP:
            return self._switch(self._relay, value)
        row = self._wired.row(name)
        wanted = self._wired.allowed(row, value)
        return self._do(lambda: self._set(row, wanted))

    def set_point(self, set_point_c: float) -> None:
        """Change the set point, running or not."""
        self.set("set_point", set_point_c)

    def acknowledge(self) -> None:
        """Clear the controller's latched alarms. Raises LimitError where the family has no command
        for it.
        """
        self.set("acknowledge", "acknowledge")

    def start(self, set_point_c: float) -> None:
        """Heat to ``set_point_c``: no alarm (level among them), then the set point, then run (fact
        sheet, 4.1.6).

        With ``pump == "with run"`` the controller starts the pump by itself; a pump of its own has
        to be on already, and one that is not fitted is the caller's to prove.
        """
        self._wired.allowed(self._wired.row("set_point"), set_point_c)
        with self._lock:
            made_safe = self._times_made_safe
            reading = self.read()
            if reading.alarm:
                text = self.profile.alarm_text(reading.alarm)
                raise DeviceError(
                    self.who,
                    f"not started: {text}",
                    hint="Clear its cause and the alarm at the controller.",
                )
            if self.pump == "own" and self.get(PUMP) != self.profile.row(PUMP).values["on"]:
                raise DeviceError(
                    self.who,
                    "not started: the pump is off",
                    hint="Switch it on, and see that water flows.",
                )
            for name, label in self.profile.before_start.items():
                self.set(name, label)
            self.set("set_point", set_point_c)
            self._run(made_safe)

    def standby(self) -> None:
        """Heater off, and the pump with it where it turns with run."""
        self._started = False
        self.set("run", "standby")

    def safe(self) -> None:
        """Standby whatever happened before, sent at once and even if it seems to stand by already;
        tried 3 times.

        Raises the last error when the controller can't be reached or does not obey: then it must be
        switched off by hand.
        """
        run = self._wired.row("run")
        with self._lock:
            self._started = False
            self._times_made_safe += 1
            for tries_left in reversed(range(SAFE_TRIES)):
                if not self._wire.connected:
                    self._poll = None
                    self._wire.connect()
                try:  # whoever it is: a wrong unit or an alarm must not keep the heater on
                    self._wired.send(run, run.values["standby"], urgent=True)
                except InstrumentError:
                    self._wire.close()
                    if not tries_left:
                        raise
                else:
                    return

    def close(self) -> None:
        """Close the link, leaving the controller as it is; once more is no error."""
        with self._lock:
            self._wire.close()
            if self._relay:
                self._relay.close()

    def _run(self, made_safe: int) -> None:
        """Run, unless an event of virtual time has made safe since the count was ``made_safe``:
        that one has the last word.
        """
        try:
            if self._times_made_safe == made_safe:
                self.set("run", "started")
                self._started = True
        finally:
            overruled = self._times_made_safe != made_safe
            if overruled:
                self.safe()
        if overruled:
            raise DeviceError(
                self.who,
                "not started: it was made safe meanwhile",
                hint="See what tripped, and start it anew.",
            )

    def _switch(self, relay: Relay, value: float | str) -> None:
        with self._lock:
            if relay.is_off(value):
                run = self._wired.row("run")
                shown = self._do(lambda: self._wired.value(run))
                if shown != run.values["standby"]:
                    hint = "Put the controller into standby first."
                    raise LimitError(
                        self.who,
                        f"the pump is not switched off while the controller is {run.label(shown)}",
                        hint=hint,
                    )
            self._switched(lambda: relay.set(value), relay)

    def _switched(self, work: Callable[[], T], relay: Relay) -> T:
        if relay.shares:
            return self._do(work)
        with self._lock:
            return work()

    def _do(self, work: Callable[[], T]) -> T:
        """``work`` on a link that is up; once more over a new link when it breaks."""
        with self._lock:
            if self._poll is None or not self._wire.connected:
                self._meet()
            try:
                return work()
            except BrokenError:
                self._meet()
                return work()
            except OrderError:
                self._poll = None
                raise

    def _meet(self) -> None:
        """Connect, and look at who answers before anything is written; the link is closed on
        whoever does not fit.
        """
        self._poll = None
        wire = self._wire
        if not wire.connected:
            wire.connect()
        try:
            poll, reading = look(self._wired, self._family)
            self._identity = identity_of(self._wired, self.url)
            self._see_that_it_runs(reading)
        except BaseException:
            wire.close()
            raise
        self._poll = poll

    def _read(self) -> BathReading:
        reading = self._wired.poll(self._known())
        self._see_that_it_runs(reading)
        return reading

    def _get(self, row: Row) -> float:
        if row.unit == "degC":  # unit or order of bytes may have been changed behind our back
            self._wired.poll(self._known())
        return self._wired.value(row)

    def _set(self, row: Row, wanted: float) -> None:
        if row.unit == "degC":
            self._wired.poll(self._known())
        self._wired.set(row, wanted)

    def _known(self) -> Poll:
        """How to poll whom we have met. Raises LinkError when an event of virtual time has dropped
        the link meanwhile.
        """
        if self._poll is None:
            raise BrokenError(self.who, "the link is down", hint="Check cable and power.")
        return self._poll

    def _see_that_it_runs(self, reading: BathReading) -> None:
        if self._started and reading.running is False:
            self._started = False
            raise DeviceError(
                self.who,
                "it has stopped by itself: a power cut?",
                asked="run",
                seen="standby",
                hint="Start it anew.",
            )
