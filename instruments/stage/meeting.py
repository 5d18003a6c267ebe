"""Meeting a controller: who it is, and what its settings say.

It may not know moves.
"""

from __future__ import annotations

from instruments.errors import DeviceError
from instruments.stage.dialogue import Dialogue
from instruments.stage.protocol import Message, Setting, Welcome
from instruments.stage.settings import StageIdentity, StageSettings, read_settings


def meet(talk: Dialogue, axes: str) -> tuple[StageIdentity, StageSettings]:
    """Wait for the controller's welcome, or reset it, and ask who it is and for its settings.

    Raises DeviceError for firmware or settings that a stage of ``axes`` can't be driven with.
    """
    welcome = talk.start()
    if not welcome.version.startswith("1.1"):
        hint = "Load Grbl 1.1 or grblHAL."
        raise DeviceError(talk.who, f"firmware {welcome.dialect} {welcome.version} speaks another protocol", hint=hint)
    identity = _identity(talk, welcome)
    values = {answer.number: answer.value for answer in talk.command("$$") if isinstance(answer, Setting)}
    return identity, read_settings(values, who=talk.who, axes=axes)


def _identity(talk: Dialogue, welcome: Welcome) -> StageIdentity:
    told = {answer.kind: answer.text for answer in talk.command("$I") if isinstance(answer, Message)}
    return StageIdentity(welcome.dialect, welcome.version, told.get("VER", "").strip(":"), told.get("OPT", ""))
