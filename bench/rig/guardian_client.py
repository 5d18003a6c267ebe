"""The bench's end of the guardian: signs of life of the bench's threads, and the process that gets
them, which is ended when the bath is safe without it.

A thread says what it does, how long that may take, and how long in silence. Whatever looks at the
clock shows life, so a long move does all the time, while a computation or a prompt may not. A
thread that is silent for longer than it said hangs, and so does one that takes longer in all. Time
is real time: a hung bench is hung in the world, whatever its clock says.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, cast

from bench.rig.guardian import ACTS, ALIVE, DONE, HUNG, READY, TAKE_OVER
from bench.rig.guardian_stage import PLUGIN, StageTarget
from instruments.clock import Clock, RealClock, stopwatch_s
from instruments.errors import LinkError

BRIEF_S = 10.0  # what needs no word of its own is over by then


@dataclass(slots=True)
class _Deadline:
    """What a thread does: ``until_s`` in all, ``silent_until_s`` without a further sign of life."""

    what: str
    thread: int
    at_most_s: float
    until_s: float
    silence_s: float
    silent_until_s: float


class Heartbeat:
    """Who signs, what is being done, and until when. May be used by all threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._doing: dict[str, _Deadline] = {}

    def sign(
        self,
        what: str,
        at_most_s: float = BRIEF_S,
        *,
        silence_s: float | None = None,
        who: str = "the main thread",
    ) -> None:
        """``who`` does ``what`` from now on, for ``at_most_s``, silent for ``silence_s`` of it."""
        now_s, quiet_s = stopwatch_s(), at_most_s if silence_s is None else silence_s
        with self._lock:
            self._doing[who] = _Deadline(
                what, threading.get_ident(), at_most_s, now_s + at_most_s, quiet_s, now_s + quiet_s
            )

    def alive(self, sleep_s: float = 0.0) -> None:
        """Note that the calling thread runs, and that it will sleep for ``sleep_s``."""
        now_s, caller = stopwatch_s(), threading.get_ident()
        with self._lock:
            for doing in self._doing.values():
                if doing.thread == caller:
                    doing.silent_until_s = now_s + sleep_s + doing.silence_s

    def rest(self, who: str) -> None:
        """``who`` has ended as it should, and signs no more."""
        with self._lock:
            self._doing.pop(who, None)

    def overdue(self) -> str | None:
        """Who hangs, and in what; None when all signed in time."""
        now = stopwatch_s()
        with self._lock:
            for who, doing in self._doing.items():
                if now > doing.until_s:
                    return f"{who} hangs: {doing.what} took more than {doing.at_most_s:g} s"
                if now > doing.silent_until_s:
                    return (
                        f"{who} hangs: {doing.what}, and no sign of life for {doing.silence_s:g} s"
                    )
        return None


BEAT_S = 1.0
UNANSWERED = 3  # beats; one more, and the oldest has had no echo for so many times BEAT_S
END_S = 5.0
START_S = 30.0  # a loaded machine reads Python's modules slowly


@dataclass(frozen=True, slots=True)
class GuardianTarget:
    """A bath, and the relay of its pump where it has one; profiles by name or whole path. With a
    ``stage``, or a stage alone (no ``url``).
    """

    url: str = ""
    profile: str = ""
    pump_url: str = ""
    pump_profile: str = ""
    allow_inferred: bool = False
    stage: StageTarget | None = None

    @property
    def arguments(self) -> list[str]:
        given = [f"--url={self.url}", f"--profile={self.profile}"]
        given += [f"--pump-url={self.pump_url}", f"--pump-profile={self.pump_profile}"]
        given += [f"--stage={json.dumps(asdict(self.stage))}"] if self.stage else []
        return [*given, *(["--allow-inferred"] if self.allow_inferred else [])]


