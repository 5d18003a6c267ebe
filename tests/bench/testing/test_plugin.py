"""The plug-in for pytest: each test is a session of its own, mostly in this process."""

from __future__ import annotations

import json
import re
import sys
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import bench

# here, for a session in this process forgets what it loaded first: numba and scipy too
import bench.api.rigs
import bench.report.page
import bench.rig.opening
import bench.run.start
import bench.testing.checking
import bench.testing.found
import bench.testing.trials
from bench.results.verdicts import judge, stored_rules
from bench.rig.loading import load_rig
from bench.rig.lock import lock_path, locked
from bench.testing import Scene, Teat
from bench.testing.found import folder_name
from bench.testing.trials import TrialsOfTests
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.real_rig import QUICK_HOMING
from tests.bench.small_recording import write_recording
from tests.undrawn import bare

pytestmark = pytest.mark.slow

pytest_plugins = ("pytester",)
# where the project was installed since the plug-in came, pytest has it already
THERE = bool(entry_points(group="pytest11", name="teatbench"))
OURS = () if THERE else ("-p", "bench.testing.plugin")
PLUGIN = ("-p", "no:cacheprovider", "-p", "no:xdist", *OURS)
SCENE = """
import bench
from bench.testing import Scene, Teat, check
FOUR = Scene((Teat(),) * 4)
"""

OWN = """
from dataclasses import dataclass
from bench.testing import Scene, check
from detector.protocol import Detection

@dataclass
class Blind:
    limit: int = 3
    def detect(self, frames, calibration):
        return Detection(())

blind = Blind()

def test_own():
    check(blind, Scene(), limit_mm=5)
"""
# two test functions: what one left behind doesn't keep the other from its scenes
HANGS = """
import sys, threading
from hypothesis import given
from bench.testing import check, scenes
from detector import Detection

asked, over = [], threading.Event()

class Hangs:
    name, version, parameters = "hangs", "1", {}
    def detect(self, frames, calibration):
        asked.append(frames)
        if len(asked) > 1:
            over.wait(60.0)
        return Detection()

hangs = Hangs()

@given(scenes())
def test_object(scene):
    try:
        check(hangs, scene, timeout_s=0.2, rig=RIG)
    except AssertionError as error:
        if "there was none within 0.2 s" in str(error):
            raise

@given(scenes())
def test_program(scene):
    program = f"exec:{sys.executable} -c 'import time; time.sleep(60)'"
    check(program, scene, timeout_s=0.2, rig=RIG)

def test_each_was_asked_once():
    over.set()
    assert len(asked) == 2
"""
# as by pytest-timeout, which ends a test once
BROKEN_OFF = """
import signal, threading, time
import pytest
from hypothesis import given, settings
from bench.testing import check, scenes

asked = []

class Hangs:
    name, version, parameters = "hangs", "1", {}
    def detect(self, frames, calibration):
        asked.append(frames)
        threading.Timer(0.3, signal.raise_signal, [signal.SIGALRM]).start()
        time.sleep(60.0)

def ends(*_):
    signal.signal(signal.SIGALRM, signal.SIG_IGN)
    pytest.fail("too late")

hangs = Hangs()

@settings(max_examples=20)
@given(scenes())
def test_object(scene):
    if not asked:
        signal.signal(signal.SIGALRM, ends)
    check(hangs, scene, timeout_s=5.0, rig=RIG)

def test_it_was_asked_once():
    assert len(asked) == 1
"""
# hypothesis itself stops after 5 minutes by the clock, and explains by a hundred scenes
SLOW = """
import sys, time
from hypothesis import Phase, given, strategies as st

@given(st.just(0))
def test_slow(number):
    time.sleep(0.3)
    seconds = sys.modules["hypothesis.internal.conjecture.engine"].MAX_SHRINKING_SECONDS
    phases = test_slow._hypothesis_internal_use_settings.phases
    assert (seconds, Phase.explain in phases) == {}
"""


@pytest.fixture
def rig(pytester: pytest.Pytester) -> str:
    return str(write_small_rig(pytester.path))


