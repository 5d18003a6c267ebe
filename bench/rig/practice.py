"""What a person does to an emulated rig by hand, to practise: each cable pulled and put back, the
room warmer or cooler, the stage jammed and freed.

Beside a run in real time it is left as a line of `practice.jsonl` in the run's folder, which the
process with the emulators reads, and which stays as a note of what was done when. `teatbench
emulate` has it on a page.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig
from bench.toml import toml_text
from instruments.camera.cameras import KNOWN
from instruments.clock import Clock, wall_time
from instruments.drivers.entry_points import plugin_url
from instruments.stage.emulator.board import StageFault
from textfiles.whole import replace_whole

REQUESTS = "practice.jsonl"
SHOWN = "practice.json"  # in the run's folder, while the emulators are up
CAMERA = "{} camera"
LOOK_S, JAM_S = 0.2, 0.5  # of real time
STEP_K = 2.0
COOLEST_C, WARMEST_C = 0.0, 40.0
OUT, JAMMED = "OUT", "JAMMED"
PULL, PUT_BACK = "pull", "put back"
WARM, COOL, JAM, FREE = "warm the room", "cool the room", "jam the stage", "free the stage"


ROW = '<form method="post" class="{kind}"><span>{of}</span><b>{how}</b>{buttons}</form>'
BUTTON = '<button name="words" value="{0}" aria-label="{0}">{1}</button>'


@dataclass(frozen=True, slots=True)
class PracticeState:
    """How the rig stands: ``cables`` True where plugged in; ``jammed`` None without a stage."""

    cables: Mapping[str, bool]
    room_c: float
    bath_c: float
    jammed: bool | None

    def choices(self) -> Iterator[tuple[str, str, Mapping[str, str]]]:
        """What can be done next: about what, how that stands; label and words of each button."""
        for name, plugged in self.cables.items():
            word, how = (PULL, "in") if plugged else (PUT_BACK, OUT)
            yield f"{name} cable", how, {word: f"{word} {name}"}
        if self.jammed is not None:
            yield "stage", *((JAMMED, {"free": FREE}) if self.jammed else ("free", {"jam": JAM}))
        yield "room", f"{self.room_c:.0f} °C", {"warm": WARM, "cool": COOL}


@dataclass(slots=True)
class Practice:
    """Acts on ``twin``. ``pull_camera`` gets a camera and whether its cable is out, where others
    than the emulated rig's own readers have its pictures.
    """

    twin: EmulatedRig
    pull_camera: Callable[[str, bool], None] | None = None
    _out: set[str] = field(default_factory=set)
    _jammed: bool = False

    @property
    def shown(self) -> PracticeState:
        plugged_in = self.twin.listeners
        names = (*plugged_in, *(() if "cameras" in plugged_in else map(CAMERA.format, KNOWN)))
        jammed = self._jammed if self.twin.stage else None
        world = self.twin.world
        cables = {name: name not in self._out for name in names}
        return PracticeState(cables, world.ambient_c, round(world.plant.bath_c, 1), jammed)

    def do(self, words: str) -> None:
        """Raises ValueError for words that this rig has no meaning for."""
        if not any(words in known.values() for _, _, known in self.shown.choices()):
            raise ValueError(f"not understood, or done already: {words!r}")
        world = self.twin.world
        if words in (WARM, COOL):
            to_c = world.ambient_c + (STEP_K if words == WARM else -STEP_K)
            world.set_room(min(max(to_c, COOLEST_C), WARMEST_C))
        elif words in (JAM, FREE):
            self._jammed = words == JAM
            self.jam_again()
        else:
            name, out = words.removeprefix(PULL).removeprefix(PUT_BACK).strip(), PULL in words
            (self._out.add if out else self._out.discard)(name)
            if name in self.twin.listeners:
                self.twin.listeners[name].pull(out=out)
            else:
                pull_camera = self.pull_camera or self.twin.cameras.pull
                pull_camera(name.removesuffix(CAMERA.format("")), out)

    def jam_again(self) -> None:
        """A stall is over with the motion that it struck; a jam stays until it is freed."""
        if stage := self.twin.stage:
            with self.twin.world.lock:
                (stage.inject if self._jammed else stage.cure)(StageFault.STALL)

    def keep_jammed(self, clock: Clock) -> None:
        """As `jam_again`, from now on."""
        self.jam_again()
        clock.call_at(clock.now() + JAM_S, lambda: self.keep_jammed(clock))


def page_of(practice: Practice) -> str:
    """The page of buttons, as the rig stands now."""
    shown = practice.shown
    rows = [
        ROW.format(
            kind="bad" if how in (OUT, JAMMED) else "",
            of=of.capitalize(),
            how=how,
            buttons="".join(BUTTON.format(words[on], on.capitalize()) for on in words),
        )
        for of, how, words in shown.choices()
    ]
    page = Path(__file__).with_suffix(".html").read_text(encoding="utf-8")
    return page.format(bath_c=shown.bath_c, rows="\n".join(rows))


def leave(folder: Path, words: str) -> None:
    """Leave ``words`` for the emulators of the run in ``folder``. Raises OSError."""
    line = {"wall_time": wall_time().isoformat(timespec="milliseconds"), "words": words}
    with (folder / REQUESTS).open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


@contextmanager
def following(practice: Practice, clock: Clock, speed: float, folder: Path) -> Iterator[None]:
    """Do what is left in ``folder``, and show there how the rig stands."""
    seen, last, over = _left(folder), None, False

    def look() -> None:
        nonlocal seen, last
        if over:
            return
        left = _left(folder)
        for line in left[len(seen) :]:
            with suppress(ValueError, KeyError):
                practice.do(json.loads(line)["words"])
        seen = left
        practice.jam_again()
        if (now := practice.shown) != last:
            choices = [dict(zip(("of", "is", "words"), one, strict=True)) for one in now.choices()]
            data = json.dumps(asdict(now) | {"choices": choices}).encode()
            with suppress(OSError):
                replace_whole(folder / SHOWN, data, again_s=0.0)
                last = now
        clock.call_at(clock.now() + LOOK_S * speed, look)

    look()
    try:
        yield
    finally:
        over = True
        with suppress(OSError):
            (folder / SHOWN).unlink(missing_ok=True)


def _left(folder: Path) -> list[str]:
    try:
        return (folder / REQUESTS).read_text(encoding="utf-8").splitlines()
    except OSError:
        return []


def served_text(rig: LoadedRig, urls: Mapping[str, str], note: str) -> str:
    """The file of ``rig`` with its emulators at ``urls``, for any folder; ``note`` heads it."""
    table = rig.rig.model_dump(exclude={"emulation"}, exclude_unset=True, by_alias=True)
    table["name"] += " (of 'teatbench emulate')"
    for name in ("operator", "arm", "bath", "stage"):
        if name in table:
            plug = plugin_url(table[name]["url"])
            table[name]["url"] = plug.at(urls[name]) if plug else urls[name]
    if "pump" in urls:
        table["bath"]["pump_url"] = urls["pump"]
    if (plug := plugin_url(table["cameras"].get("url", ""))) and plug.emulated:
        table["cameras"]["url"] = plug.at(urls["cameras"])
    else:
        cameras = {name: {"url": urls[name]} for name in ("left", "right", "thermal")}
        skew = {"max_skew_s": 1.0}  # a stream says when a frame arrived, not when it was exposed
        kept = {key: value for key, value in table["cameras"].items() if key != "url"}
        table["cameras"] = kept | skew | cameras
    files = [(table, "calibration"), (table["arm"], "frame"), (table["arm"], "verification")]
    files += [(table["bath"], "profile"), (table["bath"], "pump_profile")]
    for holder, key in files:
        name = holder.get(key, "")
        if name and ("profile" not in key or name.endswith(".toml")):
            holder[key] = (rig.path.parent / name).resolve().as_posix()
    return toml_text(table, note)