class GuardianClient:
    """A running guardian of ``target``, with record and log of this ``name`` in ``folder``. Where
    another one acted on the bath, that one has ended before. Raises LinkError.
    """

    def __init__(
        self, target: GuardianTarget, folder: Path, heartbeat: Heartbeat, name: str = "guardian"
    ) -> None:
        self._heartbeat = heartbeat
        self.taken_from = ""  # who acted on the bath until now, and how that ended
        self.heats = True  # whether the bench may leave the bath on
        self._ended = threading.Event()
        self._said = threading.Event()  # its first line, or its end
        self._ready = False
        self._unanswered = 0
        self._acts = False
        self._log = folder / f"{name}.log"
        command = [sys.executable, "-X", "utf8", "-m", "bench.rig.guardian", *target.arguments]
        record = folder.resolve() / f"{name}.json"
        command += ["--record", str(record), "--bench", str(os.getpid())]
        with self._log.open("wb") as log:
            self._process = _spawn(command, log)
        self._pipe_in = cast(IO[bytes], self._process.stdin)
        self._reader = threading.Thread(target=self._listen, name="guardian", daemon=True)
        self._reader.start()
        self._await_ready(target)
        self._beats = threading.Thread(target=self._beat, name="guardian-client", daemon=True)
        self._beats.start()

    @property
    def pid(self) -> int:
        """The guardian's process."""
        return self._process.pid

    @property
    def lost(self) -> str | None:
        """Why the bath is no longer guarded; None while the guardian runs."""
        code = self._process.poll()
        if self._ended.is_set():
            return None
        if code is None and not self._acts:
            silent = self._unanswered > UNANSWERED
            return f"it has not answered for {UNANSWERED * BEAT_S:g} s" if silent else None
        if code:
            return f"it ended by itself (exit code {code})"
        return "it took the bench for ended and began to put the bath into standby"

    def done(self) -> None:
        """The bath is safe: the guardian may go."""
        self._end(DONE)

    def hand_over(self) -> None:
        """The bath could not be made safe: the guardian goes on trying."""
        self._end(TAKE_OVER)

    def __enter__(self) -> GuardianClient:
        return self

    def __exit__(self, *_: object) -> None:
        """Left without ``done``, the guardian takes the bath over, unless nothing heats."""
        if self._ended.is_set():
            return
        if self.heats:
            self.hand_over()
        else:
            self.done()

    def _end(self, word: str) -> None:
        self._ended.set()
        self._beats.join(END_S)
        with contextlib.suppress(OSError), self._pipe_in:  # it has ended before
            self._say(word)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)
            self._reader.join(END_S)
        # where it goes on, Windows keeps its open log
        with contextlib.suppress(OSError):
            if not self._log.stat().st_size:
                self._log.unlink()

    def _await_ready(self, target: GuardianTarget) -> None:
        """Wait for its first line. Raises LinkError with the end of its log if it is not ready."""
        late = not self._said.wait(START_S)
        if self._ready:
            return
        self._process.kill()
        self._process.wait()
        self._reader.join()
        self._pipe_in.close()
        said = self._log.read_text(encoding="utf-8", errors="replace").strip().rpartition("\n")[2]
        what, hint = "it did not start, so nothing is heated", f"Its log is {self._log}."
        if late:
            what = f"it was not ready after {START_S:g} s, so nothing is heated"
            urls = target.url, target.stage.url if target.stage else ""
            slow = " or ".join(url for url in urls if url.startswith(PLUGIN)) or "this computer"
            hint = f"{slow} is slow: a driver's import may take part of that time. {hint}"
        raise LinkError("guardian", what, seen=said or "nothing", hint=hint)

    def _listen(self) -> None:
        """That it is ready, an echo of each beat, that it acts; on a thread, to its end."""
        with cast(IO[bytes], self._process.stdout) as pipe:
            first, _, self.taken_from = pipe.readline().decode("utf-8", "replace").partition(" ")
            self.taken_from = self.taken_from.strip()
            self._ready = first.strip() == READY
            self._said.set()
            for line in pipe:
                self._acts = self._acts or line.strip() == ACTS.encode()
                self._unanswered = 0
        self._process.wait()  # its end, however late, leaves no zombie

    def _beat(self) -> None:
        while not self._ended.wait(BEAT_S):
            overdue = self._heartbeat.overdue()
            self._unanswered += 1  # before, so that each echo comes after it
            try:
                self._say(HUNG + overdue if overdue else ALIVE)
            except OSError:
                return  # it has ended: ``lost`` says so

    def _say(self, word: str) -> None:
        self._pipe_in.write(word.encode() + b"\n")


def _spawn(command: list[str], log: IO[bytes]) -> subprocess.Popen[bytes]:
    """In a session of its own, or it would get the terminal's Ctrl-C and end with the terminal."""
    flags = ("DETACHED_PROCESS", "CREATE_NEW_PROCESS_GROUP", "HIGH_PRIORITY_CLASS")  # of Windows
    return subprocess.Popen(  # noqa: S603 - our own module
        command,
        bufsize=0,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=log,
        cwd=Path(__file__).resolve().parents[2],
        start_new_session=os.name != "nt",
        creationflags=sum(getattr(subprocess, flag, 0) for flag in flags),
    )


@contextmanager
def signs_of(heartbeat: Heartbeat, clock: Clock) -> Iterator[None]:
    """Whatever looks at a clock of real time shows life."""
    if not isinstance(clock, RealClock):
        yield
        return
    clock.subscribe(heartbeat.alive)
    try:
        yield
    finally:
        clock.subscribe(None)
