"""Rig files and trial scripts: shipped ones by name, any by its file."""

from __future__ import annotations

from pathlib import Path

from bench.rig.loading import NO_RIGS, RIGS, any_rig, shipped
from bench.rig.loading import AnyRig as AnyRig
from bench.script.model import TRIALS, LoadedScript, find_script
from bench.script.model import load_script as load_script_file

OUT = Path("runs")
AnyScript = str | Path | LoadedScript | None
load_rig = any_rig


def rigs() -> tuple[str, ...]:
    """The names of the rig files that ship and can be opened as they are."""
    return tuple(name for name in shipped(RIGS) if name not in NO_RIGS)


def scripts() -> tuple[str, ...]:
    """The names of the trial scripts that ship."""
    return tuple(shipped(TRIALS))


def load_script(script: AnyScript = None, rig: AnyRig | None = None) -> LoadedScript:
    """A shipped script by name, or any by its file; the six situations for None. Held against the
    set points of ``rig``, where given. Raises ConfigError with all faults.
    """
    if isinstance(script, LoadedScript):
        return script
    limits_c = load_rig(rig).rig.limits.set_point_c if rig is not None else None
    return load_script_file(find_script(None if script is None else str(script)), limits_c)
