"""The version of teatbench; a module of its own, so that `bench` may import its own rooms."""

__version__ = "0.2.0"
