"""The phantom: where its teat ends are, and what its solids have to do with them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.script.phantom import layout_names, shipped_phantom
from instruments.world.optics import Floats
from instruments.world.phantom import (
    PIVOT_MM,
    Phantom,
    PlatePose,
    Teat,
    TeatForm,
    TeatShape,
)

LAYOUTS = [name for name in layout_names() if name != "random-udder"]
TABLE_5_1_MM = [
    [-110.2, 284.2, 134.2], [-161.9, 192.6, 137.6], [-224.9, 199.4, 136.7], [-260.6, 267.1, 136.3],
]  # fmt: skip


def test_table_5_1_to_the_last_digit() -> None:
    phantom = shipped_phantom("table-5-1")
    assert phantom.ends_mm == pytest.approx(np.array(TABLE_5_1_MM), abs=1e-9)
    assert phantom.axes == pytest.approx(np.tile([0.0, 0.0, 1.0], (4, 1)))


def test_a_leaning_teat_by_hand() -> None:
    """30 degrees towards +x: the end is length x (sin, 0, cos) from the base."""
    phantom = Phantom((Teat((10.0, 20.0), TeatShape(100.0, 10.0), (np.pi / 6, 0.0)),))
    assert phantom.ends_mm[0] == pytest.approx([60.0, 20.0, 86.60254], abs=1e-5)


def placed(ends_mm: Floats, pose: PlatePose) -> Floats:
    """Turned about the pivot, then shifted."""
    c, s = np.cos(pose.yaw_rad), np.sin(pose.yaw_rad)
    pivot, shift = np.array([*PIVOT_MM, 0.0]), [pose.x_mm, pose.y_mm, pose.z_mm]
    return np.asarray((ends_mm - pivot) @ [[c, s, 0], [-s, c, 0], [0, 0, 1]] + pivot + shift)


shift = st.floats(-60, 60)
POSES = st.builds(PlatePose, shift, shift, st.floats(0, 40), st.floats(-3.1, 3.1))


@pytest.mark.slow
@given(first=POSES, then=POSES, name=st.sampled_from(LAYOUTS))
def test_a_pose_is_a_rigid_motion_and_may_be_carried(
    first: PlatePose, then: PlatePose, name: str
) -> None:
    home = shipped_phantom(name)
    once = placed(home.ends_mm, first)
    assert home.moved(first).ends_mm == pytest.approx(once, abs=1e-9)
    carried = home.moved(first.carried(then))
    assert carried.ends_mm == pytest.approx(placed(once, then), abs=1e-9)


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_end_is_the_apex_of_the_ball(name: str) -> None:
    phantom = shipped_phantom(name).moved(PlatePose(5.0, -7.0, 0.0, 0.3))
    for (hull,), end, axis, teat in zip(
        phantom.teat_hulls(), phantom.ends_mm, phantom.axes, phantom.teats, strict=True
    ):
        assert np.array(hull.b_mm) + teat.shape.radius_mm * axis == pytest.approx(end, abs=1e-9)
        assert hull.flat_a
        assert not hull.flat_b


def test_non_vertical_leans_by_5_to_20_degrees_and_overlapping_has_two_that_touch() -> None:
    lean_deg = np.degrees(np.arccos(shipped_phantom("non-vertical").axes[:, 2]))
    assert ((lean_deg > 5.0) & (lean_deg < 20.0)).all()
    phantom = shipped_phantom("overlapping")
    first, second = phantom.bases_mm[:2]
    radii = sum(teat.shape.radius_mm for teat in phantom.teats[:2])
    assert np.linalg.norm(first - second) == pytest.approx(radii)


@pytest.mark.parametrize("name", LAYOUTS)
def test_no_two_teats_share_room(name: str) -> None:
    hulls = [hull for (hull,) in shipped_phantom(name).teat_hulls()]
    t = np.linspace(0.0, 1.0, 60)[:, None]
    lines = [np.array(h.a_mm) + t * (np.array(h.b_mm) - np.array(h.a_mm)) for h in hulls]
    for i, one in enumerate(lines):
        for j in range(i):
            gap = np.linalg.norm(one[:, None] - lines[j][None], axis=2).min()
            assert gap >= hulls[i].radius_a_mm + hulls[j].radius_a_mm - 1e-6


def test_a_form_s_radii_are_those_of_its_solids() -> None:
    form = TeatForm(((9.0, 9.0), (30.0, 11.0), (60.0, 14.0)), flat_mm=5.0, bend_per_mm=0.003)
    end, axis = np.array([0.0, 0.0, 150.0]), np.array([0.0, 0.0, 1.0])
    behind = np.array([0.0, 2.0, 9.0, 20.0, 45.0])
    assert form.radii_mm(behind)[0] == pytest.approx(5.0)
    assert form.radii_mm(behind)[2:] == pytest.approx([9.0, 10.0, 12.5], abs=0.1)
    (foot, *_), top = form.hulls(end, axis), form.hulls(end, axis)[-1]
    assert foot.a_mm[2] == pytest.approx(90.0)
    assert np.hypot(*foot.a_mm[:2]) == pytest.approx(0.5 * 0.003 * 60.0**2)
    assert (top.b_mm, top.radius_b_mm, top.flat_b) == ((0.0, 0.0, 150.0), 5.0, True)


@pytest.mark.parametrize(
    "make",
    [
        lambda: TeatShape(10.0, 11.0),
        lambda: TeatShape(100.0, 0.0),
        lambda: TeatShape(float("nan"), 11.0),
        lambda: Teat((0.0, 0.0), tilt_rad=(1.2, 0.0)),
        lambda: Teat((0.0, 0.0), tilt_rad=(float("nan"), 0.0)),
        lambda: PlatePose(x_mm=float("inf")),
        lambda: PlatePose(z_mm=-1.0),
    ],
)
def test_nonsense_is_refused(make: object) -> None:
    assert callable(make)
    with pytest.raises(ValueError, match=r"must|needs|may lean|can't stand"):
        make()
