"""For tests of detectors and drivers (docs/testing.md, docs/drivers.md). Strategies need
hypothesis: a name is loaded when it is first used.
"""

from typing import TYPE_CHECKING

from textfiles.lazy import lazily

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
__getattr__ = lazily(__name__, _PLACES)
