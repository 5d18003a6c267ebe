"""An open rig: heat, move, set up, capture and touch as a run does, with its interlocks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TypeVar, cast

import numpy as np

from bench.api.loading import AnyRig, load_rig
from bench.api.shots import Shot
from bench.arguments import GuardedProxy
from bench.config import ConfigError, check_within, several
from bench.record.recording import TruthRow
from bench.rig.devices import Devices
from bench.rig.frame_capture import FrameTaker
from bench.rig.leaving import to_stderr
from bench.rig.loading import LoadedRig
from bench.rig.lock import lock_path, locked
from bench.rig.opening import ALL, open_instruments
from bench.rig.reconnecting import Reconnecting
from bench.safety.bath_monitor import BathMonitor, SafeAtOnce
from bench.safety.interlocks import Interlocks
from bench.safety.latch import unconfirmed
from bench.safety.liveness import Liveness
from bench.safety.signals import no_lock_is_kept
from bench.safety.stability import BathState, StabilityGate
from bench.script.detectors import refusals
from bench.truth.stage_registration import ends_of
from bench.truth.touching import Ends, EndTouches, SoFar, TipReader, Toucher
from detector import registry
from detector.calibration import Calibration
from instruments.bath.reading import BathReading
from instruments.bath.sequence import pump_on, start_bath
from instruments.captures.capture import CaptureFile
from instruments.clock import Clock, sleep_looking, wall_time
from instruments.drivers.protocols import Arm, Bath, Cameras, Stage
from instruments.errors import DeviceError, LimitError
from instruments.operators.operator import Arrangement, Homing, Operator
from instruments.world.phantom import PlatePose
from instruments.world.setups import Situation
from textfiles.bounds import FROM_0

LOOK_S = 1.0
INSIDE = "Use it inside of its with block: with open_rig(…) as rig."
Opened = TypeVar("Opened")


class OpenRig:
    """The instruments of a rig, opened by `open_rig`. What isn't opened raises LimitError, as does
    any use after the rig was left.
    """

    def __init__(self, loaded: LoadedRig, devices: Devices, warn: Callable[[str], None]) -> None:
        self.loaded, self._devices, self._warn = loaded, devices, warn
        self._left, self._lent = False, dict[str, GuardedProxy]()
        self._stands: Arrangement | None = None
        self._visible: tuple[bool, ...] = ()
        # homing leaves the plate at a place that is not known
        self._pose = None if devices.stage else PlatePose()
        self._watch: BathMonitor | None = None
        self._taker: FrameTaker | None = None

    @property
    def devices(self) -> Devices:
        """All that is open, None for what isn't."""
        if self._left:
            raise LimitError("rig", "it was left, and is closed", hint=INSIDE)
        return self._devices

    @property
    def clock(self) -> Clock:
        """The bench's clock: virtual where all is emulated and no person takes part."""
        return self.devices.clock

    @property
    def arm(self) -> Arm:
        """The measuring arm."""
        return self._there("arm", self.devices.arm)

    @property
    def bath(self) -> Bath:
        """The water bath. `heat` watches its interlocks; the driver's own ``start`` doesn't."""
        return self._there("bath", self.devices.bath)

    @property
    def stage(self) -> Stage:
        """The motion stage, in machine coordinates."""
        return self._there("stage", self.devices.stage)

    @property
    def cameras(self) -> Cameras:
        """The cameras as one; `capture` also checks what they give."""
        return self._there("cameras", self.devices.cameras)

    @property
    def operator(self) -> Operator:
        """Who places the phantom and touches its ends."""
        return self._there("operator", self.devices.operator)

    @property
    def calibration(self) -> Calibration:
        """The rig's calibration. Raises ConfigError where none has been made."""
        return self.loaded.calibration

    @property
    def emulated(self) -> tuple[str, ...]:
        """Names of the instruments that are emulated."""
        return self.loaded.rig.emulated

    def heat(self, set_point_c: float, *, wait: bool = True, timeout_s: float = 7200.0) -> None:
        """Start the bath, watched by the rig's interlocks from here on, and wait until it is
        stable. Raises LimitError outside of the rig's set points, InterlockTrip, DeviceError after
        ``timeout_s``.
        """
        low_c, high_c = self.loaded.rig.limits.set_point_c
        if not low_c <= set_point_c <= high_c:
            what = f"{set_point_c:g} degC is outside what the rig allows ({low_c:g} to {high_c:g})"
            raise LimitError("bath", what, hint="See set_point_c under [limits] in the rig file.")
        if self._watch:
            self._watch.stop()
        bath, interlocks = self.bath, Interlocks(self.loaded.rig.limits, self.bath.profile)
        at_once = SafeAtOnce(self.devices)

        def act(trip: Exception) -> bool:
            safe, steps = at_once()
            said = [text for step in steps for text in step.texts]
            self._warn(f"{trip}\n{'; '.join(said)}.")
            return safe

        self._watch = BathMonitor(
            bath.read,
            self.clock,
            StabilityGate(set_point_c),
            interlocks,
            lambda _: None,
            act,
            pump_on=lambda reading: pump_on(bath, reading),
            moving=Liveness(self.loaded.profile),
        )
        self._watch.start()
        start_bath(bath, set_point_c, self.wait)
        self._watch.heating()
        if wait:
            self.wait_until_stable(timeout_s)

    def wait_until_stable(self, timeout_s: float = 7200.0) -> None:
        """Wait for the stability gate after `heat`. Raises as that does."""
        if self._watch is None:
            raise LimitError("bath", "it was not heated by this program", hint="Call heat().")
        end_s = self.clock.now() + timeout_s
        while self._watch.state is not BathState.STABLE:
            if self.clock.now() > end_s:
                why = f"not stable within {timeout_s:g} s: {self._watch.why_not_stable}"
                raise DeviceError("bath", why, hint="Check level, lid and pump.")
            self.wait(LOOK_S)

    @property
    def reading(self) -> BathReading | None:
        """The bath's last reading since `heat`; None before the first."""
        return self._watch.last if self._watch else None

    def wait(self, seconds: float) -> None:
        """Let time pass on the bench's clock. Raises InterlockTrip."""
        sleep_looking(self.clock, seconds, self.check, LOOK_S)

    def check(self) -> None:
        """Raise InterlockTrip where an interlock has tripped since `heat`."""
        if self._watch:
            self._watch.check()

    def home(self) -> tuple[str, ...]:
        """Sign on to the arm and have it homed; home the stage: of what is open, and not homed.
        Which of them were homed now; warns where neither is open.
        """
        arm, stage, homed = self.devices.arm, self.devices.stage, list[str]()
        if not (arm or stage):
            self._warn("nothing to home: this rig has no arm and no stage, or they are not open")
        if arm and not arm.homed:
            arm.sign_on()
            self.tip.refuse_other_arm()
            self.operator.ask(Homing(arm.homing), self.check)
            arm.confirm_homed()
            homed.append("arm")
        if stage and not stage.homed:
            stage.connect()
            stage.home()
            self._pose = None
            homed.append("stage")
        self.check()
        return tuple(homed)

    def move(
        self, x_mm: float = 0.0, y_mm: float = 0.0, *, z_mm: float = 0.0, yaw_deg: float = 0.0
    ) -> None:
        """Move the phantom's plate by the stage, from its reference place. Raises LimitError for
        what is out of reach or has no axis, and as the stage's ``move_to``.
        """
        table, stage = self.loaded.rig.stage, self.stage
        if table is None:
            raise LimitError("stage", "this rig has no stage", asked="move")
        self.check()
        if not stage.homed:
            raise LimitError("stage", "it is not homed", asked="move", hint="Call home() first.")
        pose = PlatePose(x_mm, y_mm, z_mm, float(np.radians(yaw_deg)))
        place, given = table.machine(pose), (x_mm, y_mm, z_mm, yaw_deg)
        for axis, key, wanted in zip("XYZA", ("x_mm", "y_mm", "z_mm", "a_deg"), given, strict=True):
            if wanted and key not in place:
                raise LimitError("stage", f"it has no axis {axis}", asked="move")
            if key in place and not (travel := stage.limits[axis]).hold(round(place[key], 3)):
                low, high = (end - place[key] + wanted for end in (travel.low_mm, travel.high_mm))
                what = (
                    f"{key.replace('a_', 'yaw_')} = {wanted:g} is out of reach, {low:g} to {high:g}"
                )
                raise LimitError("stage", what, asked="move", hint="From its reference place.")
        stage.move_to(**place, feed_mm_min=table.feed_mm_per_min)
        self._pose = pose
        self.check()

    def set_up(self, situation: Situation) -> tuple[bool, ...]:
        """Have the operator set this up; which teat ends all cameras see. Raises as an operator."""
        asked = Arrangement(situation.name, situation.phantom, (), situation.about, scene=situation)
        self._visible = self.operator.ask(asked, self.check).visible
        self._stands = asked
        return self._visible

    def capture(self) -> Shot:
        """A frame set of all cameras, checked as a run's, taken again where it has a fault. Raises
        DeviceError after the last try.
        """
        cameras = self.cameras  # refused where the rig was left
        if self._taker is None:
            given = (cameras, self.loaded.rig.cameras, self.calibration, self.wait)
            # nothing warm need be seen: the bath may be cold
            self._taker = FrameTaker(*given, lambda _, text: self._warn(text), flat=False)
        self.check()
        return Shot(self._taker.take(), self.calibration)

    @property
    def tip(self) -> TipReader:
        """Reads the arm's tip in the world, once `home` was called."""
        return TipReader(self.arm, self.loaded.rig.arm, self.loaded.frame)

    def touch(self, teat: int | None = None) -> tuple[TruthRow, ...]:
        """Have the operator touch the end of ``teat`` (from 1), or of all that `set_up` has asked
        for: world mm, with standard uncertainty. Raises NoTruthError, LimitError before `set_up`,
        or `move` with a stage, or for a teat that isn't there, and as arm and operator.
        """
        if not self.arm.homed:
            raise LimitError("arm", "it is not homed", asked="touch", hint="Call home() first.")
        if self._stands is None:
            what = "nothing was set up that could be touched"
            raise LimitError("arm", what, hint="Call set_up().")
        if self._pose is None:
            what = "the place of the plate is not known: it was not moved since the stage was homed"
            raise LimitError("stage", what, hint="Call move(), to the reference place or another.")
        stands = self._stands
        if teat is not None and not 1 <= teat <= len(stands.phantom.teats):
            what = f"there is no teat {teat}: the phantom has {len(stands.phantom.teats)}, from 1"
            raise LimitError("arm", what, asked="touch")
        ask = lambda request: self.operator.ask(request, self.check)  # noqa: E731
        toucher = Toucher(ask, self.tip, self.loaded.rig.arm, self.clock, self.check)
        ends: Ends = ends_of(stands.phantom.moved(self._pose))
        away_s, so_far = self.loaded.rig.limits.away_s, SoFar()
        lost = Reconnecting.of_arm(self.arm, ask, self.clock, self._warn, away_s)
        if teat is None:
            points, _ = lost.keep(lambda: toucher.touch_all(ends, so_far))
            teats: Sequence[int] = range(1, len(points) + 1)
        else:
            taken: EndTouches = []
            points, teats = [lost.keep(lambda: toucher.touch_one(teat, ends, taken))[0]], [teat]
        return tuple(
            TruthRow(stands.situation, str(i), p.xyz_mm, self._visible[i - 1], p.u_mm)
            for i, p in zip(teats, points, strict=True)
        )

    def truth(self) -> tuple[TruthRow, ...]:
        """The exact teat ends, of an emulated rig alone. Raises LimitError of a real one."""
        if self.devices.exact_ends is None or self._stands is None:
            what = "there are no exact ends of a real phantom, or of none"
            raise LimitError("rig", what, hint="Call set_up() and touch().")
        name, places = self._stands.situation, self.devices.exact_ends().tolist()
        return tuple(
            TruthRow(name, str(i), (x, y, z), seen, 0.0)
            for i, ((x, y, z), seen) in enumerate(zip(places, self._visible, strict=True), 1)
        )

    def with_truth(self, shot: Shot, truth: Sequence[TruthRow]) -> Shot:
        """``shot`` with the truth of its ends, as `touch` or `truth` gave it."""
        return replace(shot, truth=tuple(truth))

    def safe(self, *, keep_arm: bool = False) -> tuple[str, ...]:
        """Heater off and its watch ended, stage at a stand, arm's session ended; as leaving the rig
        does. ``keep_arm``: its session goes on, so that it stays homed. What was made safe: nothing
        where neither is open. Raises DeviceError.
        """
        self.end_watch()  # else the watch takes the heater that is off for an interference
        said: list[str] = []
        wanted = [one for one in ("bath", "stage", "arm") if getattr(self.devices, one)]
        wanted += ["pump"] * ("bath" in wanted)
        wanted = [name for name in wanted if name != "arm" or not keep_arm]
        unsafe = self.devices.make_safe(said.append, only=wanted)
        if unsafe:
            raise DeviceError("rig", "; ".join(said), asked="safe", hint=" ".join(unsafe.values()))
        return tuple(wanted)

    def end_watch(self) -> None:
        """No further readings of the bath."""
        if self._watch:
            self._watch.end()

    def leave(self) -> None:
        """Its with block ends: it can't be used any more."""
        self.end_watch()
        self._left = True

    def _there(self, name: str, device: Opened | None) -> Opened:
        if device is None:
            what = f"this rig has no {name}, or it was not opened"
            raise LimitError("rig", what, hint=f'Name it: open_rig(…, instruments=("{name}",)).')
        return cast(Opened, self._lent.setdefault(name, GuardedProxy(device, lambda: self.devices)))


