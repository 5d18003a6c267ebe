"""Figures beside their aims: kept with the benchmark and printed, never asserted, for machines are noisy."""

from __future__ import annotations

from pytest_benchmark.fixture import BenchmarkFixture


def figure(benchmark: BenchmarkFixture, what: str, value: float, aim: str) -> None:
    """Note ``value`` under ``what`` and print it beside its aim; `-s` shows it as it is measured."""
    benchmark.extra_info[what] = value
    print(f"\n{what}: {value:,.5g} (aim: {aim})")
