"""The plug-in for pytest: an open rig and a detector as fixtures, trials that count, and the
simplest scene that breaks a detector as a picture (docs/testing.md). Every session of a Python that
has teatbench loads it, so that nothing is imported before it is asked for.
"""

from __future__ import annotations

import glob
import sys
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any, NoReturn

import pytest

import bench

if TYPE_CHECKING:
    from bench.testing.trials import TrialsOfTests
    from detector import Detector

MARK = "requirement"
_PREFIX = "teatbench"  # of the options' values, which no other plug-in has
OWN_PROFILES = ("default", "ci")  # of hypothesis itself
SHRINKING_S = 3600.0  # instead of hypothesis's 5 minutes by the clock, too few on a busy machine


OPTIONS: Mapping[str, tuple[Any, str]] = {
    "--rig": ("emulated", "a rig by name or file (emulated)"),
    "--detector": ("fused", "a detector by name or file (fused)"),
    "--trial-runs": (Path("runs"), "where trials are kept (runs)"),
    "--found-scenes": (Path("found"), "where found scenes are written (found)"),
    "--trial-rules": (None, "recorded trials' requirements, a .toml file"),
}


@pytest.hookimpl(wrapper=True)
def pytest_load_initial_conftests(parser: pytest.Parser) -> Generator[None, None, None]:
    """Options, after those of a project's own conftest.py: a name that it has stays its own."""
    yield
    group = parser.getgroup("teatbench", "a bench, or its emulators")
    for name, (usual, what) in OPTIONS.items():
        how = {"type": str if isinstance(usual, str) else Path, "default": usual, "help": what}
        shown = name.lstrip("-").replace("-", "_").upper()
        if not _is_taken(parser, name):
            group.addoption(name, dest=_PREFIX + name, metavar=shown, **how)


def _is_taken(parser: pytest.Parser, name: str) -> bool:
    one = f"{name}=1"
    try:
        return one not in parser.parse_known_and_unknown_args([one])[1]
    except pytest.UsageError:  # an option of another kind
        return True


def _given(config: pytest.Config, name: str) -> Any:
    """What the option is, or usually is where the name is another's."""
    return config.getoption(_PREFIX + name, OPTIONS[name][0])


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", f'{MARK}("NAME"): decided by trials that the test records')
    # where several tests failed there are as many modules of one name
    found = _given(config, "--found-scenes").resolve()
    if any(found.glob("*/scene.toml")):  # others have tests in a folder of this name
        config.addinivalue_line("norecursedirs", glob.escape(str(found)))


def pytest_collection_finish(session: pytest.Session) -> None:
    """Of the tests that will run: others may be deselected until now."""
    config, items = session.config, session.items
    _give_time(items)
    try:
        _require(config, items)
    except pytest.UsageError as error:
        if not hasattr(config, "workerinput"):
            raise
        config.stash[_WRONG] = str(error)  # a worker of xdist would crash


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker(MARK) and (why := item.config.stash.get(_WRONG, "")):
        pytest.fail(why, pytrace=False)


def _require(config: pytest.Config, items: Sequence[pytest.Item]) -> None:
    """Keep which tests decide which requirement. Raises UsageError for what is none, but where no
    test records a trial: others have marks of this name for their own.
    """
    ours = any("record_trial" in getattr(item, "fixturenames", ()) for item in items)
    marked = [(item, mark) for item in items for mark in item.iter_markers(MARK)]
    wrong = [item for item, mark in marked if mark.kwargs or not _are_texts(mark.args)]
    if wrong and ours:
        takes = f'@pytest.mark.{MARK}("NAME") takes names of requirements'
        raise pytest.UsageError(f"{wrong[0].nodeid}: {takes}")
    named = [(item, name) for item, mark in marked if item not in wrong for name in mark.args]
    required: dict[str, list[str]] = {}
    for item, name in named:
        required.setdefault(name, []).append(item.name)
    config.stash[_REQUIRED] = required
    try:
        if required:
            _trials(config)
    except pytest.UsageError:
        if ours:
            raise
        required.clear()
        return
    for item, name in named:
        item.user_properties.append((MARK, name))


def _are_texts(args: Sequence[object]) -> bool:
    return bool(args) and all(isinstance(one, str) for one in args)


