"""Run and scores -> what the report says. How it looks is the business of `reports`."""

from bench.summary.page import PLAIN, Extras, build_page, write_run_report

__all__ = ["PLAIN", "Extras", "build_page", "write_run_report"]
