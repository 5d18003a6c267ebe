"""For tests of detectors and drivers (docs/testing.md, docs/drivers.md). Strategies need
hypothesis: a name is loaded when it is first used.
"""

from textfiles.lazy import lazily

# by the module that has them; type checkers read __init__.pyi
PLACES = {
    "bench.campaign.perturbations": ("Applied",),
    "bench.testing.checking": ("Look", "SceneFailedError", "SceneResult", "check", "look"),
    "bench.testing.found": ("keep",),
    "bench.testing.plugins": ("check_driver", "drivers"),
    "bench.testing.scene": ("Object", "Pose", "Scene", "Teat"),
    "bench.testing.strategies": ("layouts", "objects", "perturbations", "poses", "scenes"),
}  # fmt: skip
__all__ = [name for names in PLACES.values() for name in names]
__getattr__ = lazily(__name__, PLACES, "bench.arguments")
