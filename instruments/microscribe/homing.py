"""Whether an arm's counts mean positions: only after the operator has said so, in this power cycle.

An arm that was not homed gives plausible, wrong positions with no sign of it (../shared/instruments/microscribe.md, What the
maker states), so the answer is no whenever there is a doubt. It may not know the wire.
"""

from __future__ import annotations

from instruments.microscribe.refusals import NotHomedError

_CONFIRM_HINT = (
    "Confirm it if the stylus sat on its peg when the arm was last switched on; "
    "else put the stylus on its peg, switch the arm off and on, sign on, and confirm"
)
_HOME_HINT = "Put the stylus on its peg and home the arm ('teatbench arm home'), or switch it off and on there and sign on again"
_AT_FIRST = "it has not been confirmed since sign-on"


class Homing:
    """What is known of one arm's homing, and why it isn't confirmed."""

    def __init__(self, who: str) -> None:
        self._who = who
        self.confirmed = False
        self._why = _AT_FIRST
        self._doubt = ""

    def signed_on(self, doubt: str = "") -> None:
        """A new session. With a ``doubt`` no word of the operator helps: only homing, or a power cycle and a new sign-on."""
        self.confirmed = False
        self._doubt = doubt

    def lost(self, why: str) -> None:
        """Something happened after which nobody knows; the reason is told until homing is confirmed again."""
        if self.confirmed:
            self._why = why
        self.confirmed = False

    def confirm(self) -> None:
        """The operator says that the arm was homed. Raises NotHomedError while there is a doubt that only homing removes."""
        if self._doubt:
            raise NotHomedError(self._who, self._doubt, asked="to confirm homing", hint=_HOME_HINT)
        self.homed()

    def homed(self) -> None:
        """The arm has just loaded its home counts with its stylus on the peg."""
        self.confirmed, self._why, self._doubt = True, _AT_FIRST, ""

    def require(self, asked: str) -> None:
        """Raise NotHomedError unless homing is confirmed."""
        if not self.confirmed:
            why = self._doubt or self._why
            what = f"no positions before homing is confirmed: {why}. An arm that was not homed gives plausible, wrong ones"
            raise NotHomedError(self._who, what, asked=asked, hint=_HOME_HINT if self._doubt else _CONFIRM_HINT)
