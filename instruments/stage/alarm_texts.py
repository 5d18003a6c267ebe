"""What GRBL's error and alarm numbers mean, and what to do. Source: the firmware's lists, version
1.1; numbers from 10 on as in grblHAL's source.
"""

from __future__ import annotations

import re
from typing import NamedTuple


class Meaning(NamedTuple):
    """What happened, and what a person should do now."""

    what: str
    do: str


_REPORT = "The line that was sent is wrong: report it with the bench's log."


def _table(text: str) -> dict[int, Meaning]:
    """Each entry "number what | do", which may go on in indented lines; "report" is `_REPORT`."""
    table = {}
    for entry in re.split(r"\n(?=\d)", text.strip()):
        number, words = re.sub(r"\s+", " ", entry).split(" ", 1)
        what, do = words.split(" | ")
        table[int(number)] = Meaning(what, _REPORT if do == "report" else do)
    return table


ERRORS = _table("""
1 a G-code word has no letter | report
2 a number is missing or badly written | report
3 the '$' command is not known | Check the firmware: some builds leave commands out ($I lists the
    options).
4 a setting can't be negative | Send a value of zero or more.
5 homing is switched off | Fit the switches and set $22=1.
6 the step pulse is too short | Set $0 to 3 or more.
7 the stored settings could not be read and were set to defaults | Load the stage's own settings
    again ($100 to $132).
8 the command is allowed only when the stage is idle | Wait until the move has finished, or end the
    hold.
9 G-code is locked out by an alarm, or while jogging | Home the stage; after an alarm recover it
    first.
10 soft limits need homing | Set $22=1 before $20=1.
11 the line is longer than the controller's line buffer | Keep lines below 80 characters.
12 the rate asks for more than 30000 steps a second | Lower the maximum rate or the steps per mm.
13 the safety door is open | Close it.
14 the build information or start-up line is too long | Shorten it.
15 the jog goes beyond the travel; it was not started | Jog less far.
16 the jog command is badly formed | report
17 laser mode needs a PWM output | Set $32=0.
20 the controller does not know this G-code word | Check the firmware's version and its build
    options.
21 two words of one modal group stand in a line | report
22 no feed rate has been given yet | Give a feed with the move.
23 a word needs a whole number | report
24 two commands of the line both need the axis words | report
25 a word is repeated in the line | report
26 the command needs axis words and has none | report
27 the line number is out of range | report
28 the command lacks a value | report
29 this work coordinate system does not exist | Use G54 to G59.
30 G53 goes with G0 and G1 only | report
31 axis words are left over | report
32 an arc has no axis word in its plane | report
33 the target of the move is invalid | Check target and limits.
34 the radius of an arc is impossible | report
35 an arc has no offset in its plane | report
36 words are left over | report
37 the tool length offset is not set up for this axis | report
38 the tool number is too large | report
""")

ALARMS = _table("""
1 a limit switch was hit and the position is probably lost | Clear the stage by hand with the power
    off, then recover() and home().
2 a target lay beyond the controller's soft limits; nothing moved there | Check $130 to $132, then
    recover() and home().
3 the controller was reset while moving and the position is lost | Call recover(), then home().
4 the probe was not in its initial state | Check the probe, then recover() and home().
5 the probe found no contact | Check the probe, then recover() and home().
6 homing was ended by a reset | Call recover(), then home().
7 homing was ended by the safety door | Close the door, then recover() and home().
8 a switch stayed closed after the pull-off | Look for a stuck or dirty switch, or raise $27; then
    recover() and home().
9 homing found no switch | Check the switches, their cables and $23, $5; then recover() and home().
10 the two motors of one axis found their switches too far apart | Square the gantry, then recover()
    and home().
""")

HAL_ALARMS = _table("""
10 the emergency stop is pressed | Release it when the cause is gone, then recover() and home().
11 the controller wants to be homed first | Call recover(), then home().
12 a limit switch is closed | Move the stage off it by hand with the power off, then recover() and
    home().
13 the probe's protection has stopped the stage | Check the probe, then recover() and home().
14 a spindle did not reach its speed; a stage has none | Switch the spindle off in its settings,
    then recover() and home().
15 of the two motors of one axis, one did not find its switch in time | Square the gantry, then
    recover() and home().
16 the controller's test of itself failed | Look at its own messages, switch it off and on, then
    recover() and home().
17 a motor driver reports a fault | Check the motor's driver, cable and load, then recover() and
    home().
""")


def error_meaning(code: int) -> Meaning:
    """The meaning of ``error:code``; a number that is not in the table is said to be unknown."""
    return ERRORS.get(code) or Meaning(
        "an error that this program does not know",
        "Look the number up in the firmware's list of errors.",
    )


def alarm_meaning(code: int, dialect: str = "Grbl") -> Meaning:
    """The meaning of ``ALARM:code`` of "Grbl" or "grblHAL"; others are unknown."""
    known = ALARMS | HAL_ALARMS if dialect == "grblHAL" else ALARMS
    return known.get(code) or Meaning(
        "an alarm that this program does not know",
        "Look the number up in the firmware's list of alarms, then recover() and home().",
    )
