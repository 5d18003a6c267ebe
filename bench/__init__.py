"""The roof of teatbench: the only package that knows instruments, detectors and reports; and what
it promises to Python programs (docs/api.md). A name is loaded when it is first used.
"""

from bench.version import __version__ as __version__
from textfiles.lazy import lazily

__getattr__, __dir__ = lazily(__name__, "bench.arguments")
