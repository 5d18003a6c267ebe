"""The thesis's six situations (section 5.2) as a phantom and what stands beside it: what the contact sheet shows.

Trial scripts name layouts and objects themselves; these are worked examples of the same words. May not know of cameras.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from instruments.world.objects import SceneObject, make_object
from instruments.world.phantom import make_phantom
from instruments.world.scene import SceneState

SITUATIONS: dict[str, tuple[str, tuple[tuple[str, dict[str, Any]], ...]]] = {
    "non_vertical": ("non-vertical", ()),
    "overlapping": ("overlapping", ()),
    "spurious_teat": ("table-5-1", (("cold_teat", {}),)),
    "hot_body_at_base": ("table-5-1", (("hot_cup", {}),)),
    "hot_body_at_ends": ("table-5-1", (("warm_arm", {}),)),
    "cooler_bodies": (
        "table-5-1",
        (
            ("cooler_body", {"x_mm": -330.0, "y_mm": 420.0, "height_mm": 190.0, "radius_mm": 62.0, "albedo": 0.16}),
            ("cooler_body", {"x_mm": -20.0, "y_mm": 470.0, "height_mm": 215.0, "radius_mm": 68.0, "offset_k": -6.5}),
            ("ball", {"x_mm": -165.0, "y_mm": 540.0, "z_mm": 215.0, "radius_mm": 70.0, "albedo": 0.4}),
        ),
    ),
}


def situation(name: str, *, teat_c: float = 32.5, hose_c: float = 31.5, ambient_c: float = 21.0) -> SceneState:
    """A situation as the cameras would see it, the phantom warm. Raises KeyError for a name that isn't in `SITUATIONS`."""
    layout, others = SITUATIONS[name]
    phantom = make_phantom(layout)
    objects: tuple[SceneObject, ...] = tuple(make_object(kind, **params) for kind, params in others)
    state = SceneState(phantom, (teat_c,) * len(phantom.teats), hose_c, ambient_c)
    return replace(state, objects=objects)