@pytest.mark.skipif(sys.platform == "win32", reason="it has no SIGALRM")
def test_a_test_that_is_broken_off_from_outside_asks_nothing_more(
    pytester: pytest.Pytester, rig: str
) -> None:
    """hypothesis would make the scene simpler, and nothing would break those calls off."""
    pytester.makepyfile(f"RIG = {rig!r}\n{BROKEN_OFF}")
    result = pytester.runpytest_subprocess(*PLUGIN)
    result.assert_outcomes(failed=1, passed=1)
    result.stdout.fnmatch_lines("*Failed: too late*")


def run(pytester: pytest.Pytester, program: str, *words: str) -> pytest.RunResult:
    pytester.makepyfile(program)
    with bare():
        return pytester.runpytest_inprocess(*PLUGIN, *words)


def test_it_imports_nothing_before_it_is_asked(pytester: pytest.Pytester) -> None:
    program = """
        import sys
        def test_it():
            import bench.testing.plugin
            assert not {"numpy", "hypothesis", "bench.api"} & set(sys.modules)
    """
    pytester.makepyfile(program)
    result = pytester.runpytest_subprocess(*PLUGIN, "-p", "no:hypothesispytest")
    result.assert_outcomes(passed=1)


def test_a_rig_is_open_homed_and_safe_after_each_test(pytester: pytest.Pytester) -> None:
    program = """
        import pytest
        kept = []

        def test_heats(rig, bath, arm, stage, cameras):
            assert arm.homed and stage.homed and rig.emulated
            kept.append((rig, rig.devices.bath))
            rig.heat(33.0, wait=False)
            assert rig.devices.active == ("bath", "pump")
            raise RuntimeError("amid heating")

        def test_after(rig):
            before, bath = kept[0]
            assert not bath.heats and not bath.pump_on
            assert rig is not before
            assert rig.capture().frames.left.ndim == 2
    """
    result = run(pytester, program)
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines("*amid heating*")


def test_a_real_rig_is_opened_and_homed_once_and_alone(pytester: pytest.Pytester) -> None:
    """Its cameras are no emulators: they play a recording."""
    path = Path(write_small_rig(pytester.path))
    write_recording(pytester.path / "played")
    text = path.read_text(encoding="utf-8")
    old = '[cameras]\nurl = "emulator:"'
    assert old in text
    text = text.replace(old, '[cameras]\nurl = "recording:played"')
    path.write_text(f"{text}\n[emulation]\n{QUICK_HOMING}", encoding="utf-8")
    program = """
        import pytest
        kept = []

        @pytest.mark.parametrize("number", (0, 1))
        def test_it(rig, number):
            kept.append(rig)
            assert kept[0] is rig and rig.arm.homed and rig.stage.homed
            rig.heat(33.0, wait=False)
    """
    run(pytester, program, "--rig", str(path)).assert_outcomes(passed=2)
    with locked(lock_path(load_rig(path)), "another run", lambda _: None):
        result = run(pytester, program, "--rig", str(path))
    assert result.ret == 3
    result.stdout.fnmatch_lines("*run one at a time*")


def test_what_is_not_safe_ends_the_session(pytester: pytest.Pytester) -> None:
    program = """
        def test_one(rig, monkeypatch):
            rig.heat(33.0, wait=False)
            def stuck(**_):
                raise OSError("its relay sticks")
            rig.safe = stuck

        def test_two():
            pass
    """
    result = run(pytester, program)
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines("*NOT SAFE: its relay sticks*")


def test_sessions_of_others_go_on_as_without_the_plug_in(pytester: pytest.Pytester) -> None:
    """Marks and an option of the same name, a folder ``found``, and a hypothesis that can't name
    its profile.
    """
    program = """
        import hypothesis
        import pytest

        @pytest.mark.requirement("REQ-42")
        def test_traced(request):
            assert request.config.getoption("--detector") == 5
            assert request.config.getoption("--rig") == "emulated"

        @pytest.mark.requirement(7, level="must")
        @hypothesis.settings(deadline=None)
        @hypothesis.given(hypothesis.strategies.just(0))
        def test_numbered(number):
            with pytest.raises(ImportError, match=r"6\\.139 or newer: pip install"):
                from bench.testing import scenes
    """
    pytester.makepyfile(**{"test_others": program, "found/test_theirs": "def test_it(): pass"})
    conftest = """
        import hypothesis
        del hypothesis.settings.get_current_profile_name

        def pytest_addoption(parser):
            parser.addoption("--detector", type=int)
    """
    pytester.makeconftest(conftest)
    pytester.syspathinsert(Path(bench.__file__).parents[1])
    result = pytester.runpytest_subprocess(*PLUGIN, "--junit-xml", "j.xml", "--detector", "5")
    result.assert_outcomes(passed=3)
    result.stdout.no_fnmatch_line("*requirements*")
    assert "REQ-42" not in Path("j.xml").read_text(encoding="utf-8")


