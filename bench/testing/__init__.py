"""Tests of detectors and of drivers, for labs and teams: pytest, hypothesis, conformance."""
