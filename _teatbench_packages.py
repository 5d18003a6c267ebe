"""Where the packages of teatbench are found: their names are common, and another's ``bench.py`` or
package ``instruments`` may hide one or have been written over it. Nothing of them is imported here.
"""

import os
from importlib.util import find_spec

PACKAGES = ("bench", "detector", "instruments", "reports", "textfiles")


def hiding() -> str:
    """What hides a package of teatbench, and what to do; "" where nothing does: they lie in one
    folder.
    """
    found = {name: getattr(find_spec(name), "origin", None) or name for name in PACKAGES}
    parents = {name: os.path.split(os.path.split(origin)[0])[0] for name, origin in found.items()}
    home = max(parents.values(), key=[*parents.values()].count)
    for name, origin in found.items():
        folder, file = os.path.split(origin)
        if not file.startswith("__init__."):
            return f"{origin} hides teatbench's package {name!r}: give that file another name"
        if parents[name] != home:
            return f"{folder} hides teatbench's package {name!r}: give that folder another name"
    return ""


def installed_over() -> str:
    """Which package's files pip wrote over those of teatbench, and what to do; "" for none."""
    from importlib.metadata import packages_distributions

    owners = packages_distributions()
    for name in PACKAGES:
        others = sorted({*owners.get(name, [])} - {"teatbench"})
        if others:
            why = f"{others[0]} has files in teatbench's package {name!r}"
            return f"{why}: give teatbench an environment of its own, and install it anew"
    return ""