def test_a_requirement_without_a_trial_is_said_not_to_be_decided(
    pytester: pytest.Pytester, rig: str
) -> None:
    program = """
        import pytest

        @pytest.mark.requirement("no false teat")
        def test_one():
            pass
    """
    says = "Not decided, no trial was recorded: no false teat"
    result = run(pytester, program, "--rig", rig, "--detector", "thesis")
    assert says in result.stdout.str()
    assert not (pytester.path / "runs").exists()
    listed = run(pytester, program, "--rig", rig, "--detector", "thesis", "--collect-only")
    assert says not in listed.stdout.str()


def test_trials_of_tests_are_a_run_with_a_verdict(pytester: pytest.Pytester, rig: str) -> None:
    program = f"""{SCENE}
import pytest

@pytest.mark.requirement("no false teat")
def test_four(record_trial, detector):
    assert detector.name == "thesis"
    for number in (0, 1):
        shot = Scene(FOUR.teats, noise=number).draw({rig!r})
        assert record_trial(shot).counts.visible == 4

@pytest.mark.requirement("error below 5 mm")
def test_named(record_trial):
    score = record_trial(FOUR.draw({rig!r}), "plain")
    assert not score.success
    with pytest.raises(bench.ConfigError, match="needs the truth"):
        record_trial(bench.api.shots.Shot(None, None))
    with pytest.raises(bench.ConfigError, match="^shot is 'x', not a Shot"):
        record_trial("x")
"""
    result = run(pytester, program, "--rig", rig, "--detector", "thesis", "--junit-xml", "j.xml")
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["*requirements*", "*Report: *index.html"])
    (folder,) = (pytester.path / "runs").iterdir()
    record = bench.read_run(folder)
    assert [one.head["name"] for one in record.trials] == ["test_four", "test_four-2", "plain"]
    assert record.facts["kind"] == "emulated"
    assert "no false teat: test_four." in record.facts["about"]
    found = json.loads((folder / "report" / "run.json").read_text(encoding="utf-8"))
    text = json.dumps(found)
    assert "no false teat" in text
    assert "error below 5 mm" in text
    assert "reliability" not in text
    assert 'name="requirement" value="no false teat"' in Path("j.xml").read_text(encoding="utf-8")
    pytester.makeconftest("def pytest_configure(config): config.workerinput = {}")
    run(pytester, program, "--rig", rig).stdout.fnmatch_lines("Recorded trials make one run: *")


def test_no_requirement_is_met_beside_a_test_of_it_that_did_not_pass(
    pytester: pytest.Pytester, rig: str
) -> None:
    """A time that each answer keeps, so that the tests alone decide."""
    rule = '[[requirements]]\nkind = "time"\nname = "{}"\nlimit_s = 1000.0\nstatistic = "max"\n'
    rules = 'title = "t"\ndetectors = ["thesis"]\n' + "".join(map(rule.format, "abcd"))
    (pytester.path / "rules.toml").write_text(rules, encoding="utf-8")
    program = f"""{SCENE}
import pytest

@pytest.fixture
def broken():
    yield
    raise RuntimeError("its teardown")

@pytest.mark.requirement("a", "d")
def test_passes(record_trial):
    for _ in range(2):  # the first answer is not timed
        record_trial(FOUR.draw({rig!r}))

@pytest.mark.requirement("b")
def test_fails():
    raise AssertionError

@pytest.mark.requirement("c")
def test_ends_wrong(broken):
    pass

@pytest.mark.requirement("d")
@pytest.mark.xfail
def test_known():
    raise AssertionError
"""
    words = "--rig", rig, "--detector", "thesis", "--trial-rules", "rules.toml"
    result = run(pytester, program, *words)
    result.assert_outcomes(passed=2, failed=1, errors=1, xfailed=1)
    result.stdout.fnmatch_lines(["not met. Report: *", "B: Not all its *test_fails (failed). *"])
    (folder,) = (pytester.path / "runs").iterdir()
    (judged,) = judge(bench.read_run(folder), stored_rules(folder))
    assert {one.name: one.verdict.value for one in judged.decisions} == {
        "a": "met",
        "b": "not met",
        "c": "inconclusive",
        "d": "inconclusive",
    }
    said = [one.sentence.split(". ")[0].partition("passed: ")[2] for one in judged.decisions]
    assert said == [
        "",
        "test_fails (failed)",
        "test_ends_wrong (error)",
        "test_known (failed as expected)",
    ]
    assert bench.read_run(folder).facts["command"].split()[0] != "teatbench"


