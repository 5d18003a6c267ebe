"""Access to a controller that speaks lines of ASCII.

Nothing in a reply like ``20.00`` says which command it answers, nor that no character was lost. So
each command of a poll is sent twice, and the two replies have to agree; then the marker is asked,
whose reply can be no other row's: had a line come twice or late, the marker's place would hold
another reply. It is asked between two commands too where the reply to the first would do for the
second: doubled replies would agree there, and one lost later would hide them. After a fault nothing
is used until the marker has been answered and the line was quiet. A number that is changed in
the same way in both replies can't be noticed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, cast

from instruments.bath.access import NO_VALUE, Access, Raw
from instruments.bath.checksums import checked, summed
from instruments.bath.profile import LineProfile, Model, line_to
from instruments.bath.reading import BathReading
from instruments.bath.rows import LineRow, fits
from instruments.bath.session import BrokenError, RefusedError, Session
from instruments.clock import Clock
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Tap

ASKS = 4  # of one command, until two replies in a row agree
ATTEMPTS = 2  # of a whole question, the second one on a line that was made quiet
SYNC_S = 4.0  # the longest wait for a line that is quiet and answers the marker
LONGEST = 200  # characters of a reply


@dataclass(slots=True)
class SentCommand:
    """One command that was sent, until its reply has come."""

    command: str
    sent_s: float
    reply: str | None = None


class Lines(Session):
    """Sends commands and takes lines. ``in_step``: no late line can be taken for the next reply."""

    def __init__(
        self, url: str, profile: LineProfile, clock: Clock, *, who: str, tap: Tap | None
    ) -> None:
        super().__init__(line_to(url, profile, who), clock, who=who, tap=tap)
        self.expected_protocol = (
            f"{profile.family}'s lines of ASCII, at this rate and with this parity"
        )
        self._profile = profile
        self._gap_s = profile.gap_s if self.line.gap_s is None else self.line.gap_s
        self._end = profile.end.encode("ascii")
        self._reply_end = profile.reply_end.encode("ascii")
        self.begin()

    def begin(self) -> None:
        self._buffer = b""
        self._open: SentCommand | None = None  # a reply to it is awaited
        self._damaged = ""  # a line since then whose check sum is wrong
        self.in_step = False

    def take(self, data: bytes) -> None:
        """Lines; one that is not awaited is dropped, and shows that we are out of step."""
        self._buffer += data
        while self._reply_end in self._buffer:
            raw, self._buffer = self._buffer.split(self._reply_end, 1)
            line = raw.decode("ascii", errors="replace").strip()
            content = checked(line, self._profile.checksum, self._profile.checksum_skip)
            if self._open and self._open.reply is None and content is not None:
                self._open.reply = content.strip()
            else:
                self.in_step = False
                self._damaged = line if content is None else ""
        if len(self._buffer) > LONGEST:
            self._buffer, self.in_step = b"", False

    def ask(self, command: str) -> str:
        """The next line after ``command``. Raises LinkError where none comes in time."""
        question = self._put(command, answered=True)
        self._wait(question)
        if question.reply is None:
            self.in_step = False
            seen, self._buffer = self._buffer or self._damaged.encode(), b""
            what = "only a part of an answer came" if seen else "no answer"
            what = "the check sum of its answer is wrong" if self._damaged else what
            took_s = self.clock.now() - question.sent_s
            hint = "Is the controller on, and are the rate, the parity and the cable right?"
            raise LinkError(
                self.who, what, asked=command, seen=seen or None, seconds=took_s, hint=hint
            )
        return question.reply

    def send(self, command: str) -> None:
        """Send a command that nothing answers."""
        self._put(command, answered=False)

    def become_quiet(self, until_s: float) -> None:
        """Drop what comes until nothing has come for the profile's ``quiet_s``."""
        self._open = None
        self.received_s = self.clock.now()
        while True:
            received_s = self.received_s
            end_s = min(until_s, received_s + self._profile.quiet_s)
            if self.clock.now() >= end_s:
                break
            self.receive_until(end_s, lambda before=received_s: self.received_s != before)  # type: ignore[misc]
        self._buffer = b""

    def close(self) -> None:
        self._open, self.in_step = None, False
        super().close()

    def _put(self, command: str, *, answered: bool) -> SentCommand:
        # an event of virtual time may ask in the midst of another question: that one comes first
        if self._open is not None:
            self._wait(self._open)
        self.clock.sleep(self.received_s + self._gap_s - self.clock.now())
        link = self.up()
        if self.drop_unasked(link):
            self.in_step = False
        self._buffer, self._damaged = b"", ""
        question = SentCommand(command, self.clock.now())
        self._open = question if answered else None
        line = summed(command, self._profile.checksum, self._profile.checksum_skip)
        try:
            link.write(line.encode("ascii") + self._end)
        except LinkError as error:
            raise self.broken("the link broke", command) from error
        return question

    def _wait(self, question: SentCommand) -> None:
        if question.reply is None:
            characters = len(question.command) + LONGEST // 4
            until_s = question.sent_s + self._profile.timeout_s + characters * self.line.character_s
            self.receive_until(until_s, lambda: question.reply is not None)
            if question.reply is None and not self.connected:
                raise self.broken("the link broke", question.command)


