"""Figures beside their aims: kept with the benchmark and printed, never asserted, for machines are
noisy.

`PEAK_KIB` is text for a child process: a function that gives its own peak memory.
"""

from __future__ import annotations

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
    """Note ``value`` under ``what`` and print it beside its aim;
    `-s` shows it as it is measured.
    """
    benchmark.extra_info[what] = value
    print(f"\n{what}: {value:,.5g} (aim: {aim})")


def taken_s(benchmark: BenchmarkFixture, of: str = "median") -> float:
    """Seconds of a round: the median, "mean", "min" or "max" of all."""
    assert benchmark.stats is not None
    return float(getattr(benchmark.stats.stats, of))
