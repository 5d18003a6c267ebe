"""The scenes of each quantity: a member of the family `ideal`, in which one thing is set to a value and all else stays as it was drawn.

May not know a detector, nor what a calibration says beyond where the cameras stand (`EYES_MM`).
"""

from __future__ import annotations

from dataclasses import replace

from instruments.world.objects import make_object
from instruments.world.phantom import Phantom, PlatePose, Teat
from instruments.world.scene import Renderer
from instruments.world.shading import Lighting, Paint
from instruments.world.situations import Situation, collisions, situation
from instruments.world.situations.draws import Draw, apart, udder
from instruments.world.situations.validity import EYES_MM

FAMILY = "ideal"
ATTEMPTS = 1000
CLEAR_MM = 4.0  # between teats as any camera sees them
FAR_BOARD_MM = 1250.0  # behind teats at 1.75 m
BOARD_ALBEDO, EVEN_LIGHT = 0.5, 2.2  # together a board at 0.7 of white
BEHIND_MM = 45.0  # the covered teat behind the covering one: near, so that all cameras see about the same of it
ARM_ABOVE_MM, ELBOW_MM, WRIST_MM = 15.0, 50.0, 32.0


def plain(_value: float, seed: int, _renderer: Renderer) -> Situation:
    """As drawn; what is varied isn't in the scene."""
    return situation(FAMILY, seed)


def at_range(range_m: float, seed: int, renderer: Renderer) -> Situation:
    """The phantom moved away until its ends are so far along the right camera's axis, in the mean."""
    found = situation(FAMILY, seed)
    depth = renderer.cameras[1].camera_from_world(found.phantom.ends_mm)[:, 2]
    away = PlatePose(y_mm=float(1e3 * range_m - depth.mean()))
    return replace(found, phantom=found.phantom.moved(away), backdrop=replace(found.backdrop, board_y_mm=FAR_BOARD_MM))


def of_contrast(contrast: float, seed: int, _renderer: Renderer) -> Situation:
    """Teats darker than the board by this share of its grey. In light from everywhere, what stands upright is as bright as its paint."""
    found = situation(FAMILY, seed)
    board = replace(found.backdrop, board_albedo=BOARD_ALBEDO, board_texture=0.0)
    even = Lighting(lamps=(), ambient=EVEN_LIGHT)
    return replace(found, backdrop=board, lighting=even, teat_paint=Paint(BOARD_ALBEDO * (1.0 - contrast)))


def leaning(lean_deg: float, seed: int, _renderer: Renderer) -> Situation:
    """Four teats that lean by this, each another way, none covering another."""
    found = situation(FAMILY, seed)
    for attempt in range(ATTEMPTS):
        phantom = udder(Draw("tilt", seed, attempt), lean_deg=(lean_deg, lean_deg))
        drawn = replace(found, phantom=phantom)
        if apart(phantom, EYES_MM) >= CLEAR_MM and not any(collisions(drawn)):
            return drawn
    raise ValueError(f"no udder whose teats lean by {lean_deg:g} degrees and stand apart was found in {ATTEMPTS} draws")


def overlapping(share: float, seed: int, _renderer: Renderer) -> Situation:
    """Each far teat is moved behind a near one, which covers this share of its width as seen from midway; below zero is a gap."""
    found = situation(FAMILY, seed)
    teats = found.phantom.teats
    outwards = (-1.0, 1.0)  # the two pairs move apart, not into each other
    covered = [_behind(teats[i], teats[i + 2], share, way) for i, way in enumerate(outwards)]
    near = [replace(teat, tilt_rad=(0.0, 0.0)) for teat in teats[:2]]
    return replace(found, phantom=Phantom((*near, *covered)))


def _behind(near: Teat, far: Teat, share: float, way: float) -> Teat:
    """The far teat upright behind the near one: bearings x / y from midway, radii as seen at their distances."""
    eye_x, eye_y, _ = EYES_MM[2]
    near_y = near.base_mm[1] - eye_y
    far_y = near_y + BEHIND_MM
    touching = near.shape.radius_mm / near_y + far.shape.radius_mm / far_y
    bearing = (near.base_mm[0] - eye_x) / near_y + way * (touching - 2.0 * share * far.shape.radius_mm / far_y)
    return replace(far, base_mm=(float(eye_x + bearing * far_y), float(far_y + eye_y)), tilt_rad=(0.0, 0.0))


def before_arm(gap_mm: float, seed: int, _renderer: Renderer) -> Situation:
    """A bare forearm level behind the ends, its nearest skin this far behind the farthest teat; elbow left or right by turns."""
    found = situation(FAMILY, seed)
    ends = found.phantom.ends_mm
    farthest = max(hull.radius_b_mm + max(hull.a_mm[1], hull.b_mm[1]) for hull in found.phantom.teat_hulls())
    arm = make_object(
        "warm_arm", y_mm=farthest + gap_mm + ELBOW_MM, z_mm=float(ends[:, 2].mean()) + ARM_ABOVE_MM,
        elbow_radius_mm=ELBOW_MM, wrist_radius_mm=WRIST_MM, rise_deg=0.0, turn_deg=180.0 * (seed % 2),
    )  # fmt: skip
    return replace(found, objects=(arm,))
