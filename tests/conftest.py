"""For all tests: what leaks a thread fails the test that leaked it; runs on the emulated rig are
shared where they may be.
"""

from __future__ import annotations

import atexit
import contextlib
import faulthandler
import gc
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Iterator
from functools import _lru_cache_wrapper, cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil
import pytest

from tests.examples import examples
from tests.undrawn import bare, undrawn, without_figures
from tests.waiting import PATIENCE_S

if TYPE_CHECKING:
    from instruments.clock import RealClock

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"
# libraries, compiled loops and collected tests alone are some 900 MiB; Python 3.13's are larger
TRIM_MIB, GROWN_MIB, MOST_MIB = 700.0, 96.0, 1280.0
THIS_PROCESS = psutil.Process()  # it is asked after each test
SLOW_S = 0.1  # as the marker says
INNER_LOOP = "not slow"
SLOW_FILE = re.compile(r"^pytestmark = (\[[^]]*)?pytest\.mark\.slow\b", re.MULTILINE)
STANDBY, UNMARKED = "s to standby, ", "s of a processor, "
# rooms and files whose tests run the bench and look at no figure: made up to their last artist,
# since damaged and odd data come as far as there; and of the others, which alone look at theirs
UNDRAWN = (
    *("tests.bench.record.test_damaged_runs", "tests.bench.results.test_score_detectors"),
    "tests.bench.report.test_odd_recordings",
    "tests.bench.calibrate.test_checks",
    *("tests.bench.report.test_detector_errors", "tests.bench.campaign.test_campaign"),
)
DRAWN = tuple(
    f"tests.bench.report.test_{name}"
    for name in ("beside", "report_points", "report_spread", "summary", "pages_in_a_browser")
)
ROOMS = ("cli", "console", "record", "rig", "run", "safety", "script", "truth")
KEEPING = ("tests.", "instruments.world.", "bench.campaign.")
# what a camera sees of an empty scene: most files open the same rigs, and it takes half a second
STAYS = (
    *("instruments.world.optics._rays", "instruments.world.optical_camera._empty"),
    "tests.conftest._caches_of",
)
BARE = (
    *(f"tests.bench.{room}." for room in ROOMS),
    *("tests.test_thesis_example", "tests.test_docs", "tests.detector.test_depth"),
    *("tests.test_doc_figures", "tests.test_study_examples"),
)


def pytest_configure(config: pytest.Config) -> None:
    """A CI that starts in the background (`&`, `nohup`) ignores signals, and its children too:
    tests that send them need them heard.
    """
    if os.environ.get("PYTEST_XDIST_WORKER"):
        import cv2

        atexit.register(_end_at_once, os.getpid())
        gc.disable()  # what is imported and collected stays
        cv2.setNumThreads(1)  # others have the other processors, and idle threads spin
    if not config.getoption("numprocesses", None):  # else the workers run the tests
        _set_hypothesis(config)
    # compiled once, not in each of some hundred processes
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False
    # 'teatbench report' prints a PDF where a browser is: only where that is what is tested
    os.environ.setdefault("TEATBENCH_BROWSER", "")
    for name, default in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, default)