LEAST_REPLIES = 4  # the same to fewer commands may be chance


class LineAccess(Access[LineRow]):
    """The rows of ``profile`` at ``url``. Raises LinkError for a URL that the family can't have."""

    SHOWN: ClassVar[tuple[str, ...]] = ("version", "model", "firmware", "cut_out")
    SHOWS_ABSENCE: ClassVar[tuple[type[InstrumentError], ...]] = (RefusedError, LinkError)
    remote: ClassVar[str] = "remote control"
    profile: LineProfile
    wire: Lines

    def __init__(
        self,
        url: str,
        profile: LineProfile,
        clock: Clock,
        who: str,
        allow_inferred: bool = False,
        tap: Tap | None = None,
    ) -> None:
        wire = Lines(url, profile, clock, who=who, tap=tap)
        super().__init__(url, profile, wire, who=who, allow_inferred=allow_inferred)
        self._family = profile
        self._marker = profile.row(profile.marker)
        self._mark = ""  # what the marker answers
        self._said: list[str] = []  # of rows that were tried

    def detect_format(self) -> None:
        """Learn which model of the family it is, and take its rows."""
        self._find_mark()
        self._take_model(next((one for one in self._family.models if self._is_model(one)), None))

    def first_poll(self) -> BathReading:
        """Without the rows that the model does not answer."""
        self.note_absent(self.rows_in_use)
        return self.poll_now()

    def _is_model(self, model: Model) -> bool:
        if not model.unanswered:
            return model.fits(self._mark)
        try:
            self.replies([self._family.row(model.unanswered)])
        except BrokenError:
            raise
        except (LinkError, RefusedError):
            return True
        return False

    def _take_model(self, model: Model | None) -> None:
        self.profile = self._family.of_model(model)
        here = {row.name for row in self.profile.rows}
        why = f"the profile knows no model that says {self._mark!r}"
        why = f"the profile says so of {self._mark!r}" if model else why
        gone = (row.name for row in self._family.rows if row.name not in here)
        self.absent = dict.fromkeys(gone, why)

    def fetch(self, start_s: float) -> Mapping[str, Raw]:
        rows = [row for row in self.profile.rows if row.poll and self.may_ask(row)]
        lines = self.replies(rows)
        self.check_deadline(start_s, len(lines))
        return {row.name: lines[row.ask] for row in rows}

    def diagnoses(self, raw: Raw) -> Iterator[str]:
        return self.assembler.in_fahrenheit(self.decode(self.profile.row("temperature"), raw))

    def ask(self, row: LineRow) -> str:
        if row.is_text:
            raise LimitError(self.who, f"{row.name} is a text, and has no value")
        return self.replies([row])[row.ask]

    def probe(self, row: LineRow) -> object:
        return self.replies([row])

    def decode(self, row: LineRow, raw: Raw) -> float:
        return row.decode(cast(str, raw))

    def as_written(self, row: LineRow, value: float) -> float:
        return row.sent(value)

    def write(self, row: LineRow, value: float, *, urgent: bool) -> None:
        if not urgent:
            self._come_in_step()
        if command := row.command(value):
            self._send(row, command, urgent=urgent)
            self.clock.sleep(self.profile.settle_s)

    def _send(self, row: LineRow, command: str, *, urgent: bool) -> None:
        """Send a write, and take its answer."""
        confirm = self.profile.confirm if row.confirm is None else row.confirm
        if not confirm:
            self.wire.send(command)
            return
        try:
            reply = self.wire.ask(command)
        except BrokenError:
            raise
        except LinkError:
            if urgent:  # reading it back decides
                return
            raise
        if not fits(confirm, reply):
            self.wire.in_step = False
            if not urgent:
                raise self._no(f"the answer to a write is {confirm!r}", command, reply)

    def replies(self, rows: Sequence[LineRow]) -> dict[str, str]:
        """The reply to each command of ``rows``, each asked until two agree, with the marker where
        needed. Raises LinkError, ProtocolError, RefusedError.
        """
        commands = list(dict.fromkeys(row.ask for row in rows))
        for attempt in range(1, ATTEMPTS + 1):
            self._come_in_step()
            try:
                found: dict[str, str] = {}
                for command, following in pairwise([*commands, ""]):
                    found[command] = reply = self._sure(command)
                    if not following or self._fits_all(following, reply):
                        self._expect_mark()
            except BrokenError:
                raise
            except (LinkError, ProtocolError):
                self.wire.in_step = False
                if attempt == ATTEMPTS:
                    raise
            else:
                return found
        raise AssertionError("an attempt returns or raises")

    def asking(self, row: LineRow) -> str:
        return repr(row.ask)

    def run_rows(self) -> Sequence[LineRow]:
        if self.known:
            return super().run_rows()
        others = (self._family.of_model(one) for one in self._family.models if "run" in one.rows)
        return [self._family.row("run"), *(other.row("run") for other in others)]

    def rows_to_try(self) -> Sequence[LineRow]:
        try:
            self.detect_format()
        except BrokenError:
            raise
        except InstrumentError:  # the marker may be what is not known yet
            self._take_model(None)
        return [self.profile.find(row.name) or row for row in self._family.rows]

    def try_row(self, row: LineRow) -> tuple[float, str]:
        wire = self.wire
        if not wire.in_step:  # the marker may be among what is not known yet
            wire.become_quiet(self.clock.now() + SYNC_S)
            wire.in_step = True
        reply = wire.ask(row.ask)
        self._said.append(reply)
        if len(self._said) >= LEAST_REPLIES and len(set(self._said)) == 1:
            self.doubt = f"{reply!r} is the reply to each of {len(self._said)} commands"
        else:
            self.doubt = ""
        if self._refuses([row], reply) or not row.understands(reply):
            forms = " or ".join(map(repr, (*row.forms, *row.absent)))
            raise self._no(f"the profile expects {forms}", row.ask, reply)
        value = row.decode(reply)
        meaning = "text" if row.is_text else self.shown(row, value)
        return value, f"{meaning} (got {reply!r})"

    def show(self, rows: Sequence[LineRow]) -> Iterator[str]:
        lines = self.replies(rows) if rows else {}
        for row in rows:
            line = lines[row.ask]
            value = row.decode(line)
            number = self.shown(row, value) if row.is_possible(value) else NO_VALUE
            yield row.text(line) if row.is_text else number

    def _rows_of(self, command: str) -> Sequence[LineRow]:
        return [row for row in self.profile.rows if row.ask == command]

    def _fits_all(self, command: str, reply: str) -> bool:
        return all(row.understands(reply) for row in self._rows_of(command))

    def _understood(self, command: str) -> str:
        """The reply to ``command``, once."""
        reply = self.wire.ask(command)
        if self._refuses(self._rows_of(command), reply) or not self._fits_all(command, reply):
            raise self._no("what came is no answer to this", command, reply)
        return reply

    def _refuses(self, rows: Sequence[LineRow], reply: str) -> bool:
        """Whether ``reply`` refuses, and is no value of ``rows`` itself, as a status may be."""
        value = rows and all(not row.is_text and row.understands(reply) for row in rows)
        return not value and self.profile.refusal(reply) is not None

    def _sure(self, command: str) -> str:
        """The reply to ``command``, the same twice in a row for each of its rows."""
        before, rows = self._understood(command), self._rows_of(command)
        for _ in range(ASKS - 1):
            after = self._understood(command)
            if all(row.agrees(before, after) for row in rows):
                return after
            before = after
        what = f"in {ASKS} answers to the same question no two in a row agree"
        raise self._unexpected(what, command, before)

    def _expect_mark(self) -> None:
        reply = self._marker.text(self.wire.ask(self._marker.ask))
        if reply != self._mark:
            what = "an answer came twice, late or changed: nothing of it is used"
            raise self._unexpected(what, self._marker.ask, reply)

    def _come_in_step(self) -> None:
        """See that no line is under way that could be taken for the next reply."""
        if self.wire.in_step:
            return
        if not self._mark:
            self._find_mark()
            return
        start_s, error = self.clock.now(), None
        while self.clock.now() - start_s < SYNC_S:
            self.wire.become_quiet(start_s + SYNC_S)
            self.wire.in_step = True
            try:
                self._expect_mark()
            except BrokenError:
                raise
            except (LinkError, ProtocolError) as fault:
                error = fault
            else:
                return
            self.wire.in_step = False
        what, took_s = "it gives no clear answer", self.clock.now() - start_s
        raise LinkError(
            self.who, what, asked=self._marker.ask, seconds=took_s, hint=str(error or "")
        )

    def _find_mark(self) -> None:
        """Learn what the marker answers: the same twice, and no reply that another row has."""
        self.wire.become_quiet(self.clock.now() + SYNC_S)
        self.wire.in_step = True
        # on a line with a half command of another host's the first answer is a complaint
        first, mark = self.wire.ask(self._marker.ask), ""
        for _ in range(ASKS):
            mark = self.wire.ask(self._marker.ask)
            if self._marker.text(mark) == self._marker.text(first):
                first = mark
                break
            first = mark
        others = {row.ask for row in self.profile.rows if row.ask and not row.is_text}
        others -= {self._marker.ask}
        like = next((ask for ask in others if self._fits_all(ask, mark)), "")
        refused = self.profile.refusal(mark) is not None
        if mark != first or refused or like or not self._marker.understands(mark):
            self.wire.in_step = False
            why = f", it may be the answer to {like}" if like else ""
            what = f"its {self._marker.name} is none of a {self.profile.family}{why}"
            hint = "Is it another family, or set to another rate or parity?"
            raise DeviceError(self.who, what, asked=self._marker.ask, seen=mark, hint=hint)
        self._mark = self._marker.text(mark)

    def _no(self, what: str, command: str, reply: str) -> DeviceError | ProtocolError:
        """The error of a reply that refuses ``command``, or else is wrong."""
        if meaning := self.profile.refusal(reply):
            what = f"refused: {meaning}"
            return RefusedError(self.who, what, asked=command, seen=reply)
        return self._unexpected(what, command, reply)

    def _unexpected(self, what: str, command: str, reply: str) -> ProtocolError:
        hint = f"Is this a {self.profile.family}, and is the cable sound?"
        return ProtocolError(self.who, what, asked=command, seen=reply, hint=hint)
