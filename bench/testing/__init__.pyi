# What a name of this package is, for type checkers: `PLACES` in __init__.py says it to Python.
from bench.campaign.perturbations import Applied
from bench.testing.checking import Look, SceneFailedError, SceneResult, check, look
from bench.testing.found import keep
from bench.testing.plugins import check_driver, drivers
from bench.testing.scene import Object, Pose, Scene, Teat
from bench.testing.strategies import layouts, objects, perturbations, poses, scenes

__all__ = [
    "Applied",
    "Look",
    "Object",
    "Pose",
    "Scene",
    "SceneFailedError",
    "SceneResult",
    "Teat",
    "check",
    "check_driver",
    "drivers",
    "keep",
    "layouts",
    "look",
    "objects",
    "perturbations",
    "poses",
    "scenes",
]