def test_an_unknown_requirement_rig_or_detector_is_wrong_use(pytester: pytest.Pytester) -> None:
    program = """
        import pytest
        @pytest.mark.requirement("no false teats")
        def test_it(record_trial):
            pass
    """
    result = run(pytester, program)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines("*did you mean*no false teat*")
    for wrong in ("", "(5)", '(name="no false teat")'):
        marked = (
            f"import pytest\n@pytest.mark.requirement{wrong}\ndef test_it(record_trial): pass\n"
        )
        result = run(pytester, marked)
        assert result.ret == pytest.ExitCode.USAGE_ERROR
        takes = '*::test_it: @pytest.mark.requirement("NAME") takes names of*'
        result.stderr.fnmatch_lines(takes)
    plain = "def test_it({0}):\n    pass\ndef test_again({0}):\n    pass\n"
    for fixture, option, value, says in (
        ("rig", "--rig", "nowhere", "no rig"),
        ("detector", "--detector", "fusd", "no detector"),
        ("record_trial", "--detector", "fusd", "no detector"),
        ("record_trial", "--trial-rules", "gone.toml", "gone.toml can't be read"),
    ):
        result = run(pytester, plain.format(fixture), option, value)
        assert result.ret == pytest.ExitCode.USAGE_ERROR
        result.stdout.fnmatch_lines(f"!*{says}*")  # once, and no traceback
        result.stdout.no_fnmatch_line("*Error*")
    pytester.makeconftest("def pytest_configure(config): config.workerinput = {}")
    result = run(pytester, marked)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(takes)


def test_trials_on_a_partly_emulated_rig_are_marked_so(tmp_path: Path) -> None:
    path = Path(write_small_rig(tmp_path))
    text = path.read_text(encoding="utf-8")
    arm = '[arm]\nurl = "emulator:"'
    assert arm in text
    real = '[arm]\nurl = "socket://127.0.0.1:9"'
    path.write_text(text.replace(arm, real), encoding="utf-8")
    trials = TrialsOfTests(str(path), "thesis", tmp_path / "runs", None, {})
    trials.add(folder_name("ü" + "x" * 300), Scene((Teat(),)).draw(str(path)))
    found = trials.end("", {})
    assert found is not None
    facts = found.record.facts
    assert facts["kind"] == "mixed"
    assert "cameras" in facts["emulated"]
    assert "arm" not in facts["emulated"]


def test_names_of_tests_become_folders_that_any_system_takes() -> None:
    long = [folder_name(f"test_it[{'x' * 300}{end}]") for end in ("a", "b")]
    assert len({*long}) == 2
    assert max(map(len, long)) < 120


def test_trials_that_cannot_be_kept_are_said_by_the_option(tmp_path: Path, rig: str) -> None:
    (tmp_path / "a-file").touch()
    trials = TrialsOfTests(rig, "thesis", tmp_path / "a-file", None, {})
    shot: Any = SimpleNamespace(truth=[None])
    with pytest.raises(bench.ConfigError, match="Name another folder as --trial-runs"):
        trials.add("one", shot)
    with pytest.raises(
        bench.ConfigError, match="`detector` is SimpleNamespace, but trials are of thesis"
    ):
        trials.add("one", shot, shot)


