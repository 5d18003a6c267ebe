"""Finds and loads the rig file, with the files that it names, and boards' descriptions."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import Field, model_validator

from bench.config import (
    ConfigError,
    FileTable,
    KeyPath,
    did_you_mean,
    find_places,
    located,
    read_calibration,
    read_config,
    read_text,
)
from bench.rig.arm_files import TableFrame, Verification, load_frame, load_verification
from bench.rig.model import Rig
from bench.rig.scripted_answers import load_answers
from bench.rig.urls import EMULATED, SCRIPT
from detector.calibration import Calibration
from detector.calibration.boards import DICTIONARIES, Board, BoardKind
from instruments.bath.profile import Profile, RelayProfile, load_profile, load_relay
from instruments.device_file import DeviceFileError
from instruments.drivers.bath import profile_of
from instruments.drivers.entry_points import PluginUrl, plugin_url
from instruments.drivers.entry_points import load as load_driver
from instruments.errors import LimitError
from instruments.microscribe.unit import ArmIdentity, load_unit
from instruments.world.boards import Pattern

RIGS = Path(__file__).parents[1] / "rigs"
# what lies there and can't be run
NO_RIGS = ("calibration", "thesis-calibration", "depth-calibration", "lab.example")
T = TypeVar("T")
TO_COPY = RIGS / "lab.example.toml"
MISSING = "NOT FOUND: fill it in"  # what `init` writes beside the url of what it did not find
PLACES = {  # and the url, by table
    "arm": "/dev/ttyUSB0",
    "bath": "tcp://192.168.0.40:502",
    "cameras.left": "opencv:LEFT",
    "cameras.right": "opencv:RIGHT",
}


@dataclass(frozen=True, slots=True)
class LoadedRig:
    """A rig file as read. ``made_calibration`` is None where it has still to be made."""

    path: Path
    text: str
    rig: Rig
    profile: Profile
    calibration_path: Path
    made_calibration: Calibration | None
    frame: TableFrame | None = None
    verification: Verification | None = None
    arm_unit: ArmIdentity | None = None
    relay: RelayProfile | None = None

    @property
    def calibration(self) -> Calibration:
        """The calibration. Raises ConfigError where none has been made yet."""
        if self.made_calibration is None:
            how = "make it with 'teatbench calibrate' ('teatbench help calibration')"
            if self.rig.emulated:
                shipped_one = RIGS / "calibration.toml"
                how = f"the emulated cameras are made from it: copy the shipped one, {shipped_one}"
            message = f"no such file beside the rig file ({self.calibration_path}); {how}"
            raise located(self.path, self.text, [(("calibration",), message, False)])
        return self.made_calibration

    @property
    def profile_source(self) -> str:
        """What another process loads the bath's profile by: a shipped name, or a whole path."""
        return self._source(self.rig.bath.profile)

    @property
    def relay_source(self) -> str:
        """As ``profile_source``, of the pump's relay; empty where there is none."""
        return self._source(self.rig.bath.pump_profile)

    def unfilled(self, *instruments: str) -> list[str]:
        """Where a url, of ``instruments`` or of all, still is what `init` wrote for want of one."""
        places, lines, found = find_places(self.text), self.text.split("\n"), []
        for table, url in PLACES.items():
            place = places.get((*table.split("."), "url"))
            line = lines[place.line - 1] if place else ""
            asked = not instruments or table.partition(".")[0] in instruments
            if place and asked and f'"{url}"' in line and MISSING in line:
                found.append(f"not filled in yet: {self.path}:{place.line} ({table}.url)")
        return found

    def refuse_unfilled(self, *instruments: str) -> None:
        """Raises ConfigError where `unfilled` finds something."""
        if found := self.unfilled(*instruments):
            how = "Write there how the instrument is reached ('teatbench help rig')."
            raise ConfigError.plain("\n".join((*found, how)))

    def _source(self, name: str) -> str:
        return str((self.path.parent / name).resolve()) if name.endswith(".toml") else name

    @property
    def answer_files(self) -> dict[str, str]:
        """The text of the script of answers, by its name; none where something else answers."""
        url = self.rig.operator.url
        return self._texts(url.removeprefix(SCRIPT)) if url.startswith(SCRIPT) else {}

    @property
    def arm_files(self) -> dict[str, str]:
        """The text of each file about the arm, by its name."""
        return self._texts(self.rig.arm.frame, self.rig.arm.verification)

    def _texts(self, *names: str) -> dict[str, str]:
        return {Path(name).name: read_text(self.path.parent / name) for name in names if name}


