"""Trials that tests do, as a run with a record and a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path

from bench.api.loading import load_rig
from bench.api.runs import write_report
from bench.api.shots import Shot, open_detector
from bench.config import ConfigError, did_you_mean, parse_config, read_config, read_text
from bench.results.answers import Examiner, name_of, score_answer
from bench.results.status import Reported
from bench.results.verdicts import TESTS_FACT
from bench.run.start import ScoredFrames, kind_facts
from bench.scoring.scene import SceneScore
from bench.script.model import RECORDING_RULES, Rules
from bench.toml import toml_text
from bench.truth.touching import truth_row
from detector.protocol import Detector

ABOUT = "Trials that tests did."


class TrialsOfTests:
    """Begins a run with the first trial. ``required``: names of the requirements that are decided,
    all of the ``rules`` without one. Raises ConfigError for one that the rules don't have.
    """

    def __init__(
        self,
        rig: str,
        detector: str,
        out: Path,
        rules: Path | None,
        required: Mapping[str, Sequence[str]],
    ) -> None:
        path = rules or RECORDING_RULES
        known = [one.name for one in read_config(path, Rules).requirements]
        for name in required:
            if name not in known:
                what = f"no requirement {name!r}{did_you_mean(name, known)}"
                raise ConfigError.plain(f"{what} ({path} has: {', '.join(known)})")
        self._rig, self._rules, self._required = load_rig(rig), path, required
        self._out, self._name = out, detector
        self._open = ExitStack()
        self._run: ScoredFrames | None = None

    def add(self, name: str, shot: Shot, given: Detector | None = None) -> SceneScore:
        """Ask, and write the trial. ConfigError: no truth, or another detector is ``given``."""
        if not shot.truth:
            what = "a trial needs the truth of its shot: rig.with_truth(shot, rows)"
            raise ConfigError.plain(what)
        if given is not None and name_of(given) != (ours := name_of(self.detector)):
            what = f"the test's `detector` is {name_of(given)}, but trials are of {ours}"
            raise ConfigError.plain(f"{what}: have a session with --detector for each")
        run = self._begun()
        answer = self._examiner.ask(self.detector, shot.frames)
        rows = [truth_row("", row) for row in shot.truth]
        run.add(name, name, "test", shot.frames, [answer], shot.truth, rows)
        limits = {"limit_mm": self._limits.visible_within_mm}
        return score_answer(answer, shot.truth, **limits, time_limit_s=self._limits.time_limit_s)

    def end(self, early: str, unpassed: Mapping[str, Mapping[str, str]]) -> Reported | None:
        """Close the run, with why it ended ``early`` and which tests of a requirement did not pass,
        and report it; None without a trial.
        """
        if run := self._run:
            run.early = early
            if unpassed:
                run.fact(TESTS_FACT, unpassed)
        self._open.close()
        return write_report(run.folder) if run else None

    @cached_property
    def detector(self) -> Detector:
        """Opened when it is first asked for. Raises ConfigError."""
        return self._open.enter_context(open_detector(self._name))

    def _begun(self) -> ScoredFrames:
        if self._run is not None:
            return self._run
        text = self._decided()
        self._limits = parse_config(self._rules, text, Rules)
        self._examiner = Examiner(self._rig.calibration, self._rig.rig.limits.detection_timeout_s)
        by = [ABOUT, *(f"{name}: {', '.join(tests)}." for name, tests in self._required.items())]
        facts = {"title": "Tests", "about": " ".join(by), "rig": self._rig.rig.name}
        facts |= kind_facts(self._rig.rig)
        given = self._rules, text, self._rig.calibration_path, facts, [self.detector]
        try:
            self._run = self._open.enter_context(ScoredFrames(self._out, "tests", *given))
        except ConfigError as error:
            raise ConfigError.plain(str(error).replace("`out`", "--trial-runs")) from error
        return self._run

    def _decided(self) -> str:
        """The rules with what is required alone."""
        if not self._required:
            return read_text(self._rules)
        table = read_config(self._rules, Rules).model_dump(mode="json", exclude_none=True)
        table["requirements"] = [r for r in table["requirements"] if r["name"] in self._required]
        return toml_text(table)
