"""The roof of teatbench: the only package that knows instruments, detectors and reports."""

__version__ = "0.2.0"
