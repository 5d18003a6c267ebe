"""For tests of detectors and drivers (docs/testing.md, docs/drivers.md). Strategies need
hypothesis: a name is loaded when it is first used.
"""

from typing import TYPE_CHECKING

from textfiles.lazy import lazily

if TYPE_CHECKING:
    from bench.campaign.perturbations import Applied
    from bench.testing.checking import Look, SceneFailedError, check, look
    from bench.testing.found import keep
    from bench.testing.plugins import check_driver, drivers
    from bench.testing.scene import Object, Pose, Scene, Teat
    from bench.testing.strategies import layouts, objects, perturbations, poses, scenes

__all__ = [
    "Applied", "Look", "Object", "Pose", "Scene", "SceneFailedError", "Teat", "check",
    "check_driver", "drivers", "keep", "layouts", "look", "objects", "perturbations", "poses",
    "scenes",
]  # fmt: skip
__getattr__ = lazily(__name__, __file__, "bench.arguments")
