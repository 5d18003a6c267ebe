"""A program of its own: prints the numbers, texts and structures of a .mat file as JSON. What can't
be read ends it with a sentence on standard error, or kills it, and nothing else.
"""

from __future__ import annotations

import json
import math
import sys
import warnings
from contextlib import suppress
from typing import Any

import numpy as np

MOST_NUMBERS = 1000  # larger arrays, the pictures' corners for instance, are left out
DEEPEST = 6
MEMORY_BYTES = 2 * 1024**3
OBJECT = "an object of MATLAB's"  # its own format, which isn't published


def main(path: str) -> int:
    with suppress(ImportError, ValueError, OSError):  # Windows; a system that allows less, or none
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    from scipy.io import loadmat

    warnings.simplefilter("ignore")
    try:
        found = loadmat(path, appendmat=False, struct_as_record=False)
        plain = {name: _plain(value, 0) for name, value in found.items() if name[:2] != "__"}
        plain |= {"": OBJECT} if "__function_workspace__" in found else {}
        text = json.dumps({name: value for name, value in plain.items() if value is not None})
    # a damaged file raises anything
    except Exception as error:
        words = " ".join(str(error).split())
        sys.stderr.write(f"{type(error).__name__}: {words}\n")
        return 1
    sys.stdout.write(text)
    return 0


def _plain(value: Any, depth: int) -> Any:
    """Lists, texts and tables; None for what is none of these."""
    if depth > DEEPEST:
        return None
    if hasattr(value, "_fieldnames"):
        return {name: _plain(getattr(value, name), depth + 1) for name in value._fieldnames}
    if type(value).__name__ == "MatlabOpaque" or type(value).__name__ == "MatlabFunction":
        return OBJECT
    if not isinstance(value, np.ndarray) or value.size > MOST_NUMBERS:
        return None
    if value.dtype.kind == "O":
        parts = [_plain(one, depth + 1) for one in value.ravel().tolist()]
        return parts[0] if len(parts) == 1 else parts
    if value.dtype.kind in "US":
        return "".join(map(str, value.ravel().tolist()))
    if value.dtype.kind not in "biuf":
        return f"{value.dtype.name} numbers" if value.dtype.kind == "c" else None
    return [
        (one if math.isfinite(one) else str(one))
        for one in value.astype(np.float64).ravel().tolist()
    ]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