def _give_time(items: Sequence[pytest.Item]) -> None:
    """Hypothesis gives up no example for its time, looks for one fault at a time, and draws no
    hundred scenes more to explain it: in modules that import `bench.testing`, under a profile of
    its own. ``@given`` has its settings from the profile by then; they are changed on the test.
    A hypothesis that can't name its profile is older than `bench.testing` takes: none draws scenes.
    """
    settings: Any = getattr(sys.modules.get("hypothesis"), "settings", None)
    named = getattr(settings, "get_current_profile_name", None)
    if named is None or named().split("-with-")[0] not in OWN_PROFILES:
        return
    usual, explain = settings(), sys.modules["hypothesis"].Phase.explain
    for item in items:
        test: Any = getattr(item, "obj", None)
        test = getattr(test, "__func__", test)
        given = getattr(test, "_hypothesis_internal_use_settings", None)
        if test and given and _draws_scenes(getattr(item, "module", None)):
            limits = {"deadline": None} if given.deadline == usual.deadline else {}
            phases = [one for one in given.phases if one is not explain]
            own = settings(given, report_multiple_bugs=False, phases=phases, **limits)
            test._hypothesis_internal_use_settings = own


def _draws_scenes(module: ModuleType | None) -> bool:
    kept = vars(module).values() if module else ()
    named = [one for one in kept if isinstance(one, FunctionType | type | ModuleType)]
    places = [str(getattr(one, "__module__", None) or one.__name__) for one in named]
    return any(one == "bench" or one.startswith("bench.testing") for one in places)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    """A scene is made simpler until it is the simplest, however busy the machine is."""
    engine: Any = sys.modules.get("hypothesis.internal.conjecture.engine")
    if engine is None or not _draws_scenes(getattr(item, "module", None)):
        return (yield)
    from bench.testing import checking

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "MAX_SHRINKING_SECONDS", SHRINKING_S, raising=False)
        patch.setattr(checking, "late", {})
        return (yield)


_REQUIRED = pytest.StashKey[Mapping[str, Sequence[str]]]()
_UNPASSED = pytest.StashKey[dict[pytest.Item, str]]()
_TRIALS, _WRONG = pytest.StashKey["TrialsOfTests"](), pytest.StashKey[str]()


def _trials(config: pytest.Config) -> TrialsOfTests:
    """Of the session. Raises UsageError."""
    if _TRIALS not in config.stash:
        from bench.testing.trials import TrialsOfTests

        names = ("--rig", "--detector", "--trial-runs", "--trial-rules")
        rig, detector, runs, rules = (_given(config, name) for name in names)
        required = config.stash[_REQUIRED]
        try:
            config.stash[_TRIALS] = TrialsOfTests(rig, detector, runs, rules, required)
        except bench.ConfigError as error:
            raise pytest.UsageError(str(error)) from error
    return config.stash[_TRIALS]


def _refuse(config: pytest.Config, why: object, code: int) -> NoReturn:
    """Ends the session with a sentence, or the test in a worker of xdist, which would crash."""
    if hasattr(config, "workerinput"):
        raise pytest.fail.Exception(str(why), pytrace=False) from None
    pytest.exit(str(why), code)


@pytest.fixture(scope="session")
def _opened(request: pytest.FixtureRequest) -> Iterator[Callable[[], bench.OpenRig]]:
    """Opens the rig: a real one once a session, and alone."""
    from instruments import InstrumentError

    config = request.config
    try:
        loaded = bench.load_rig(_given(config, "--rig"))
    except bench.ConfigError as error:
        _refuse(config, error, 4)
    with ExitStack() as stack:
        kept: list[bench.OpenRig] = []

        def opened() -> bench.OpenRig:
            if kept:
                return kept[0]
            try:
                # of what can't be opened nothing stays
                with ExitStack() as fresh:
                    rig = fresh.enter_context(bench.open_rig(loaded))
                    rig.home()
                    stack.push(fresh.pop_all())
            except bench.RigInUseError as error:
                _refuse(config, f"{error} Tests of a real rig run one at a time (no -n).", 3)
            except (InstrumentError, bench.ConfigError, bench.RecordingError) as error:
                _refuse(config, f"the rig can't be opened: {error}", 3)
            kept.append(rig)
            return rig

        def anew() -> bench.OpenRig:
            stack.close()
            kept.clear()
            return opened()

        yield anew if loaded.rig.simulated else opened


@pytest.fixture
def rig(
    request: pytest.FixtureRequest, _opened: Callable[[], bench.OpenRig]
) -> Iterator[bench.OpenRig]:
    """The rig of ``--rig``, open and homed: the emulated one anew for each test, a real one once a
    session. After each test it is safe; where it isn't, no further test begins.
    """
    one = _opened()
    try:
        yield one
    finally:
        try:
            one.end_watch()
            one.safe(keep_arm=True)
        except Exception as error:
            request.session.shouldfail = f"NOT SAFE: {error}"
            raise


