"""The version of teatbench, and of the libraries that its figures depend on; a module of its own,
so that `bench` may import its own rooms.
"""

__version__ = "0.2.0"

LIBRARIES = ("numba", "numpy", "opencv-python-headless", "scipy", "pymodbus", "pyserial")
# packages on PyPI have modules of these names too, and write over the files of ours
CONTESTED = {"opencv-python-headless": "cv2", "pyserial": "serial"}


def versions(names: tuple[str, ...] = LIBRARIES) -> dict[str, str]:
    """Of libraries, as pip has them; as the module says itself, where that is another."""
    from importlib import import_module
    from importlib.metadata import PackageNotFoundError, version

    found = dict[str, str]()
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
        if module := CONTESTED.get(name):
            own = str(getattr(import_module(module), "__version__", "of no version"))
            if not found[name].startswith(own):
                found[name] = f"{own}, another package's (pip: {found[name]})"
    return found


def overwritten() -> str:
    """A sentence where another package's module is in use instead of a library; "" where none is.

    OpenCV's packages are many, and PyPI's ``serial`` is not pyserial.
    """
    from importlib.metadata import packages_distributions

    for name, found in versions(tuple(CONTESTED)).items():
        if "," in found:
            module = CONTESTED[name]
            others = sorted({*packages_distributions().get(module, ())} - {name})
            rid = ", ".join(others or ["what wrote over it"])
            cure = f"uninstall {rid} and {name}, and install {name} again"
            return f"Python's {module} is {found}: {cure}."
    return ""
