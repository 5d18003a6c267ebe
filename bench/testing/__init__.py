"""For tests of detectors and drivers (docs/testing.md, docs/drivers.md). Strategies need
hypothesis: a name is loaded when it is first used.
"""

from textfiles.lazy import lazily

__getattr__, __dir__ = lazily(__name__, "bench.arguments")