def find_rig(name: str | None) -> Path:
    """A shipped rig by name, or any by path; None: the emulated one. Raises ConfigError."""
    if name == TO_COPY.stem:
        return TO_COPY
    return find_shipped("emulated" if name is None else name, RIGS, "rig", exclude=NO_RIGS)


def find_shipped(name: str, folder: Path, kind: str, exclude: tuple[str, ...] = ()) -> Path:
    """``name`` as a path, or of a file in ``folder``. Raises ConfigError."""
    if name.endswith(".toml") or Path(name).is_file():
        return Path(name)
    known = [stem for stem in shipped(folder) if stem not in exclude]
    if name in known:
        return folder / f"{name}.toml"
    if name and Path(name).is_dir():
        raise ConfigError.plain(f"{name} is a folder. Give the path of a .toml file.")
    near, there = did_you_mean(name, known) or ".", ", ".join(known)
    raise ConfigError.plain(
        f'no {kind} "{name}"{near} Shipped: {there}; or give the path of a .toml file.'
    )


def shipped(folder: Path) -> list[str]:
    """Names of the TOML files in ``folder``, without their ending."""
    return sorted(path.name.removesuffix(".toml") for path in folder.glob("*.toml"))


def load_rig(path: Path) -> LoadedRig:
    """The rig file at ``path`` with its calibration. Raises ConfigError with all faults."""
    rig = read_config(path, Rig)
    text, folder = read_text(path), path.parent

    def refuse(message: str, *keys: KeyPath) -> ConfigError:
        return located(path, text, [(key, message, False) for key in keys])

    def place(name: str) -> Path | str:
        return folder / name if name.endswith(".toml") else name

    if plug := plugin_url(rig.bath.url):
        profile = _of_plugin(plug, refuse)
    else:
        profile = _loaded(lambda: load_profile(place(rig.bath.profile)))
    hands = rig.operator.url == EMULATED and not {"arm", "cameras"} & set(rig.emulated)
    if hands and not plugin_url(rig.arm.url):  # which may touch by itself
        message = (
            "emulated hands can't touch a real phantom: a person has to, or the arm or the cameras"
            " are emulated too"
        )
        raise refuse(message, ("operator", "url"))
    emulated_stage = rig.stage if rig.stage and rig.stage.url == EMULATED else None
    if emulated_stage and (wrong := rig.emulation.stage.fault(emulated_stage)):
        raise refuse(wrong, ("stage", "axes"))
    there, faults = {*rig.urls, "pump" if rig.bath.pump_url else ""}, rig.emulation.faults
    if absent := [i for i, fault in enumerate(faults) if fault.instrument not in there]:
        keys = [("emulation", "faults", i, "instrument") for i in absent]
        raise refuse("this rig has no such instrument", *keys)
    frame = load_frame(folder / rig.arm.frame) if rig.arm.frame else None
    dated = load_verification(folder / rig.arm.verification) if rig.arm.verification else None
    unit_path = folder / rig.emulation.arm_unit
    unit = _loaded(lambda: load_unit(unit_path)) if rig.emulation.arm_unit else None
    if wrong := _relay_fault(rig, profile):
        raise refuse(wrong, ("bath", "pump_url" if rig.bath.pump_url else "pump_profile"))
    pump = rig.bath.pump_profile
    relay = _loaded(lambda: load_relay(place(pump))) if pump else None
    if rig.operator.url.startswith(SCRIPT):
        # its faults are found before anything is opened
        load_answers(folder / rig.operator.url.removeprefix(SCRIPT))
    calibration_path = folder / rig.calibration
    calibration = read_calibration(calibration_path) if calibration_path.is_file() else None
    loaded = LoadedRig(
        path, text, rig, profile, calibration_path, calibration, frame, dated, unit, relay
    )
    if rig.emulated:
        _ = loaded.calibration  # the emulated cameras are made from it
    return loaded


AnyRig = str | Path | LoadedRig


def any_rig(rig: AnyRig | None = "emulated") -> LoadedRig:
    """A shipped rig by name, one by its file, or None: the emulated one. Raises ConfigError."""
    name = None if rig is None else str(rig)
    return rig if isinstance(rig, LoadedRig) else load_rig(find_rig(name))