def _set_hypothesis(config: pytest.Config) -> None:
    from hypothesis import HealthCheck, settings

    # the same examples in a CI
    fixed = settings().derandomize and config.getoption("hypothesis_seed") is None
    # how fast the machine is says nothing of the code
    settings.register_profile(
        "teatbench",
        deadline=None,
        derandomize=fixed,
        max_examples=examples(12),
        suppress_health_check=[HealthCheck.too_slow],
    )
    settings.load_profile("teatbench")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """The inner loop imports no file whose tests are all slow, and no benchmark: those are skipped."""
    if config.getoption("markexpr") != INNER_LOOP or collection_path.suffix != ".py":
        return None
    slow = SLOW_FILE.search(collection_path.read_text(encoding="utf-8"))
    return True if slow or collection_path.parent.name == "benchmarks" else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Files with slow tests first, those of the whole product (docs) before all: the last of them
    would run alone in the end. Tests of many minutes only where TEATBENCH_WEEKLY is set.
    """
    weekly = [item for item in items if item.get_closest_marker("weekly")]
    for item in weekly:
        item.add_marker("slow")
    if not os.environ.get("TEATBENCH_WEEKLY"):
        config.hook.pytest_deselected(items=weekly)
        items[:] = [item for item in items if not item.get_closest_marker("weekly")]
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path not in slow, len(item.path.parts)))


def pytest_collection_finish() -> None:
    """What is collected stays to the end: the garbage collector need not walk it in each test, nor
    come as often as in a program of Python's usual size.
    """
    gc.enable()
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    # at their end extension modules look whether anything of theirs is left; pytest walks the rest
    # five times before
    atexit.register(gc.unfreeze)


def _end_at_once(worker: int) -> None:
    """A worker has told all that it knows, and Python would free each object for a second."""
    if os.getpid() == worker and "coverage" not in sys.modules:  # which writes its figures later
        os._exit(0)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """What ends a worker with a test that no exception ends leaves those alone to which their mark
    or the command line gives more time.
    """
    mark = item.get_closest_marker("timeout")
    given_s = float(mark.args[0] if mark else item.config.getoption("timeout", None) or 0.0)
    if given_s > float(item.config.getini("faulthandler_timeout")):
        faulthandler.cancel_dump_traceback_later()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Notes what takes as much of a processor as a slow test and isn't marked as one."""
    before_s = time.process_time()
    yield
    took_s = time.process_time() - before_s
    if took_s > SLOW_S and not item.get_closest_marker("slow"):
        item.user_properties.append((f"{UNMARKED}{item.nodeid}", round(took_s, 2)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """What tests have measured and want to be seen: times from a death of the bench to the bath's
    standby; what the inner loop should leave out.
    """
    reports = [
        report for kind in ("passed", "failed") for report in terminalreporter.stats.get(kind, ())
    ]
    for begins, title in ((STANDBY, "seconds to standby"), (UNMARKED, "slow, not marked so")):
        note = [
            (name, value)
            for report in reports
            if report.when == "call"
            for name, value in report.user_properties
            if name.startswith(begins)
        ]
        if note:
            terminalreporter.section(title)
            for name, value in sorted(note):
                terminalreporter.write_line(f"{value:8.3f}  {name.removeprefix(begins)}")


def _threads() -> set[threading.Thread]:
    """Those of Python, but those that `zaber_motion` keeps as long as the process."""
    events = sys.modules.get("zaber_motion.events")
    kept = events.event_executor._threads if events else set()
    dummies = {one for one in threading.enumerate() if isinstance(one, threading._DummyThread)}
    return set(threading.enumerate()) - dummies - kept


@pytest.fixture(autouse=True)
def no_leaked_threads() -> Iterator[None]:
    before = _threads()
    yield
    deadline = time.monotonic() + PATIENCE_S
    while (leaked := _threads() - before) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not leaked, f"leaked threads: {[thread.name for thread in leaked]}"


@pytest.fixture(scope="module", autouse=True)
def caches_end_with_their_module() -> Iterator[None]:
    yield
    _forget_what_is_kept(STAYS)


@pytest.fixture(scope="module", autouse=True)
def what_no_test_looks_at_is_left_out(request: pytest.FixtureRequest) -> Iterator[None]:
    """It takes most of a short run."""
    name = request.module.__name__
    without: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
    if name.startswith(UNDRAWN):
        without = undrawn()
    elif name.startswith(BARE):
        without = bare()
    elif name.startswith("tests.bench.") and not name.startswith(DRAWN):
        without = without_figures()
    with without:
        yield


@pytest.fixture(scope="session")
def trimmed_mib() -> list[float]:
    """What was resident after the last trim, as its one item."""
    return [TRIM_MIB]


@pytest.fixture(autouse=True)
def bounded_memory(trimmed_mib: list[float]) -> Iterator[None]:
    """A worker that has grown beyond `MOST_MIB` fails the test after which it was so.

    What its module keeps and freed memory that the allocator kept go back first; a trim takes half
    a second, so it comes again only when the worker has grown by `GROWN_MIB` since.
    """
    yield
    mib = resident_mib()
    if mib > MOST_MIB:
        _forget_what_is_kept()
    if mib > MOST_MIB or mib > max(TRIM_MIB, trimmed_mib[0] + GROWN_MIB):
        from bench.record.writer import release_memory

        gc.collect()
        release_memory()
        trimmed_mib[0] = mib = resident_mib()
    assert mib < MOST_MIB, f"this worker holds {mib:.0f} MiB"


def _forget_what_is_kept(stays: tuple[str, ...] = ()) -> None:
    """What tests draw once and keep (`functools.cache`) is some 200 MB a renderer, and what the
    renderer and campaigns keep of their last rigs is as much.
    """
    for name in [one for one in sys.modules if one.startswith(KEEPING)]:
        for kept in _caches_of(name):
            if f"{name}.{getattr(kept, '__name__', '')}" not in stays:
                kept.cache_clear()


@cache
def _caches_of(name: str) -> list[_lru_cache_wrapper[Any]]:
    """Of a module; they are there once it is loaded."""
    things = vars(sys.modules[name]).values()
    return [one for one in things if isinstance(one, _lru_cache_wrapper)]


def resident_mib() -> float:
    """Resident memory of this process."""
    return float(THIS_PROCESS.memory_info().rss) / 2**20


@pytest.fixture
def clock() -> Iterator[RealClock]:
    """Closed behind its test."""
    from instruments.clock import RealClock

    with contextlib.closing(RealClock()) as real:
        yield real


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of data beside the project; tests that need it are skipped where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("needs ../shared, which is absent on this machine")
    return SHARED / "data"


@pytest.fixture(scope="session")
def short_script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The six situations once each, with a stability gate of one minute."""
    from bench.script.model import TRIALS

    text = (TRIALS / "six-situations.toml").read_text(encoding="utf-8")
    for old, new in {"repeats = 3": "repeats = 1", "window_s = 600.0": "window_s = 60.0"}.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path_factory.mktemp("scripts") / "short.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def two_trials(short_script: Path) -> Path:
    """The first two of them, where more trials would show nothing more."""
    return first_trials(short_script, 2)


def first_trials(script: Path, count: int) -> Path:
    """A script beside ``script`` with its first so many trials alone."""
    head, *trials = script.read_text(encoding="utf-8").split("[[trials]]")
    path = script.with_name(f"first-{count}.toml")
    path.write_text("[[trials]]".join([head, *trials[:count]]), encoding="utf-8")
    return path
