"""The bath's driver: a controller of any family with a profile, polled and commanded through plain
calls that block; with a relay that switches the pump, where the family has none.

Nothing is written before the controller was identified: family, order of bytes, unit, a plausible
temperature. Every write is checked against the profile, spaced, done only on change, and read back.
Standby alone is always tried. It is no safety function: when the PC dies, most controllers hold
their last set point. That a relay is on does not say that water moves.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

from instruments.bath.access import RowAnswer
from instruments.bath.line_access import LineAccess
from instruments.bath.profile import (
    PUMP,
    WATCHDOG,
    LineProfile,
    ModbusDevice,
    Profile,
    RegisterProfile,
    RelayProfile,
)
from instruments.bath.reading import BathReading, ChangedError
from instruments.bath.rows import Quantity
from instruments.bath.session import BrokenError
from instruments.clock import Clock
from instruments.errors import DeviceError, InstrumentError, LimitError
from instruments.link import Tap

if TYPE_CHECKING:
    from instruments.bath.register_access import RegisterAccess

FUTILE_S = 20.0
SAFE_TRIES = 3
HEATS_NOT = (PUMP, WATCHDOG)  # rows whose writing heats nothing
DISPLAY_K = 0.5  # how far a display may be from what came over the wire

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class PumpAt:
    """A pump's relay. ``tap`` gets the bytes of its link, where that is not the controller's."""

    url: str
    profile: RelayProfile
    tap: Tap | None = None


class OwnBath:
    """The controller at ``url``, connected and identified; may be shared by threads. Calls raise
    LinkError, ProtocolError, DeviceError, LimitError. The next call opens a broken link again, and
    identifies the controller. ``identify`` False: identified by the first call but ``safe``.
    ``allow_inferred``: rows whose evidence is INFERRED are polled and written. ``unit_confirmed``:
    where nothing states the unit of its numbers, a person has seen that they are degC.
    ``before_heating`` is called before anything is written that may heat; what it raises keeps that
    from being sent.
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
        unit_confirmed: bool = False,
        identify: bool = True,
        tap: Tap | None = None,
        pump: PumpAt | None = None,
    ) -> None:
        self.url, self.pump_url = url, pump.url if pump else ""
        self._pump = pump
        self.profile = _with_pump(profile, pump.profile) if pump else profile
        self.who = f"bath at {url}"
        self._lock = threading.RLock()
        self._rows: LineAccess | RegisterAccess
        who, inferred = self.who, allow_inferred
        match profile:
            case LineProfile():
                self._rows = LineAccess(url, profile, clock, who, inferred, tap)
            case RegisterProfile():
                self._rows = _registers(url, profile, clock, who, inferred, tap)
        self._rows.unit_confirmed = unit_confirmed
        self._wire = self._rows.wire
        self._relay: RegisterAccess | None = None
        if pump:  # on the controller's link where it is on the same line, and that is Modbus
            beside = None if isinstance(self._rows, LineAccess) else self._rows.wire
            who = f"pump at {pump.url}"
            self._relay = _registers(pump.url, pump.profile, clock, who, inferred, pump.tap, beside)
        self._identity: Mapping[str, str] = {}
        self.before_heating: Callable[[], None] = lambda: None
        self.on_reading: Callable[[BathReading], None] = lambda _: None
        self.heats = False  # by a call of ours, and no standby was read back since
        self.pump_on = False  # the same of a pump with its own switch
        self.watched = True  # whether its own watchdog is set, where it has one
        self.watchdog_s: float | None = None  # set by us, and read back
        self._found_s: float | None = None  # what it was set to before
        self._started = self._restarted = False
        self._times_made_safe = 0
        if identify:
            self._identify()

    @property
    def identity(self) -> Mapping[str, str]:
        """Family, url, order of bytes; model, version, firmware, cut-out where it shows them."""
        return dict(self._identity)

    @property
    def doubt(self) -> str:
        """Why what answers may be no controller at all; empty for no reason."""
        return self._rows.doubt

    @property
    def pump(self) -> Literal["none", "with run", "own"]:
        """``with run``: turns while the controller is started; ``own``: has its own switch."""
        return self.profile.capabilities.pump

    def read(self) -> BathReading:
        """One poll. Raises DeviceError for no temperature and for a controller that has stopped by
        itself, ProtocolError for a temperature that can't be one.
        """
        reading = self._retried(self._read)
        self.on_reading(reading)
        return reading

    def get(self, name: str) -> float:
        """The value of any row; for one in degC only after a poll that makes sense."""
        if self._relay and name == PUMP:
            relay = self._relay
            return self._switched(lambda: relay.get(PUMP), relay)
        row = self._rows.row(name)
        return self._retried(lambda: self._after_poll(row).get(name))

    def try_rows(self) -> Iterator[RowAnswer]:
        """Ask each row of a profile that is being made, and write nothing; no more than FUTILE_S
        where nothing makes sense. Raises LinkError.
        """
        clock, answered = self._rows.clock, False
        until_s = clock.now() + FUTILE_S
        with self._lock:
            self._connect()
            for ask in self._rows.tries():
                self._connect()
                yield (one := ask())
                answered = (answered or one.answered) and not self.doubt
                if not answered and clock.now() > until_s:
                    return

    def set(self, name: str, value: float | str) -> None:
        """Write a row (a number or a label) where it has another value, and read it back. Raises
        LimitError where a pump's relay would be switched off before standby.
        """
        if self._relay and name == PUMP:
            self._switch(self._relay, value)
            return
        row = self._rows.row(name)
        wanted = self._rows.allowed(name, value)
        stops = name == "run" and wanted == row.values["standby"]
        if not stops and name not in HEATS_NOT:
            self._begin_heating()
        self._note_pump(row, wanted)
        self._retried(lambda: self._after_poll(row).set(name, wanted))
        if stops:
            self._stands_by()

    def set_point(self, set_point_c: float) -> None:
        """Change the set point, running or not."""
        self.set("set_point", set_point_c)

    def acknowledge(self) -> None:
        """Clear the latched alarms. Raises LimitError where the family has no such command."""
        self.set("acknowledge", "acknowledge")

    @property
    def unit_source(self) -> str:
        """How it is known that its numbers are degC."""
        return self._rows.unit_source

    def confirm_unit(self, display_c: float) -> None:
        """A person reads ``display_c`` on the controller's display, in degC. Raises DeviceError
        where the numbers on the wire say another temperature.
        """
        if not self._rows.unit_unknown:
            return
        temp_c = self.read().temp_c
        if abs(temp_c - display_c) > DISPLAY_K:
            what = "its display and its numbers on the wire differ: they are not both degC"
            seen, asked = f"{temp_c:g}", f"{display_c:g} degC on its display"
            hint = "Set the controller to degrees Celsius, and read its display again."
            raise DeviceError(self.who, what, asked=asked, seen=seen, hint=hint)
        self._rows.unit_confirmed = True

    def check_start(self, set_point_c: float) -> None:
        """Raise LimitError where it may not be started at ``set_point_c``; asks nothing."""
        self._rows.allowed("set_point", set_point_c)

    def start(self, set_point_c: float) -> None:
        """Heat to ``set_point_c``: no alarm, the set point, then run (fact sheet, 4.1.6). A pump
        with its own switch has to be on already.
        """
        self.check_start(set_point_c)
        self._begin_heating()
        with self._lock:
            made_safe = self._times_made_safe
            self._started = False  # an earlier start is not checked any more
            reading = self.read()
            if reading.alarm:
                what = f"not started: {self.profile.alarm_text(reading.alarm)}"
                hint = "Clear its cause and the alarm at the controller."
                raise DeviceError(self.who, what, hint=hint)
            if self.pump == "own" and self.get(PUMP) != self.profile.row(PUMP).values["on"]:
                hint = "Switch it on, and see that water flows."
                raise DeviceError(self.who, "not started: the pump is off", hint=hint)
            for name, label in self.profile.before_start.items():
                self.set(name, label)
            self.set("set_point", set_point_c)
            self._set_watchdog()
            try:
                if self._times_made_safe == made_safe:  # no event of virtual time has made safe
                    self.set("run", "started")
                    self._started, self._restarted = True, bool(reading.restarted)
            finally:
                overruled = self._times_made_safe != made_safe
                if overruled:
                    self.safe()
            if overruled:
                what = "not started: it was made safe meanwhile"
                hint = "See what tripped, and start it anew."
                raise DeviceError(self.who, what, hint=hint)

    def standby(self) -> None:
        """Heater off, and the pump with it where it turns with run."""
        self._started = False
        self.set("run", "standby")

    def safe(self) -> None:
        """Standby at once, in any state, and read back; tried 3 times. Raises the last error: then
        it must be switched off by hand.
        """
        with self._lock:
            self._started = False
            self._times_made_safe += 1
            for tries_left in reversed(range(SAFE_TRIES)):
                self._connect()
                try:  # not identified: a wrong unit or an alarm must not keep the heater on
                    self._rows.stand_by()
                except InstrumentError:
                    self._wire.close()
                    if not tries_left:
                        raise
                else:
                    self._stands_by()
                    return

    def release_watchdog(self, found_s: float | None = None) -> None:
        """Set its watchdog back, or it would raise an alarm once this program has ended.
        ``found_s``: the value before, where another program has set it. A failure is ignored.
        """
        ours_s, self._found_s, self.watchdog_s = self._found_s, None, None
        found_s = ours_s if found_s is None else found_s
        if found_s is not None and self.profile.watchdog_s is not None:
            with self._lock, suppress(InstrumentError):
                self.set(WATCHDOG, found_s)

    def close(self) -> None:
        """Close the link, leaving the controller as it is; once more is no error."""
        with self._lock:
            self._wire.close()
            if self._relay:
                self._relay.wire.close()

    def _connect(self) -> None:
        """Open the link where it is down; the controller has to be identified then."""
        if not self._wire.connected:
            self._rows.known = False
            self._wire.connect()

    def _begin_heating(self) -> None:
        """From now on the controller may heat by a call of ours."""
        self.before_heating()
        self.heats = True

    def _stands_by(self) -> None:
        """Standby was read back."""
        self.heats = False
        self.release_watchdog()

    def _note_pump(self, row: Quantity, wanted: float) -> None:
        if row.name == PUMP and "on" in row.values:
            self.pump_on = wanted == row.values["on"]

    def _set_watchdog(self) -> None:
        """Set the controller's watchdog, where it has one: it stops where no messages come."""
        seconds = self.profile.watchdog_s
        if seconds is None or not self.watched or not self._rows.offers(WATCHDOG):
            return
        try:
            found_s = self.get(WATCHDOG)
            if self._found_s is None:
                # our own of a session that died is none that a person has set
                self._found_s = 0.0 if found_s == seconds else found_s
            self.set(WATCHDOG, seconds)
        except InstrumentError:
            self.watchdog_s = None
        else:
            self.watchdog_s = seconds

    def _switch(self, relay: RegisterAccess, value: float | str) -> None:
        pump, run = relay.row(PUMP), self._rows.row("run")
        wanted = relay.allowed(PUMP, value)
        self._note_pump(pump, wanted)
        with self._lock:
            if wanted == pump.values["off"]:
                shown = self._retried(lambda: self._rows.get("run"))
                if shown != run.values["standby"]:
                    state = run.label(shown)
                    what = f"the pump is not switched off while the controller is {state}"
                    raise LimitError(self.who, what, hint="Put the controller into standby first.")
            self._switched(lambda: relay.set(PUMP, wanted), relay)

    def _switched(self, work: Callable[[], T], relay: RegisterAccess) -> T:
        """``work``, on a link of the relay's own once more when that breaks."""
        if relay.shares:
            return self._retried(work)
        with self._lock:
            if not relay.wire.connected:
                relay.wire.connect()
            try:
                return work()
            except BrokenError:
                relay.wire.connect()
                return work()

    def _retried(self, work: Callable[[], T]) -> T:
        """``work`` on a link that is up; once more over a new link when it breaks."""
        with self._lock:
            if not self._rows.known or not self._wire.connected:
                self._identify()
            try:
                return work()
            except BrokenError:
                self._identify()
                return work()
            except ChangedError:
                self._rows.known = False
                raise

    def _identify(self) -> None:
        """Connect and identify; the link is closed where the controller does not fit."""
        self._rows.known = False
        self._connect()
        try:
            reading, self._identity = self._rows.identify()
            # The profile with the rows that this model offers, and its pump's relay
            known, absent = self._rows.family, self._rows.absent
            rows = tuple(row for row in known.rows if row.name not in absent)
            offered = known.model_copy(update={"rows": rows})
            self.profile = _with_pump(offered, self._pump.profile) if self._pump else offered
            self._check_running(reading)
        except BaseException:
            self._rows.known = False
            self._wire.close()
            raise

    def _read(self) -> BathReading:
        reading = self._rows.poll()
        self._check_running(reading)
        return reading

    def _after_poll(self, row: Quantity) -> LineAccess | RegisterAccess:
        """The rows; for one in degC after a poll, since the order of bytes may have changed."""
        if row.unit == "degC":
            self._rows.poll()
        return self._rows

    def _check_running(self, reading: BathReading) -> None:
        if not self._started:
            return
        why = seen = ""
        if reading.restarted and not self._restarted:
            why, seen = "it was without power: it has restarted and lost its set point", "restarted"
        elif reading.running is False:
            why, seen = "it has stopped by itself: a power cut?", "standby"
        elif reading.not_met:
            why, seen = "it is not set as its set point needs it any more", reading.not_met
        if why:
            self._started = reading.running is not False  # or a person has to start it anew
            raise DeviceError(self.who, why, asked="run", seen=seen, hint="Start it anew.")


def _registers(url: str, profile: ModbusDevice, *args: Any) -> RegisterAccess:
    """For a Modbus device alone: pymodbus takes a while to load."""
    from instruments.bath.register_access import RegisterAccess

    return RegisterAccess(url, profile, *args)


def _with_pump(profile: Profile, pump: RelayProfile) -> Profile:
    """``profile`` with the relay's row. Raises LimitError where the family turns a pump itself."""
    own = profile.capabilities.pump
    if own != "none":
        what = f"its pump ({own}) is the family's own, and no relay switches it"
        hint = "Leave pump_url and pump_profile out of the rig file."
        raise LimitError(profile.family, what, hint=hint)
    capabilities = profile.capabilities.model_copy(update={"pump": "own"})
    row = pump.row(PUMP).model_copy(update={"poll": False})
    return profile.model_copy(update={"capabilities": capabilities, "rows": (*profile.rows, row)})
