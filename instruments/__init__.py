"""What has a wire, and the simulated world behind the wires. For drivers of other packages
(docs/drivers.md): what they promise, what they give, and what they raise.
"""

from textfiles.lazy import lazily

__getattr__, __dir__ = lazily(__name__)
