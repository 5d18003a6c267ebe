"""Aravis, the library that speaks GigE Vision and USB3 Vision, loaded when a camera asks for it and explained where it is missing."""

from __future__ import annotations

import importlib
from typing import Any

from instruments.errors import DeviceError

INSTALL = (
    'Install Aravis and its Python binding: on Debian and Ubuntu "apt install gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev '
    'pkg-config", then "pip install \'teatbench[genicam]\'".'
)
FAKE = "Fake_"  # how the library's own camera in this process is named


def load_aravis() -> Any:
    """The library's namespace. Raises DeviceError that says what to install."""
    try:
        gi = importlib.import_module("gi")
        gi.require_version("Aravis", "0.8")
        return importlib.import_module("gi.repository.Aravis")
    except (ImportError, ValueError) as error:  # ValueError: the binding is there, the library isn't
        raise DeviceError("genicam cameras", f"the library can't be loaded: {error}", hint=INSTALL) from error


def found_cameras(aravis: Any) -> list[str]:
    """Names of the cameras that answer on the network and on USB; takes a second."""
    aravis.update_device_list()
    return [str(aravis.get_device_id(i)) for i in range(aravis.get_n_devices())]
