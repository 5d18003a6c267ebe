"""Everything from a fresh machine: make .venv, install, then run the demo or the tests.

    python3 run.py demo [--no-open] [SCRIPT and options of "teatbench run"]
    python3 run.py test [arguments of pytest]
    python3 run.py install    only installs what the tests need

Standard library only, so that it starts with nothing but Python 3.11 and pip. The packages are
those of locks/, whose hashes pip checks. A second call finds the installation by its stamp and
starts at once. It works on Linux, macOS and Windows.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import venv
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
LOCKS = ROOT / "locks"  # made by the command at the top of each, after that of constraints.txt
NEEDED = (3, 11)
PYTEST_OPTIONS = (
    # a test in real time mostly waits; each process takes 20 s of a processor to start, and 1 GB
    *("-n", str(max(os.cpu_count() or 1, min(3 * (os.cpu_count() or 1), 10)))),
    *("--dist", "loadfile", "--no-loadscope-reorder"),  # slow files first: tests/conftest.py
    *("--max-worker-restart", "0"),  # a test that killed its worker would kill the next one
)
# most modules are never imported: Python compiles the others itself, at their first import
QUIETLY = ("--disable-pip-version-check", "--no-compile", "--quiet")
# what compiles the loops of a module needs; it has them done while the other packages come
LOOPS = ("llvmlite", "numba", "numpy", "scipy")
COMPILED = "detector.outline.kernels", "instruments.world.kernels"
# met, not met, inconclusive: a verdict on the detector, not a fault of the bench
DID_ITS_WORK = (0, 1, 4)

HINT_NETWORK = """The package index can't be reached. Check the network, or the proxy (set
HTTPS_PROXY, or call 'pip config set global.proxy URL'). Without a network: on another machine
with the same Python run 'pip download -d wheels -r locks/test.txt', copy the folder here, and
set PIP_NO_INDEX=1 and PIP_FIND_LINKS=wheels before calling run.py again."""
HINT_VENV = """Python can't make a virtual environment here. On Debian or Ubuntu:
'sudo apt install python3-venv'. Elsewhere install Python from python.org with pip included.
If the folder can't be written, copy the project to a place of your own."""
HINT_PIP = """pip could not install the packages; its last lines are above. Often an old pip, or
a Python without ready-made packages, is the cause: use CPython 3.11, 3.12 or 3.13 (64 bit),
delete the folder .venv and call run.py again."""
NETWORK_SIGNS = (
    "NewConnectionError",
    "Temporary failure",
    "getaddrinfo",
    "Max retries",
    "ConnectTimeout",
    "ProxyError",
    "Network is unreachable",
)


def main(arguments: Sequence[str]) -> int:
    """Run one of the jobs; gives back the exit code."""
    if sys.version_info < NEEDED:
        needed = ".".join(str(part) for part in NEEDED)
        return complain(
            f"Python {needed} or newer is needed; this is {sys.version.split()[0]}.",
            "Call run.py with a newer python.",
        )
    if not arguments or arguments[0] not in ("demo", "test", "install"):
        print((__doc__ or "").strip())
        return 0 if arguments[:1] in (["-h"], ["--help"]) else 2
    job, rest = arguments[0], arguments[1:]
    fault = install("" if job == "demo" else "test")
    if fault or job == "install":
        return fault
    if job == "test":
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in commands: bench/cli/main.py
        return call(
            [str(python()), "-m", "pytest", *PYTEST_OPTIONS, *rest],
            ROOT,
        )
    script = [] if rest and not rest[0].startswith("-") else ["demo"]
    opening = [] if "--no-open" in rest else ["--open"]
    rest = [word for word in rest if word != "--no-open"]
    code = call([str(python()), "-m", "bench.cli", "run", *script, *opening, *rest])
    return 0 if code in DID_ITS_WORK else code