def rig_notes(rig: AnyRig) -> Iterator[str]:
    """What of a rig a person has to see to before a run: a calibration that is not made, shipped
    detectors that can't be used with it, a bath's cut-out or unit that is not confirmed. Opens
    nothing; `check_rig` does. Raises ConfigError.
    """
    loaded = load_rig(rig)
    if loaded.made_calibration is None:
        hint = "a run needs it, see 'teatbench help calibration'"
        yield f"calibration: not made yet ({loaded.calibration_path}); {hint}"
    else:
        shipped = [registry.create(name) for name in registry.SHIPPED]
        yield from refusals(shipped, loaded.calibration)
    yield from unconfirmed(loaded, wall_time().date())


@contextmanager
def open_rig(
    rig: AnyRig = "emulated",
    instruments: Sequence[str] = ALL,
    *,
    seed: int | None = None,
    realtime: bool = False,
    leave_running: bool = False,
    capture: CaptureFile | None = None,
    warn: Callable[[str], None] = to_stderr,
) -> Iterator[OpenRig]:
    """Open a rig's ``instruments`` (of arm, bath, stage, operator, cameras). What was made to heat
    or to move is made safe at the end, however that comes, and by a guardian where the process
    dies. ``leave_running``: it goes on. A real rig's arm, bath and stage are this block's alone, as
    a run's. Raises ConfigError, RigInUseError, BringUpError, NotSafeError.
    """
    loaded = load_rig(rig)
    check_within(FROM_0, seed=seed)
    if unknown := [name for name in several("instruments", instruments) if name not in ALL]:
        raise ConfigError.plain(f"no instrument {unknown[0]!r} (there are: {', '.join(ALL)})")
    # no other process can have these cameras and operators
    has_alone = {"arm", "bath", "stage"} & {*instruments}
    lock = lock_path(loaded) if has_alone else None
    with (
        no_lock_is_kept(),
        locked(lock, "open_rig", warn),
        open_instruments(
            loaded,
            tuple(instruments),
            seed=seed,
            realtime=realtime,
            leave_running=leave_running,
            capture=capture,
            warn=warn,
        ) as devices,
    ):
        opened = OpenRig(loaded, devices, warn)
        try:
            yield cast(OpenRig, GuardedProxy(opened, lambda: opened.devices))
        finally:
            opened.leave()