def _of_plugin(plug: PluginUrl, refuse: Callable[..., ConfigError]) -> Profile:
    """What a plug-in's class says of its bath. Raises ConfigError."""
    try:
        return profile_of(load_driver("bath", plug))
    except LimitError as error:
        raise refuse(str(error), ("bath", "url")) from error


def _relay_fault(rig: Rig, profile: Profile) -> str | None:
    """What is wrong with the relay that switches the pump; None where the rig has none."""
    bath = rig.bath
    if not (bath.pump_url or bath.pump_profile):
        return None
    if not (bath.pump_url and bath.pump_profile):
        missing = "pump_profile" if bath.pump_url else "pump_url"
        return f"{missing} is missing: a pump's relay has both, or there is none"
    if (bath.url == EMULATED) != (bath.pump_url == EMULATED):
        return (
            f'bath and pump are both emulated or both real: "{EMULATED}" stands in url and in'
            " pump_url, or in neither"
        )
    if profile.capabilities.pump != "none":
        return f"{profile.family} has a pump of its own: leave pump_url and pump_profile out"
    return None


def _loaded(load: Callable[[], T]) -> T:
    try:
        return load()
    except DeviceFileError as error:
        faults = [(keys, message, False) for keys, message in error.faults]
        raise located(error.path, read_text(error.path), faults) from error


BOARDS = Path(__file__).parents[1] / "boards"


class BoardFile(FileTable):
    """``columns``, ``rows`` of inner corners or circles, and ``pitch_mm`` with ``pitch_u_mm``."""

    kind: BoardKind
    columns: Annotated[int, Field(ge=3, le=100)]
    rows: Annotated[int, Field(ge=3, le=100)]
    pitch_mm: Annotated[float, Field(ge=0.1, le=1000)]
    marker_mm: Annotated[float, Field(gt=0)] | None = None
    dictionary: str | None = None
    circle_mm: Annotated[float, Field(gt=0)] | None = None
    pitch_u_mm: Annotated[float, Field(ge=0, le=1)] = 0.0

    @model_validator(mode="after")
    def _whole(self) -> BoardFile:
        self.board  # noqa: B018 - raises what is wrong with the parts together
        return self

    @property
    def board(self) -> Board:
        return Board(**self.model_dump(exclude={"pitch_u_mm"}))


BOARD_WORD = re.compile(r"(?:checker|chess)board:(\d{1,5})x(\d{1,5}):(\d{1,5}(?:\.\d{1,5})?)mm")


def find_board(name: str | None) -> tuple[Board, tuple[Path, ...]]:
    """A shipped board by name, any by its file, or by its figures (``checkerboard:5x7:30mm``, inner
    corners); and the file, if any. Raises ConfigError.
    """
    if name and re.match(r"\w\w+:", name) and not Path(name).is_file():
        found = BOARD_WORD.fullmatch(name)
        if found is None:
            raise ConfigError.plain(
                f'"{name}" is no board; write checkerboard:5x7:30mm for 5 x 7 inner corners, 30 mm'
                " apart"
            )
        try:
            return Board("chessboard", int(found[1]), int(found[2]), float(found[3])), ()
        except ValueError as error:
            raise ConfigError.plain(f"{name}: {error}") from error
    if not name:
        raise ConfigError.plain(
            "a board is needed: what is in the pictures. Shipped:"
            f" {', '.join(shipped(BOARDS))}; or checkerboard:5x7:30mm (inner corners, and their"
            " distance), or the path of a .toml file."
        )
    path = find_shipped(name, BOARDS, "board")
    return load_board(path).board, (path,)


def load_board(path: Path) -> BoardFile:
    return read_config(path, BoardFile)


def drawn(board: Board, margin: float) -> Pattern:
    """What the scene draws: squares where ``board`` counts points; ``margin`` in pitches."""
    more = 0 if board.kind == "circles" else 1
    return Pattern(
        board.kind,
        board.columns + more,
        board.rows + more,
        board.pitch_mm,
        margin * board.pitch_mm,
        DICTIONARIES[board.dictionary] if board.dictionary else Pattern().dictionary,
        board.marker_mm or board.circle_mm or 0.0,
    )
