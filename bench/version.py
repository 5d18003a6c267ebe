"""The version of teatbench, and of the libraries that its figures depend on; a module of its own,
so that `bench` may import its own rooms.
"""

__version__ = "0.2.0"

LIBRARIES = ("numba", "numpy", "opencv-python-headless", "scipy", "pymodbus", "pyserial")
OPENCV = "opencv-python-headless"


def versions(names: tuple[str, ...] = LIBRARIES) -> dict[str, str]:
    """Of libraries, as pip has them; of OpenCV as it says itself, where that is another: each of
    its packages on PyPI writes over the files of the others.
    """
    from importlib.metadata import PackageNotFoundError, version

    import cv2

    found = dict[str, str]()
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    if OPENCV in found and not found[OPENCV].startswith(cv2.__version__):
        found[OPENCV] = f"{cv2.__version__}, another package's (pip: {found[OPENCV]})"
    return found


def other_opencv() -> str:
    """A sentence where another package's OpenCV is in use; "" for ours."""
    found = versions((OPENCV,))[OPENCV]
    if "," not in found:
        return ""
    return (
        f"OpenCV is {found}: detectors and calibrations may give other figures than docs have."
        f" Uninstall every package of OpenCV, and install {OPENCV} again."
    )
