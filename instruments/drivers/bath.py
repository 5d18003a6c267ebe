"""A bath of another package as the bench's own: every start, set point and standby is read back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, Literal

from pydantic import ValidationError

from instruments.bath.profile import AlarmCode, Capabilities, NumberUnit, Profile
from instruments.bath.reading import BathReading
from instruments.bath.rows import Quantity
from instruments.clock import Clock
from instruments.device_file import faults_of
from instruments.drivers.border import Plugged, PluginBoundary
from instruments.drivers.entry_points import Plugin, one_line
from instruments.drivers.plugin import BathDriver, BathState
from instruments.errors import DeviceError, InstrumentError, LimitError

SAFE_TRIES = 3
SAME_K = 0.051  # a set point that is read back: half a step of a tenth, and rounding
VALUES = {"pump": ("none", "with run"), "comms_loss": ("hold", "stop", "unknown")}
HEATS = "Its set point can be changed while it heats: a run, or start(), begins that."
ALARM = 1  # the code of whatever its alarm says in words


def profile_of(plugged: Plugin) -> Profile:
    """What is known of such a bath before it is opened. Raises LimitError: its class is silent."""
    maker = plugged.maker
    try:
        for key, known in VALUES.items():
            if (value := getattr(maker, key)) not in known:
                raise ValueError(f"{key} is {value!r}, not {' or '.join(map(repr, known))}")
        low_c, high_c = maker.range_c
        rows = (
            _row("temperature", unit="degC", scale=maker.step_k),
            _row("set_point", unit="degC", access="rw", range=(low_c, high_c)),
            _row("run", access="rw", values={"standby": 0, "started": 1}),
            _row("power", unit="%", optional=True),
            _row("external", unit="degC", optional=True),
            _row("alarm", alarm="code"),
        )
        return Profile(
            family=plugged.name,
            source=plugged.source,
            transports=("plugin",),
            rows=rows,
            comms_loss=maker.comms_loss,
            comms_loss_evidence="FIELD",
            number_unit=NumberUnit(fixed="degC"),
            capabilities=Capabilities(pump=maker.pump),
            alarms=(AlarmCode(code=ALARM, cause="other", text="as it says", evidence="CERTAIN"),),
        )
    except Exception as error:  # another's class
        faults = faults_of(error) if isinstance(error, ValidationError) else [((), error)]
        why = "; ".join(f"{said}" for _, said in faults)
        what = f"its class has to say range_c, step_k, pump and comms_loss: {why}"
        raise LimitError("bath", what, hint=f"Correct {plugged}.") from error


def _row(name: str, **more: Any) -> Quantity:
    return Quantity(name=name, evidence="CERTAIN", poll=True, **more)


class PluggedBath(Plugged):
    """As `instruments.bath.driver.OwnBath`. A link that is lost is opened anew by the next call."""

    safe_state = "in standby, as it reads back itself"
    doubt, unit_source = "", "degC, by its driver"
    pump_url = ""
    pump_on = False
    watchdog_s: float | None = None

    def __init__(self, plugged: Plugin, clock: Clock, *, identify: bool = True) -> None:
        self.url, self.who = plugged.url, f"bath {plugged.name}"
        self.profile = profile_of(plugged)
        self.before_heating: Callable[[], None] = lambda: None
        self.on_reading: Callable[[BathReading], None] = lambda _: None
        self.heats, self.watched = False, True
        self._clock = clock
        self._border: PluginBoundary[BathDriver] = PluginBoundary(plugged, self.who, clock)
        self._identity: dict[str, str] = {}
        self._times_made_safe = 0
        if identify:
            with self._border.opening():
                self._identify()

    @property
    def identity(self) -> Mapping[str, str]:
        """What it says of itself, and which plug-in it is."""
        return {**self._identity, "plug-in": str(self._border.plugged)}

    @property
    def pump(self) -> Literal["none", "with run", "own"]:
        return self.profile.capabilities.pump

    def read(self) -> BathReading:
        """One poll. Raises DeviceError for an alarm-free bath that gives no temperature."""
        if not self._identity:
            self._identify()
        state = self._state()
        reading = BathReading(
            t_s=self._clock.now(),
            temp_c=state.temp_c,
            raw=(round(state.temp_c * 1e6),),
            external_c=state.external_c,
            power_percent=state.power_percent,
            safety_c=None,
            alarm=ALARM if state.alarm else 0,
            warning=0,
            remote=None,
            running=state.running,
            set_point_c=state.set_point_c,
            alarm_text=state.alarm,
        )
        self.on_reading(reading)
        return reading

    def get(self, name: str) -> float:
        """A value by the name of its row. Raises KeyError for another."""
        state, row = self._state(), self.profile.row(name)
        values = {
            "temperature": state.temp_c,
            "set_point": state.set_point_c,
            "run": float(state.running),
            "power": state.power_percent,
            "external": state.external_c,
            "alarm": float(bool(state.alarm)),
        }
        value = values[row.name]
        return float("nan") if value is None else value

    def set(self, name: str, value: float | str) -> None:
        """``set_point``, or ``run`` to "standby". Raises LimitError for all else."""
        if name == "run" and value in ("standby", 0):
            self.standby()
        elif name == "set_point":
            self.set_point(float(value))
        else:
            raise LimitError(self.who, f"a plug-in's {name} can't be set", asked=f"{value}")

    def set_point(self, set_point_c: float) -> None:
        """Change the set point of a bath that heats. Raises LimitError of one that stands by."""
        self.check_start(set_point_c)
        if not self._state().running:
            raise LimitError(self.who, "it stands by", asked="a set point", hint=HEATS)
        self._start(set_point_c)

    def confirm_unit(self, display_c: float) -> None:
        """Its driver gives degC."""

    def acknowledge(self) -> None:
        raise LimitError(self.who, "its alarm is cleared at the controller", asked="acknowledge")

    def check_start(self, set_point_c: float) -> None:
        """Raise LimitError where it may not be started at ``set_point_c``; asks nothing."""
        if why := self.profile.row("set_point").refusal(set_point_c):
            raise LimitError(self.who, why, asked=f"{set_point_c:g} degC")

    def start(self, set_point_c: float) -> None:
        """Heat to ``set_point_c``. Raises DeviceError for an alarm, or where it doesn't."""
        self.check_start(set_point_c)
        if alarm := self.read().alarm_text:
            raise DeviceError(self.who, f"not started: {alarm}", hint="Clear its alarm.")
        self._start(set_point_c)

    def _start(self, set_point_c: float) -> None:
        self.before_heating()
        with self._border.locked:
            self.heats, made_safe = True, self._times_made_safe
            self._border.call("start", lambda bath: bath.start(set_point_c))
            if self._times_made_safe != made_safe:  # meanwhile, by an event of the clock
                self.safe()
                what = "not started: it was made safe meanwhile"
                raise DeviceError(self.who, what, hint="See what tripped, and start it anew.")
            state = self._state()
        if not state.running or abs(state.set_point_c - set_point_c) > SAME_K:
            seen = f"{'running' if state.running else 'standby'}, {state.set_point_c:g} degC"
            what, asked = "it does not do what was asked", f"start at {set_point_c:g} degC"
            raise DeviceError(self.who, what, asked=asked, seen=seen, hint=self._border.look)

    def standby(self) -> None:
        """Heater off, and read back. Raises DeviceError where it goes on heating."""
        self._border.call("standby", lambda bath: bath.standby())
        self._stands_by()

    def safe(self) -> None:
        """Standby at once, in any state, read back; tried 3 times, each on a link of its own. One
        that heats all the same is set as cold as it goes, and its error is raised.
        """
        self._times_made_safe += 1
        for tries_left in reversed(range(SAFE_TRIES)):
            try:  # beside a call that hangs
                self._border.aside("standby", lambda bath: bath.standby())
                self._stands_by(aside=True)
                return
            except InstrumentError:
                self._border.forget()
                if not tries_left:
                    self._set_cold()
                    raise

    def _set_cold(self) -> None:
        """Its lowest set point, where it says that it heats."""
        low_c, _ = self._border.plugged.maker.range_c
        with suppress(InstrumentError):
            if self._state(aside=True).running:
                self._border.aside("start", lambda bath: bath.start(low_c))

    def release_watchdog(self, found_s: float | None = None) -> None:
        """None is known of it."""

    def _identify(self) -> None:
        self._identity = self._border.call("identity", lambda it: self._border.texts(it.identity))

    def _stands_by(self, *, aside: bool = False) -> None:
        if self._state(aside=aside).running:
            hint = f"SWITCH IT OFF AT ITS MAINS. {self._border.look}"
            what = "it goes on heating after standby"
            raise DeviceError(self.who, what, asked="standby", seen="running", hint=hint)
        self.heats = False

    def _state(self, *, aside: bool = False) -> BathState:
        ask = self._border.aside if aside else self._border.call
        return ask("read", lambda bath: self._checked(bath.read()))

    def _checked(self, given: object) -> BathState:
        border = self._border
        if not isinstance(given, BathState):
            raise border.broken("its reading is no BathState", given)
        running = border.flag(given.running, "running")
        temp_c = border.number(given.temp_c, "temperature")
        low_c, high_c = self.profile.plausible_c
        if not low_c <= temp_c <= high_c:
            raise border.broken(f"its temperature can't be: not {low_c:g} to {high_c:g}", temp_c)
        external_c, power = (
            None if value is None else border.number(value, name)
            for name, value in (("external_c", given.external_c), ("power", given.power_percent))
        )
        set_point_c = border.number(given.set_point_c, "set point")
        alarm = one_line(str(given.alarm or ""))
        return BathState(temp_c, running, set_point_c, external_c, power, alarm)
