"""Run and scores -> what the report says. How it looks is the business of `reports`."""

from bench.summary.page import build_page, write_run_report

__all__ = ["build_page", "write_run_report"]
