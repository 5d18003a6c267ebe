"""For tests of detectors and drivers (docs/testing.md). Strategies need hypothesis: they are loaded
when they are first named.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bench.campaign.perturbations import Applied
    from bench.testing.checking import Look, SceneFailedError, check, look
    from bench.testing.scene import Object, Pose, Scene, Teat
    from bench.testing.strategies import layouts, objects, perturbations, poses, scenes

_PLACES = {
    "bench.campaign.perturbations": ("Applied",),
    "bench.testing.checking": ("Look", "SceneFailedError", "check", "look"),
    "bench.testing.scene": ("Object", "Pose", "Scene", "Teat"),
    "bench.testing.strategies": ("layouts", "objects", "perturbations", "poses", "scenes"),
}
__all__ = [
    "Applied", "Look", "Object", "Pose", "Scene", "SceneFailedError", "Teat", "check", "layouts",
    "look", "objects", "perturbations", "poses", "scenes",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    for module, names in _PLACES.items():
        if name in names:
            return getattr(import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
