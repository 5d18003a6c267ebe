# The names of this package, once: type checkers read them here, and so does textfiles/lazy.py.
from bench.campaign.perturbations import Applied as Applied
from bench.testing.checking import Look as Look
from bench.testing.checking import SceneFailedError as SceneFailedError
from bench.testing.checking import check as check
from bench.testing.checking import look as look
from bench.testing.found import keep as keep
from bench.testing.plugins import check_driver as check_driver
from bench.testing.plugins import drivers as drivers
from bench.testing.scene import Object as Object
from bench.testing.scene import Pose as Pose
from bench.testing.scene import Scene as Scene
from bench.testing.scene import Teat as Teat
from bench.testing.strategies import layouts as layouts
from bench.testing.strategies import objects as objects
from bench.testing.strategies import perturbations as perturbations
from bench.testing.strategies import poses as poses
from bench.testing.strategies import scenes as scenes
