"""Figures beside their aims: kept with the benchmark and printed, never asserted, for machines are
noisy.

`PEAK_KIB` is text for a child process: a function that gives its own peak memory.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from pytest_benchmark.fixture import BenchmarkFixture

PEAK_KIB = """
def peak_kib():
    try:  # what the kernel counts for a process counts its parent's memory too, at the moment it was forked
        with open("/proc/self/status", encoding="ascii") as status:
            return int(next(line for line in status if line.startswith("VmHWM")).split()[1])
    except OSError:
        import resource, sys
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // (1024 if sys.platform == "darwin" else 1)
"""


def figure(benchmark: BenchmarkFixture, what: str, value: float, aim: str) -> None:
    """Note ``value`` under ``what`` and print it beside its aim; `-s` shows it as measured."""
    benchmark.extra_info[what] = value
    print(f"\n{what}: {value:,.5g} (aim: {aim})")


def kernel() -> None:
    """Fixed work for numpy, about as a picture's: what a machine's speed is measured by."""
    values = np.random.default_rng(0).standard_normal((1024, 1360), dtype=np.float32)
    for _ in range(10):
        values = np.sqrt(np.abs(values) * np.float32(0.9) + np.float32(0.1))
    assert values.min() > 0.0


def cpu_s(work: Callable[[], object]) -> float:
    begun_s = time.process_time()
    work()
    return time.process_time() - begun_s


def beside_fixed(benchmark: BenchmarkFixture, what: str, spent_s: float, aim: str) -> None:
    """Note processor time, and its ratio to the fixed work, measured now."""
    figure(benchmark, f"{what}, s of a processor", spent_s, aim)
    fixed_s = float(np.median([cpu_s(kernel) for _ in range(9)]))
    figure(benchmark, f"{what} / fixed work, CPU", spent_s / fixed_s, "as little as can be")


def taken_s(benchmark: BenchmarkFixture, of: str = "median") -> float:
    """Seconds of a round: the median, "mean", "min" or "max" of all."""
    assert benchmark.stats is not None
    return float(getattr(benchmark.stats.stats, of))