def _instrument(name: str) -> Any:
    @pytest.fixture(name=name)
    def one(rig: bench.OpenRig) -> Any:
        """The rig's instrument of this name; arm and stage are homed."""
        return getattr(rig, name)

    return one


bath, arm, stage, cameras = map(_instrument, ("bath", "arm", "stage", "cameras"))


@pytest.fixture(scope="session")
def detector(request: pytest.FixtureRequest) -> Iterator[Detector]:
    """The detector of ``--detector``; its process lives as long as the session."""
    with ExitStack() as stack:
        try:
            one = stack.enter_context(bench.open_detector(_given(request.config, "--detector")))
        except bench.ConfigError as error:
            _refuse(request.config, error, 4)
        yield one


@pytest.fixture
def record_trial(request: pytest.FixtureRequest) -> Callable[..., bench.SceneScore]:
    """``record_trial(shot, name="")``: a trial of the session's run, with ``--detector``'s answer;
    gives back its score.
    """
    if hasattr(request.config, "workerinput"):
        pytest.fail("Recorded trials make one run: run their tests without -n.", pytrace=False)
    from bench.arguments import guarded
    from bench.testing.found import folder_name

    try:
        trials, done = _trials(request.config), [0]
        _ = trials.detector  # one that can't be had ends the session, not each test
    except (pytest.UsageError, bench.ConfigError) as error:
        _refuse(request.config, error, 4)

    def record(shot: bench.Shot, name: str = "") -> bench.SceneScore:
        done[0] += 1
        number = f"-{done[0]}" if done[0] > 1 and not name else ""
        known = folder_name(name or f"{request.node.name}{number}")
        return trials.add(known, shot, request.node.funcargs.get("detector"))

    return guarded(record, __name__)  # type: ignore[no-any-return]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[Any]
) -> Generator[None, Any, Any]:
    """Keep how a test of a requirement ended; write the scene that it failed on, and say where."""
    report = yield
    ended = item.config.stash.setdefault(_UNPASSED, {})
    if call.when == "setup":  # a test that is run again counts as it ends
        ended.pop(item, None)
    if report.failed:
        ended.setdefault(item, "failed" if call.when == "call" else "error")
    elif report.skipped and hasattr(report, "wasxfail"):
        ended[item] = "failed as expected"
    own = sys.modules.get("bench.testing.checking")
    if own and call.excinfo and isinstance(error := call.excinfo.value, own.SceneFailedError):
        from bench.testing.found import folder_name, write_found
        from textfiles.text import in_command
        from textfiles.whole import refusal

        text = f"{error}\n{error.neighbourhood()}\n\n{error.lines()}"
        try:
            folder = write_found(
                error, _given(item.config, "--found-scenes") / folder_name(item.name)
            )
            text += f"\nPicture: {folder / 'scene.png'}"
            keep = f"teatbench campaign keep {in_command(folder)} --into recordings/kept"
            text += f"\nKeep it: {keep}"
        except OSError as fault:
            text += f"\nNot written: {refusal(fault, 'Name another folder with --found-scenes.')}"
        report.sections.append(("simplest scene", text))
    return report


@pytest.hookimpl(wrapper=True, trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> Generator[None, None, None]:
    """Ends the run of recorded trials, once the rig is safe where a test was interrupted; a
    requirement that is not met fails the session.
    """
    try:
        return (yield)
    finally:
        trials = session.config.stash.get(_TRIALS, None)
        required = session.config.stash.get(_REQUIRED, None)
        early = session.shouldfail or session.shouldstop or "interrupted" * (session.exitstatus > 1)
        unpassed: dict[str, dict[str, str]] = {}
        for item, how in session.config.stash.get(_UNPASSED, {}).items():
            for mark in item.iter_markers(MARK):
                for name in mark.args:
                    unpassed.setdefault(name, {})[item.name] = how
        if trials and (reported := trials.end(str(early or ""), unpassed)):
            why = f"\n{reported.status.why}".rstrip()
            session.config.stash[_TEXT] = f"{reported.verdict}. Report: {reported.page}{why}"
            if reported.verdict == "not met" and session.exitstatus == pytest.ExitCode.OK:
                session.exitstatus = pytest.ExitCode.TESTS_FAILED
        elif trials and required and not session.config.option.collectonly:
            names = ", ".join(required)
            session.config.stash[_TEXT] = f"Not decided, no trial was recorded: {names}"


_TEXT = pytest.StashKey[str]()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if text := terminalreporter.config.stash.get(_TEXT, ""):
        terminalreporter.section("requirements")
        terminalreporter.write_line(text)