def install(extra: str) -> int:
    """Bring .venv up to date; 0 when it is. What is installed is known by a stamp, so that this
    costs nothing twice.
    """
    stamp = VENV / f"teatbench-{extra or 'run'}.stamp"
    for done in (stamp, VENV / "teatbench-test.stamp"):  # the tests need all that a run needs
        if python().exists() and done.exists() and done.read_text("utf-8") == fingerprint():
            return 0
    print("Setting up .venv (once; a few minutes) ...", flush=True)
    fault = make_venv()
    if fault:
        return fault
    lock, first = LOCKS / f"{extra or 'run'}.txt", VENV / "loops.txt"
    each = re.split(r"(?m)^(?=\w)", lock.read_text("utf-8"))  # a package with its hashes
    first.write_text("".join(one for one in each if one.split("==")[0] in LOOPS), "utf-8")
    if fault := pip_install(["--require-hashes", "--requirement", str(first)]):
        return fault
    with compiling(COMPILED[0]):
        # what is editable has no hash: the packages come first, then the project with what is there
        packages = ["--require-hashes", "--requirement", str(lock)]
        for what in packages, ["--no-deps", "--no-build-isolation", "--editable", str(ROOT)]:
            if fault := pip_install(what):
                return fault
        with compiling(COMPILED[1]):
            pass
    stamp.write_text(fingerprint(), encoding="utf-8")
    return 0


def compiling(module: str) -> subprocess.Popen[bytes]:
    """A process that compiles a module's loops, which are kept; where it can't, whoever needs them
    does.
    """
    return subprocess.Popen(
        [str(python()), "-c", f"import {module}"],
        cwd=ROOT,
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def pip_install(what: Sequence[str]) -> int:
    """Install in .venv; 0 when that is done."""
    done = subprocess.run(
        [str(python()), "-m", "pip", "install", *QUIETLY, *what],
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        check=False,
    )
    if not done.returncode:
        return 0
    last = "\n".join(done.stdout.strip().splitlines()[-15:])
    by_network = any(sign in done.stdout for sign in NETWORK_SIGNS)
    return complain(last, HINT_NETWORK if by_network else HINT_PIP)


def make_venv() -> int:
    """Make .venv where it is missing, broken or of another Python; 0 when it works and has pip."""
    same = f"import sys; sys.exit(sys.version_info[:2] != {tuple(sys.version_info[:2])})"
    # Python's own pip takes three times as long; where no newer one can be had, it does the work
    newer = ["install", *QUIETLY, "--retries", "0", "--require-hashes"]
    newer += ["--requirement", str(LOCKS / "pip.txt")]
    if python().exists() and works(["-c", same]) and works(["-m", "pip", "--version"]):
        works(["-m", "pip", *newer])
        return 0
    try:
        venv.EnvBuilder(clear=VENV.exists()).create(VENV)
        # sooner done than a copy of Python's own pip
        if not works(["-m", "pip", "--python", str(python()), *newer], sys.executable):
            venv.EnvBuilder(with_pip=True).create(VENV)
    except (OSError, subprocess.CalledProcessError, SystemExit) as error:
        return complain(f".venv can't be made: {error}", HINT_VENV)
    return 0 if works(["-m", "pip", "--version"]) else complain(".venv has no pip.", HINT_VENV)


def python() -> Path:
    """The interpreter of .venv."""
    return VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def works(arguments: Sequence[str], interpreter: str = "") -> bool:
    """Whether an interpreter, by default .venv's, does this without complaint."""
    try:
        done = subprocess.run(
            [interpreter or str(python()), *arguments],
            env=environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=False,
        )
    except OSError:
        return False
    return done.returncode == 0


def fingerprint() -> str:
    """Changes when the dependencies, their versions, the place or the Python change."""
    text = (
        (ROOT / "pyproject.toml").read_bytes()
        + b"".join(path.read_bytes() for path in sorted(LOCKS.glob("*.txt")))
        + str(ROOT).encode()
        + sys.version.encode()
    )
    return hashlib.sha256(text).hexdigest()


def call(command: Sequence[str], folder: Path | None = None) -> int:
    """Run a command with this terminal; Ctrl-C is the child's to
    answer, and its exit code is ours.
    """
    with subprocess.Popen(command, cwd=folder, env=environment()) as child:
        while True:
            try:
                return child.wait()
            except KeyboardInterrupt:
                continue  # the child got it too and goes to safe


def environment() -> dict[str, str]:
    """Of all that is called."""
    known = {**os.environ, "PYTHONUTF8": "1"}
    # .venv has no byte code yet: without it each start compiles every module again
    known.pop("PYTHONDONTWRITEBYTECODE", None)
    return known


def complain(what: str, hint: str) -> int:
    """Say what is wrong and what to do; gives back exit code 2."""
    print(f"run.py: {what}\n{hint}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