def test_a_session_that_ends_early_leaves_an_aborted_run(
    tmp_path: Path, rig: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bench.testing.trials.write_report", lambda folder: folder)
    for early, ending in (("stopping after 1 failures", "aborted"), ("", "finished")):
        trials = TrialsOfTests(rig, "thesis", tmp_path, None, {})
        trials._begun()
        run = bench.read_run(trials.end(early, {}))  # type: ignore[arg-type]
        assert run.facts["ending"] == ending
        assert any(early in str(event) for event in run.events)


def test_an_interrupted_session_ends_its_run_once_fixtures_are_down(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the tests that were selected."""
    end = lambda self, early, unpassed: print(f"END {early} {[*self._required]}")  # noqa: E731
    monkeypatch.setattr(TrialsOfTests, "end", end)
    program = """
        import pytest
        @pytest.fixture
        def hot():
            yield
            print("COLD")
        @pytest.mark.requirement("no false teat")
        def test_one(hot): pytest.exit("enough")
        @pytest.mark.requirement("reliability")
        def test_other(): pass
    """
    result = run(pytester, program, "-s", "-k", "test_one")
    result.stdout.fnmatch_lines(["*COLD", "END interrupted [[]'no false teat']"])


def test_a_rig_that_cannot_be_opened_is_said_with_its_cause(pytester: pytest.Pytester) -> None:
    """Whether the session ends by it or, in a worker of xdist, each test; nothing stays locked."""
    path = Path(write_small_rig(pytester.path))
    text = path.read_text(encoding="utf-8")
    old = '[cameras]\nurl = "emulator:"'
    assert old in text
    path.write_text(text.replace(old, '[cameras]\nurl = "recording:gone"'), encoding="utf-8")
    program = "def test_it(rig):\n    pass\ndef test_again(rig):\n    pass\n"
    result = run(pytester, program, "--rig", str(path))
    assert result.ret == 3
    result.stdout.fnmatch_lines("!*the rig can't be opened: */gone: there is no such folder*")
    pytester.makeconftest("def pytest_configure(config): config.workerinput = {}")
    result = run(pytester, program, "--rig", str(path))
    result.assert_outcomes(errors=2)
    result.stdout.no_fnmatch_line("*another bench has it*")


def test_an_object_is_found_in_a_test_of_its_own_and_deadlines_are_those_of_scenes(
    pytester: pytest.Pytester, rig: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first session in a process whose hypothesis is fresh."""
    defaults = vars(bench.testing.check)["__wrapped__"].__kwdefaults__
    monkeypatch.setitem(defaults, "rig", defaults["rig"])  # the second session is in this process
    patient = SLOW.format((3600.0, False)).replace("test_slow", "test_patient")
    pytester.makepyfile(test_own=OWN + patient, test_slow=SLOW.format((300, True)))
    pytester.makeconftest(
        "import bench.testing, hypothesis\n"
        f"bench.testing.check.__wrapped__.__kwdefaults__['rig'] = {rig!r}\n"
        "hypothesis.settings.load_profile('default')  # that of a CI has no deadline\n"
    )
    pytester.syspathinsert()
    first = pytester.runpytest_subprocess(*PLUGIN, "test_own.py", "test_slow.py")
    first.assert_outcomes(failed=2, passed=1)
    text = first.stdout.str()
    assert re.findall(r"FAILED (\w+).*DeadlineExc", text) == ["test_slow"], text
    with bare():
        second = pytester.runpytest_inprocess(*PLUGIN, "found/test_own/test_scene.py")
        pytester.runpytest_inprocess(*PLUGIN, "--co").stdout.no_fnmatch_line("*test_scene.py*")
    second.assert_outcomes(failed=1)
    second.stdout.fnmatch_lines(["*Blind misses 1 of 1 visible ends in Scene()*"])


def test_a_detector_that_hangs_is_asked_no_more(pytester: pytest.Pytester, rig: str) -> None:
    result = run(pytester, f"RIG = {rig!r}\n{HANGS}", "--hypothesis-seed=1")
    result.assert_outcomes(failed=2, passed=1)
    result.stdout.fnmatch_lines_random(
        [
            "hangs gave no answer (there was none within 0.2 s) in Scene(*",
            "exec:*gave no answer*",
            "No simpler scene was looked for, and none beside it: each may take as long.",
            "Picture: found*",
        ]
    )
